"""What keeps a small HTTP server answering: a most number of connections, a longest time for a request to arrive.

Both servers of this project, of worlds and of models, are `http.server`'s with these limits. uvicorn, which `sim play` uses,
has no limit on the time that a request may take to arrive. Paper: none (engineering).
"""

from __future__ import annotations

import contextlib
import select
import socket
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any, Final

from configs.schema.checks import is_loopback

_FULL: Final = b"HTTP/1.1 503 Service Unavailable\r\nContent-Length: 0\r\nRetry-After: 1\r\nConnection: close\r\n\r\n"
#: Digits of a length that is worth reading.
_DIGITS: Final = 12


class LimitedServer(ThreadingHTTPServer):
    """A thread per connection, up to a number; who comes when all are taken is told so at once.

    Attributes:
        connections: most at once.
    """

    request_queue_size = 128
    connections = 128

    def __init__(self, address: tuple[str, int], handler: type[BaseHTTPRequestHandler]) -> None:
        super().__init__(address, handler)
        self._served: set[Any] = set()

    def process_request(self, request: Any, client_address: Any) -> None:
        """Hands a connection to a thread."""
        if len(self._served) >= self.connections:
            with contextlib.suppress(OSError):
                request.sendall(_FULL)
            self.shutdown_request(request)
            return
        self._served.add(request)
        try:
            super().process_request(request, client_address)
        except BaseException:  # Ctrl-C may come when the thread already runs, or has ended
            self._served.discard(request)
            raise

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        """Serves a connection to its end."""
        try:
            super().process_request_thread(request, client_address)
        finally:
            self._served.discard(request)


class LimitedHandler(BaseHTTPRequestHandler):
    """Ends a connection whose request, body included, has not arrived in time, byte by byte as it may come.

    Attributes:
        arrival_s: seconds that a request may take.
    """

    arrival_s = 60.0
    _watch: threading.Timer | None = None

    def handle_one_request(self) -> None:
        """Reads and answers a request."""
        self._watch = threading.Timer(self.arrival_s, self._end)
        self._watch.daemon = True
        self._watch.start()
        try:
            super().handle_one_request()
        except ConnectionError:  # the client has gone
            self.close_connection = True
        finally:
            self._watch.cancel()

    def parse_request(self) -> bool:
        """Reads the head."""
        fine = super().parse_request()
        if not fine or not body_length(self.headers.get("Content-Length", "")):
            self.arrived()
        return fine

    def arrived(self) -> None:
        """The request is there as a whole; from now on it is the answer that takes time."""
        if self._watch is not None:
            self._watch.cancel()

    def is_for_here(self) -> bool:
        """Whether `Host` names this machine, or nothing: a web page under another name may lead here, and says that name."""
        host = self.headers.get("Host", "localhost")
        return is_loopback(host if host.endswith("]") else host.rpartition(":")[0] or host)

    def _end(self) -> None:
        self.close_connection = True
        with contextlib.suppress(OSError):
            self.connection.shutdown(socket.SHUT_RDWR)


def body_length(text: str) -> int | None:
    """The length that `Content-Length` names; None when it is no number, or one that nobody would send."""
    return int(text) if text.isascii() and text.isdecimal() and len(text) <= _DIGITS else None


def has_left(connection: socket.socket) -> bool:
    """Whether a client has closed its end."""
    try:
        poll = select.poll()
        poll.register(connection, select.POLLIN)
        return bool(poll.poll(0)) and connection.recv(1, socket.MSG_PEEK) == b""
    except (OSError, ValueError):  # closed on this side
        return True
