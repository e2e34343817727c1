"""Where an emulated device can be plugged in: a TCP port, or a pseudo-terminal with a name in the file system."""

from __future__ import annotations

import contextlib
import os
import select
import socket
import time
from pathlib import Path

_SEND_TIMEOUT, _POLL = 0.5, 0.02
"""A program that reads nothing for so long is disconnected; a terminal without one is looked at so often [s]."""


class TcpPlug:
    """Listens on a port and serves one program at a time."""

    def __init__(self, host: str, port: int):
        """port: 0 for any that is free."""
        self._host, self._port = host, port
        self._program: socket.socket | None = None
        self._listener: socket.socket | None = None
        self.restore()

    @property
    def url(self) -> str:
        return f"tcp://{self._host}:{self._port}"

    @property
    def attached(self) -> bool:
        """Whether a program is connected."""
        return self._program is not None

    def restore(self) -> None:
        """Takes programs (again)."""
        self._listener = socket.create_server((self._host, self._port), backlog=1)
        self._port = self._listener.getsockname()[1]

    def pull(self) -> None:
        """Closes the connection and takes no other."""
        self._drop()
        if self._listener is not None:
            self._listener.close()
            self._listener = None

    def read(self, timeout: float) -> bytes:
        """What the program says within a time [s]; b"" also when it comes or goes."""
        waiting = self._program or self._listener
        if waiting is None:
            time.sleep(timeout)
            return b""
        if not select.select([waiting], [], [], timeout)[0]:
            return b""
        if self._program is None and self._listener is not None:
            self._program, _ = self._listener.accept()
            self._program.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self._program.settimeout(_SEND_TIMEOUT)
            return b""
        data = b""
        with contextlib.suppress(OSError):
            data = waiting.recv(4096)
        if not data:
            self._drop()
        return data

    def send(self, data: bytes) -> None:
        """Sends to the program, if there is one; one that does not read is disconnected."""
        if self._program is not None:
            try:
                self._program.sendall(data)
            except OSError:
                self._drop()

    def _drop(self) -> None:
        if self._program is not None:
            self._program.close()
            self._program = None


class PtyPlug:
    """A pseudo-terminal; a symbolic link leads to it, also after the plug was pulled."""

    def __init__(self, link: Path):
        self._link = link
        self._master: int | None = None
        self.attached = False
        self.restore()

    @property
    def url(self) -> str:
        return f"serial://{self._link}"

    def restore(self) -> None:
        """Is there (again)."""
        if self._link.exists() and not self._link.is_symlink():
            raise FileExistsError(17, "is in the way of an emulated port", str(self._link))
        import tty  # here, for only POSIX systems have it, and recordings are run without

        self._master, slave = os.openpty()
        tty.setraw(slave)
        os.set_blocking(self._master, False)
        self._link.unlink(missing_ok=True)
        self._link.symlink_to(os.ttyname(slave))
        os.close(slave)  # now the terminal shows whether a program has it open

    def pull(self) -> None:
        """The terminal and its name are gone."""
        self.attached = False
        if self._master is not None:
            self._link.unlink(missing_ok=True)
            os.close(self._master)
            self._master = None

    def read(self, timeout: float) -> bytes:
        """What the program says within a time [s]."""
        if self._master is None:
            time.sleep(timeout)
            return b""
        waiting = select.poll()
        waiting.register(self._master, select.POLLIN)
        events = waiting.poll(timeout * 1e3)
        mask = events[0][1] if events else 0
        self.attached = not mask & select.POLLHUP
        if not mask & select.POLLIN:
            if not self.attached:
                time.sleep(min(timeout, _POLL))
            return b""
        with contextlib.suppress(OSError):
            return os.read(self._master, 4096)
        return b""

    def send(self, data: bytes) -> None:
        """Sends to the program, if there is one; what it is too slow for is lost, as on a real line."""
        if self._master is not None and self.attached:
            with contextlib.suppress(OSError):
                os.write(self._master, data)


Plug = TcpPlug | PtyPlug
