"""The Controller of a server elsewhere, with the same calls and events as `sim.interfaces.controller.Controller`."""

from __future__ import annotations

import http.client
import json
import time
import urllib.error
import urllib.parse
import urllib.request
from collections.abc import Mapping, Sequence
from typing import Any, Final

from configs.schema.checks import is_loopback
from sim.interfaces.controller import Event, Stopped
from sim.interfaces.remote.protocol import IMAGES, decode_event, dumps

#: Pauses before a server that nobody listens for is tried again: it may be starting.
_PAUSES_S: Final = (0.5, 1.5)


class RemoteError(RuntimeError):
    """The server cannot be reached or does not answer as expected; the message says what it said."""


class RemoteController(Stopped):
    """Drives a world of a server.

    Args:
        url: address of the server.
        token: what the server wants to be shown, None for nothing.
        images: what events carry, subset of `sim.interfaces.remote.protocol.IMAGES`.
        timeout_s: longest wait for an answer.
        arguments: arguments of `sim.interfaces.controller.Controller`.

    Attributes:
        last_event: the latest event.

    Raises:
        ValueError: when the Controller there refuses the arguments.
        RemoteError: when the server cannot be reached, refuses the token, or has no room.
    """

    def __init__(
        self,
        url: str = "http://127.0.0.1:8265",
        token: str | None = None,
        images: Sequence[str] = IMAGES,
        timeout_s: float = 330.0,
        **arguments: Any,
    ) -> None:
        self._url, self._token, self._images, self._timeout_s = url.rstrip("/"), token, list(images), timeout_s
        here = is_loopback(urllib.parse.urlsplit(self._url).hostname or "")
        proxies = [urllib.request.ProxyHandler({})] if here else []
        self._opener = urllib.request.build_opener(_Staying, *proxies)
        self._world: str | None = None
        opened = self._ask("POST", "/worlds", arguments | {"images": self._images})
        self._world, self.last_event = str(opened.get("world", "")), self._event(opened)

    def step(self, action: str | Mapping[str, Any] | None = None, raise_for_failure: bool = False, **arguments: Any) -> Event:
        """As `Controller.step`.

        Raises:
            ValueError: as there.
            RuntimeError: as there; RemoteError when the world is gone or the server cannot be reached.
        """
        call: dict[str, Any] = dict(action) if isinstance(action, Mapping) else {"action": action}
        call |= arguments
        answer = self._ask("POST", f"/worlds/{self._world}/step", call | {"images": self._images})
        self.last_event = self._event(answer)
        return self.last_event.raise_for_failure() if raise_for_failure else self.last_event

    def reset(self, scene: str | None = None, seed: int | None = None) -> Event:
        """As `Controller.reset`."""
        chosen = {key: value for key, value in (("scene", scene), ("seed", seed)) if value is not None}
        return self.step({"action": "Reset", **chosen})

    def stop(self) -> None:
        """Closes the world; a world that is gone already is no error."""
        if self._world is not None:
            world, self._world = self._world, None
            try:
                self._ask("DELETE", f"/worlds/{world}", None)
            except RemoteError:
                return

    def _event(self, answer: Mapping[str, Any]) -> Event:
        try:
            return decode_event(answer["event"])
        except (KeyError, TypeError, ValueError, IndexError, OSError) as error:
            raise RemoteError(f"{self._url}: the answer holds no event: {type(error).__name__}: {error}") from None

    def _ask(self, method: str, path: str, body: Mapping[str, Any] | None) -> dict[str, Any]:
        headers = {"Content-Type": "application/json"}
        if self._token is not None:
            headers["Authorization"] = f"Bearer {self._token}"
        try:
            data = None if body is None else dumps(body)
        except (TypeError, ValueError) as error:
            raise ValueError(f"the call cannot be sent as JSON: {error}") from None
        request = urllib.request.Request(self._url + path, data, headers, method=method)
        for pause_s in (*_PAUSES_S, None):
            try:
                with self._opener.open(request, timeout=self._timeout_s) as reply:
                    return _object(reply.read())
            except urllib.error.HTTPError as error:
                message = _message(error)
                if error.code == 400:
                    raise ValueError(message) from None
                if error.code == 409:
                    raise RuntimeError(message) from None
                raise RemoteError(f"{self._url}: {error.code}: {message}") from None
            except (OSError, http.client.HTTPException, ValueError) as error:
                reason = getattr(error, "reason", error)
                # only a call that has not been heard may be made again
                if pause_s is None or not isinstance(reason, ConnectionRefusedError):
                    raise RemoteError(f"{self._url} cannot be reached, or makes no sense: {reason}") from None
                time.sleep(pause_s)
        raise AssertionError("unreachable")


class _Staying(urllib.request.HTTPRedirectHandler):
    """Follows no redirection: the token is for this server alone."""

    def redirect_request(self, *args: Any, **kwargs: Any) -> None:
        return None


def _object(data: bytes) -> dict[str, Any]:
    value = json.loads(data)
    if not isinstance(value, dict):
        raise ValueError(f"the answer is {type(value).__name__}, no JSON object")
    return value


def _message(error: urllib.error.HTTPError) -> str:
    try:
        return str(json.loads(error.read())["error"])
    except (ValueError, KeyError, TypeError):
        return str(error.reason)
