"""The HTTP server: routes, limits, and who may ask.

On the loopback interface no token is needed; bound elsewhere one is required. Requests whose `Host` is not the server's own and
requests that are not `application/json` are refused, so that a web page in a browser on the same machine cannot drive a world.
"""

from __future__ import annotations

import hmac
import logging
from collections.abc import Mapping
from dataclasses import dataclass
from http import HTTPStatus
from typing import Any, Final

from configs.schema.checks import is_loopback
from data.http_limits import LimitedHandler, LimitedServer, body_length, has_left
from interface.bodies import DEFAULT_ROBOT
from robots.spec import available_robots
from sim.interfaces.remote.protocol import VERSION, ProtocolError, dumps, images_of, loads
from sim.interfaces.remote.worlds import (
    CONTROLLER_ARGUMENTS,
    WorldBrokeError,
    WorldGoneError,
    WorldOverError,
    WorldRefusedError,
    Worlds,
)

_LOG = logging.getLogger(__name__)
_MAX_BODY: Final = 1 << 20
#: The most of a body that is too long that is read and thrown away.
_MAX_DRAIN: Final = 1 << 24
_TIMEOUT_S: Final = 60.0


@dataclass(frozen=True)
class ServerConfig:
    """Where and how to serve.

    Attributes:
        host: interface to bind; anything but loopback needs a token.
        port: TCP port, 0 for a free one.
        worlds: the most worlds at once; each is a process of about 0.4 GB.
        idle_s: seconds without a request after which a world is closed.
    """

    host: str = "127.0.0.1"
    port: int = 8265
    worlds: int = 4
    idle_s: float = 900.0

    def __post_init__(self) -> None:
        if not 0 <= self.port <= 65535:
            raise ValueError(f"port {self.port} outside 0..65535")
        if self.worlds < 1:
            raise ValueError(f"worlds must be at least 1, got {self.worlds}")
        if not self.idle_s > 0.0:
            raise ValueError(f"idle_s must be positive, got {self.idle_s}")


class RemoteServer:
    """Serves worlds until stopped.

    Args:
        config: where and how.
        token: what clients must show as `Authorization: Bearer TOKEN`; None asks for nothing.

    Raises:
        ValueError: when bound elsewhere than on loopback without a token of at least 16 characters.
        OSError: when the address cannot be bound.
    """

    def __init__(self, config: ServerConfig, token: str | None = None) -> None:
        if not is_loopback(config.host) and (token is None or len(token) < 16):
            raise ValueError(
                f"host {config.host!r} can be reached from elsewhere: a token of at least 16 characters is required"
            )
        self.config = config
        self.worlds = Worlds(config.worlds, config.idle_s)
        handler = type("Handler", (_Handler,), {"worlds": self.worlds, "token": token, "loopback": is_loopback(config.host)})
        try:
            self._server = LimitedServer((config.host, config.port), handler)
        except OSError:
            self.worlds.stop()
            raise
        self._server.daemon_threads = True

    @property
    def url(self) -> str:
        """Address for clients on this machine."""
        host, port = self._server.server_address[:2]
        return f"http://{host!s}:{port}"

    def serve(self) -> None:
        """Serves until `stop` is called from another thread."""
        try:
            self._server.serve_forever(poll_interval=0.2)
        finally:
            self.worlds.stop()

    def stop(self) -> None:
        """Ends serving and all worlds."""
        self._server.shutdown()
        self._server.server_close()
        self.worlds.stop()


class _Handler(LimitedHandler):
    worlds: Worlds
    token: str | None
    loopback: bool
    protocol_version = "HTTP/1.1"
    server_version = "dualthor"
    sys_version = ""
    timeout = _TIMEOUT_S
    _unread = 0

    def do_GET(self) -> None:
        if not self._allowed():
            return
        if self.path != "/health":
            self._fail(HTTPStatus.NOT_FOUND, f"no {self.path[:80]!r}; allowed: /health, /worlds")
            return
        self._send(HTTPStatus.OK, {"version": VERSION, "worlds": len(self.worlds), "limit": self.worlds.limit})

    def do_DELETE(self) -> None:
        parts = self.path.strip("/").split("/")
        if not self._allowed():
            return
        if len(parts) != 2 or parts[0] != "worlds":
            self._fail(HTTPStatus.NOT_FOUND, f"no {self.path[:80]!r}; allowed: /worlds/ID")
            return
        try:
            self.worlds.close(parts[1])
        except WorldGoneError as error:
            self._fail(HTTPStatus.NOT_FOUND, str(error))
        else:
            self._send(HTTPStatus.OK, {})

    def do_POST(self) -> None:
        if not self._allowed():
            return
        body = self._body()
        if body is None:
            return
        parts = self.path.strip("/").split("/")
        try:
            images = images_of(body)
            if parts == ["worlds"]:
                self._open(body, images)
            elif len(parts) == 3 and parts[0] == "worlds" and parts[2] == "step":
                self._send(HTTPStatus.OK, {"event": self.worlds.step(parts[1], body, images)})
            else:
                self._fail(HTTPStatus.NOT_FOUND, f"no {self.path[:80]!r}; allowed: /worlds, /worlds/ID/step")
        except (ProtocolError, WorldRefusedError) as error:
            self._fail(HTTPStatus.BAD_REQUEST, str(error))
        except WorldGoneError as error:
            self._fail(HTTPStatus.NOT_FOUND, str(error))
        except OverflowError as error:
            self._fail(HTTPStatus.SERVICE_UNAVAILABLE, str(error))
        except WorldOverError as error:
            self._fail(HTTPStatus.CONFLICT, str(error))
        except WorldBrokeError as error:
            self._fail(HTTPStatus.INTERNAL_SERVER_ERROR, str(error))
        except (EOFError, OSError):
            self._fail(HTTPStatus.INTERNAL_SERVER_ERROR, "the world's process ended before it answered")

    def _open(self, body: dict[str, Any], images: tuple[str, ...]) -> None:
        unknown = sorted(set(body) - set(CONTROLLER_ARGUMENTS))
        if unknown:
            raise ProtocolError(f"unknown argument {unknown[0][:80]!r}; allowed: {', '.join(CONTROLLER_ARGUMENTS)}")
        robot = body.get("robot_type", DEFAULT_ROBOT)
        if robot not in available_robots():  # a path would name a file of this machine
            raise ProtocolError(f"robot_type {str(robot)[:80]!r}; allowed: {', '.join(available_robots())}")
        name, event = self.worlds.open(body, images)
        if has_left(self.connection):  # while the world was opened; nobody else knows its name
            self.worlds.close(name)
            self.close_connection = True
            return
        self._send(HTTPStatus.OK, {"world": name, "event": event})

    def _body(self) -> dict[str, Any] | None:
        kind = self.headers.get("Content-Type", "").partition(";")[0].strip().lower()
        length = body_length(self.headers.get("Content-Length", ""))
        if kind != "application/json":
            self._fail(HTTPStatus.UNSUPPORTED_MEDIA_TYPE, f"Content-Type must be application/json, got {kind[:80]!r}")
            return None
        if length is None or length > _MAX_BODY:
            self._fail(HTTPStatus.REQUEST_ENTITY_TOO_LARGE, f"a body needs a Content-Length of at most {_MAX_BODY}")
            return None
        data = self.rfile.read(length)
        self._unread = 0
        self.arrived()
        try:
            return loads(data)
        except ProtocolError as error:
            self._fail(HTTPStatus.BAD_REQUEST, str(error))
            return None

    def _allowed(self) -> bool:
        if self.loopback and not self.is_for_here():
            self._fail(HTTPStatus.FORBIDDEN, f"Host {self.headers['Host'][:80]!r} is not this machine")
            return False
        if self.token is not None:
            scheme, _, shown = self.headers.get("Authorization", "").partition(" ")
            if scheme.lower() != "bearer" or not hmac.compare_digest(shown.strip().encode(), self.token.encode()):
                self._fail(HTTPStatus.UNAUTHORIZED, "Authorization: Bearer TOKEN is missing or wrong")
                return False
        return True

    def parse_request(self) -> bool:
        """Notes how long the body is, which an answer before it is read has to wait for."""
        fine = super().parse_request()
        self._unread = (body_length(self.headers.get("Content-Length", "")) or 0) if fine else 0
        return fine

    def _fail(self, status: HTTPStatus, message: str) -> None:
        self.close_connection = True
        left = min(self._unread, _MAX_DRAIN)  # a client that is still sending would not see the answer
        while left > 0 and (read := len(self.rfile.read(min(left, 1 << 16)))):
            left -= read
        self._send(status, {"error": message})

    def _send(self, status: HTTPStatus, value: Mapping[str, Any]) -> None:
        data = dumps(value)
        self.send_response(status)
        self.send_header("Content-Type", "application/json")
        self.send_header("Content-Length", str(len(data)))
        if status is HTTPStatus.UNAUTHORIZED:
            self.send_header("WWW-Authenticate", "Bearer")
        self.end_headers()
        self.wfile.write(data)

    def log_message(self, format: str, *args: Any) -> None:
        """Requests go to the log without headers, which may hold the token."""
        _LOG.debug(format, *args)
