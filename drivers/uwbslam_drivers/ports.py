"""Ports: serial lines and TCP connections as byte streams that raise OSError once the other side is gone."""

from __future__ import annotations

import select
import socket

CONNECT_TIMEOUT = 2.0
"""Time for a TCP connection to come about [s]: TCP repeats a lost first packet after 1 s."""
WRITE_TIMEOUT = 1.0
"""Time for the other side to take a request [s]; one that takes nothing for so long is gone."""
CHUNK = 65536
"""At most so much is read at once [bytes]: several scans, so that a reader who was late catches up."""


class TcpPort:
    """A TCP connection."""

    def __init__(self, host: str, port: int):
        self._socket = socket.create_connection((host, port), CONNECT_TIMEOUT)
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._socket.settimeout(WRITE_TIMEOUT)

    def read(self, timeout: float) -> bytes:
        if not select.select([self._socket], [], [], timeout)[0]:
            return b""
        data = self._socket.recv(CHUNK)
        if not data:
            raise ConnectionResetError("the device closed the connection")
        return data

    def write(self, data: bytes) -> None:
        self._socket.sendall(data)

    def close(self) -> None:
        self._socket.close()


class SerialPort:
    """A serial line, held exclusively: a second program on the same port would take half of the bytes each."""

    def __init__(self, path: str, baud: int, dtr: bool = True):
        import serial  # here, for it needs the terminals of a POSIX system, and recordings are run without

        self._serial = serial.Serial(None, baud, timeout=0, write_timeout=WRITE_TIMEOUT, exclusive=True)
        self._serial.dtr = dtr  # before it is opened, or a motor stops and a board resets for a moment
        self._serial.port = path
        try:
            self._serial.open()
        except ValueError as error:  # a speed that this computer's port does not have
            raise OSError(f"{path}: {error}") from None

    def read(self, timeout: float) -> bytes:
        # pyserial sets up the port anew for each new timeout, so the waiting is done here.
        if not select.select([self._serial.fileno()], [], [], timeout)[0]:
            return b""
        return self._serial.read(min(self._serial.in_waiting, CHUNK) or 1)

    def write(self, data: bytes) -> None:
        self._serial.write(data)

    def close(self) -> None:
        self._serial.close()
