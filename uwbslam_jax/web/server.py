"""The live view's server: one page, and Server-Sent Events that let it grow. The standard library's HTTP server.

Nothing a viewer sends changes the run. A viewer that reads too slowly misses events and gets all anew.
"""

from __future__ import annotations

import json
import queue
import threading
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

from uwbslam_jax.errors import UsageError
from uwbslam_jax.web.live_page import STEP_S, WORDS_S, Event, LivePage

_MOST_VIEWERS, _WAITING = 16, 50
"""Viewers at once, each of which takes a thread, and events that one may be behind: some five seconds [each]."""
_WRITE_TIMEOUT_S = 10.0
"""A viewer that takes nothing for so long is gone: without this its thread waits for ever [s]."""
_OWN_NAMES = ("127.0.0.1", "localhost")
"""This computer's names for itself [host]: under another one, a page of another site would be asking."""


def parse_address(text: str) -> tuple[str, int]:
    """Host and port of HOST:PORT. Raises UsageError with one line."""
    host, colon, port = text.rpartition(":")
    if not (colon and host and port.isdecimal() and int(port) < 1 << 16):
        raise UsageError(f"{text}: must be HOST:PORT")
    return host.strip("[]"), int(port)


class LiveView:
    """Serves a page until it is closed.

    Attributes:
      url: where.
    """

    def __init__(self, live: LivePage, host: str, port: int):
        """Opens the port; 0 for any that is free. Raises UsageError where it cannot be opened."""
        self._page = live
        self._loopback = host in _OWN_NAMES
        self._viewers: set[queue.Queue[Event]] = set()
        self._closing = threading.Event()
        view = self

        class Handler(BaseHTTPRequestHandler):
            timeout = _WRITE_TIMEOUT_S

            def do_GET(self) -> None:
                view._answer(self)

            def log_message(self, format: str, *args: object) -> None:  # a viewer is no news
                pass

        class Server(ThreadingHTTPServer):
            daemon_threads = True
            block_on_close = False

            def handle_error(self, request: object, client_address: object) -> None:  # it is gone: nothing to report
                pass

        try:
            self._server = Server((host, port), Handler)
        except OSError as error:
            raise UsageError(f"live view at {host}:{port}: {error.strerror or error}; see --view") from None
        self.url = f"http://{host}:{self._server.server_address[1]}"
        threading.Thread(target=self._server.serve_forever, name="live view", daemon=True).start()
        self._thread = threading.Thread(target=self._serve, name="live events", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Reports to the viewers that the run has ended, and closes the port."""
        self._closing.set()
        self._thread.join()
        self._server.shutdown()
        self._server.server_close()

    def _serve(self) -> None:
        """Hands events to all viewers."""
        count = 0
        while not self._closing.wait(STEP_S):
            self._page.watched = bool(self._viewers)
            if self._viewers:
                for event in self._page.events():
                    self._send(event)
                if count % round(WORDS_S / STEP_S) == 0:
                    self._send(self._page.words())
            count += 1
        self._send(self._page.words())
        self._send(("end", "{}"))

    def _send(self, event: Event) -> None:
        for viewer in list(self._viewers):
            try:
                viewer.put_nowait(event)
            except queue.Full:
                self._viewers.discard(viewer)  # its connection ends, and the browser comes back for all of it

    def _answer(self, request: BaseHTTPRequestHandler) -> None:
        path = request.path.partition("?")[0]
        if self._loopback and request.headers.get("Host", "").rpartition(":")[0] not in _OWN_NAMES:
            request.send_error(HTTPStatus.FORBIDDEN)  # a foreign name that leads here: another site's page asks
        elif path == "/":
            body = self._page.whole().encode()
            self._head(request, "text/html; charset=utf-8", len(body))
            request.wfile.write(body)
        elif path == "/events" and len(self._viewers) < _MOST_VIEWERS:
            self._head(request, "text/event-stream", None)
            self._stream(request)
        else:
            request.send_error(HTTPStatus.NOT_FOUND if path != "/events" else HTTPStatus.SERVICE_UNAVAILABLE)

    def _head(self, request: BaseHTTPRequestHandler, kind: str, length: int | None) -> None:
        request.send_response(HTTPStatus.OK)
        request.send_header("Content-Type", kind)
        request.send_header("Cache-Control", "no-store")
        request.send_header("X-Content-Type-Options", "nosniff")
        if length is not None:
            request.send_header("Content-Length", str(length))
        request.end_headers()

    def _stream(self, request: BaseHTTPRequestHandler) -> None:
        """Events until the viewer leaves or the run ends."""
        mine: queue.Queue[Event] = queue.Queue(_WAITING)
        mine.put(("begin", json.dumps(self._page.begin(), separators=(",", ":"), allow_nan=False)))
        self._viewers.add(mine)
        try:
            while mine in self._viewers or not mine.empty():
                try:
                    name, data = mine.get(timeout=1.0)
                except queue.Empty:
                    request.wfile.write(b": alive\n\n")  # or a viewer that has left is never noticed
                    continue
                request.wfile.write(f"event: {name}\ndata: {data}\n\n".encode())
                if name == "end":
                    break
        finally:
            self._viewers.discard(mine)
