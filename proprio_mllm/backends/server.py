"""An HTTP server that answers OpenAI's chat completions with one backend, on the loopback interface.

`POST /v1/chat/completions` and `GET /v1/models`. One thread per call; the backend gathers them into batches. A request that is
wrong gets 4xx, one that the backend could not answer 503, both as OpenAI's error object. Left out: streaming, keys, TLS.

Paper: none (engineering).
"""

from __future__ import annotations

import json
import logging
import socket
import time
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any, Final

from proprio_mllm.backends.protocol import Backend, BackendError, RequestError
from proprio_mllm.backends.wire import WireError, completion, error_object, model_list, read_request

__all__ = ["BODY_BYTES", "ChatServer"]

logger = logging.getLogger(__name__)

#: Longest request; a picture of 500 pixels squared takes about 0.5 MB.
BODY_BYTES: Final = 32 * 2**20
_CHAT, _MODELS = "/v1/chat/completions", "/v1/models"
_METHODS: Final = {_CHAT: "POST", _MODELS: "GET"}


class ChatServer(ThreadingHTTPServer):
    """Serves one backend on 127.0.0.1; `serve_forever` runs until `shutdown` is called from another thread.

    Args:
        backend: who answers; stays the caller's to close.
        name: of the model, as clients ask for it.
        port: 0 takes a free one; `url` names it.
        constrained: whether the backend holds replies to a schema.
        revision: of the model, told in the list of models; "" tells none.

    Raises:
        OSError: when the port is taken.
    """

    # Threads are waited for when the server closes, so that calls under way get their replies.
    daemon_threads = False

    def __init__(self, backend: Backend, name: str, port: int, constrained: bool = False, revision: str = "") -> None:
        super().__init__(("127.0.0.1", port), _Handler)
        self.backend, self.name, self.constrained, self.revision = backend, name, constrained, revision
        self.since = int(time.time())

    @property
    def url(self) -> str:
        """Base URL, as clients want it."""
        return f"http://127.0.0.1:{self.server_address[1]}/v1"


class _Handler(BaseHTTPRequestHandler):
    """One call on one connection."""

    protocol_version = "HTTP/1.1"
    timeout = 10.0  # seconds that a client may take to send its next bytes

    def do_GET(self) -> None:
        """Lists the model."""
        self._answer()

    def do_POST(self) -> None:
        """Answers a chat."""
        self._answer()

    def log_message(self, format: str, *args: Any) -> None:
        """Writes the access log as debug messages."""
        logger.debug(format, *args)

    def _answer(self) -> None:
        self.close_connection = True
        try:
            self._send(*self._outcome())
        except OSError as error:
            logger.debug("the client has gone: %s", error)

    def _outcome(self) -> tuple[int, dict[str, Any]]:
        """HTTP status and content of the answer."""
        try:
            return 200, self._reply()
        except WireError as error:
            return error.status, error_object(str(error), error.status, error.code)
        except RequestError as error:
            return 400, error_object(str(error), 400)
        except BackendError as error:
            return 503, error_object(str(error), 503)
        except TimeoutError:
            return 408, error_object(f"the request did not arrive within {self.timeout:g} s", 408)

    def _reply(self) -> dict[str, Any]:
        path = self.path.partition("?")[0]
        if path not in _METHODS:
            raise WireError(f"no such path: {path}; allowed: {', '.join(_METHODS)}", 404)
        if self.command != _METHODS[path]:
            raise WireError(f"{path} takes {_METHODS[path]}, not {self.command}", 405)
        server = self.server
        assert isinstance(server, ChatServer)
        if path == _MODELS:
            return model_list(server.name, server.since, server.revision)
        return completion(server.backend.complete(read_request(self._body(), server.name, server.constrained)), server.name)

    def _body(self) -> bytes:
        """The request's body. Only JSON is read: a web page cannot send that here without asking first."""
        if self.headers.get_content_type() != "application/json":
            raise WireError(f"Content-Type {self.headers.get_content_type()!r}; expected application/json", 415)
        length = self.headers.get("Content-Length", "")
        if not length.isdecimal():
            raise WireError(f"Content-Length {length!r}; expected a number", 411)
        if int(length) > BODY_BYTES:
            raise WireError(f"request of {length} bytes; allowed: {BODY_BYTES}", 413)
        return self.rfile.read(int(length))

    def _send(self, status: int, content: dict[str, Any]) -> None:
        """Sends JSON and ends the connection, once the client has stopped sending: else it might not get to read it."""
        body = json.dumps(content).encode()
        self.send_response(status)
        self.send_header("Content-Type", "application/json")
        self.send_header("Content-Length", str(len(body)))
        self.send_header("Connection", "close")
        self.end_headers()
        self.wfile.write(body)
        if status >= 400:
            self.connection.shutdown(socket.SHUT_WR)
            dropped = 0
            while dropped < 4 * BODY_BYTES and (part := self.connection.recv(2**16)):
                dropped += len(part)
