"""An HTTP server that answers OpenAI's chat completions with one backend, on the loopback interface.

`POST /v1/chat/completions` and `GET /v1/models`. One thread per call; the backend gathers them into batches. A request that is
wrong gets 4xx, one that the backend could not answer 503, both as OpenAI's error object. What would change the reply and cannot
be honoured (tools, several choices, streaming, stop words, `top_p`) is refused, not ignored. Pictures come inside the request
as data URLs: nothing is fetched, no file is opened. Left out: keys, TLS. Paper: none (engineering).
"""

from __future__ import annotations

import base64
import binascii
import json
import logging
import re
import socket
import time
import uuid
from typing import Annotated, Any, ClassVar, Final, Literal, cast

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from data.http_limits import LimitedHandler, LimitedServer, body_length
from proprio_mllm.backends.protocol import Backend, BackendError, ChatImage, ChatMessage, ChatReply, ChatRequest, RequestError

logger = logging.getLogger(__name__)

#: Longest request, bytes; a picture of 500 pixels squared takes about 0.5 MB.
_BODY_BYTES: Final = 32 * 2**20
_MAX_TOKENS: Final = 2048
_DATA_URL: Final = re.compile(r"data:(image/(?:png|jpeg));base64,(.*)", re.DOTALL)
_CHAT, _MODELS = "/v1/chat/completions", "/v1/models"
_METHODS: Final = {_CHAT: "POST", _MODELS: "GET"}


class RefusedError(ValueError):
    """A call that gets an error instead of a completion, with the HTTP reply's status and OpenAI's short name of the error."""

    def __init__(self, message: str, status: int = 400, code: str | None = None) -> None:
        super().__init__(message)
        self.status = status
        self.code = code


class _Strict(BaseModel):
    """Refuses fields that it does not declare."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class _Text(_Strict):
    type: Literal["text"]
    text: str


class _Url(_Strict):
    url: str
    detail: Literal["auto", "low", "high"] = "auto"


class _Picture(_Strict):
    type: Literal["image_url"]
    image_url: _Url


class _Turn(_Strict):
    role: Literal["system", "developer", "user", "assistant"]
    content: str | Annotated[list[Annotated[_Text | _Picture, Field(discriminator="type")]], Field(min_length=1)]


class _Schema(_Strict):
    name: str
    description: str | None = None
    json_schema: dict[str, Any] = Field(alias="schema")
    strict: bool | None = None


class _Format(_Strict):
    type: Literal["text", "json_schema"]
    json_schema: _Schema | None = None


class _Body(_Strict):
    model: str
    messages: list[_Turn] = Field(min_length=1)
    max_tokens: int | None = Field(default=None, ge=1)
    max_completion_tokens: int | None = Field(default=None, ge=1)
    temperature: float | None = Field(default=None, ge=0.0, le=2.0)
    seed: int | None = Field(default=None, ge=0)
    n: Literal[1] | None = None
    stream: Literal[False] | None = None
    response_format: _Format | None = None
    user: str | None = None


class _Given(BaseModel):
    """Stands for a schema that came as JSON."""

    given: ClassVar[dict[str, Any]] = {}

    @classmethod
    def model_json_schema(cls, *args: Any, **kwargs: Any) -> dict[str, Any]:
        return cls.given


class ChatServer(LimitedServer):
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


class _Handler(LimitedHandler):
    """One call on one connection."""

    protocol_version = "HTTP/1.1"
    timeout = 10.0  # seconds that a client may take to send its next bytes

    def do_GET(self) -> None:
        self.close_connection = True
        try:
            self._send(*self._outcome())
        except OSError as error:
            logger.debug("the client has gone: %s", error)

    def do_POST(self) -> None:
        self.do_GET()

    def log_message(self, format: str, *args: Any) -> None:
        logger.debug(format, *args)

    def _outcome(self) -> tuple[int, dict[str, Any]]:
        """HTTP status and content of the answer."""
        try:
            return 200, self._reply()
        except RefusedError as error:
            status, message, code = error.status, str(error), error.code
        except RequestError as error:
            status, message, code = 400, str(error), None
        except BackendError as error:
            status, message, code = 503, str(error), None
        except TimeoutError:
            status, message, code = 408, f"the request did not arrive within {self.timeout:g} s", None
        kind = "invalid_request_error" if status < 500 else "server_error"
        return status, {"error": {"message": message, "type": kind, "param": None, "code": code}}

    def _reply(self) -> dict[str, Any]:
        if not self.is_for_here():
            raise RefusedError(f"Host {self.headers['Host'][:80]!r} is not this machine", 403)
        path = self.path.partition("?")[0]
        if path not in _METHODS:
            raise RefusedError(f"no such path: {path}; allowed: {', '.join(_METHODS)}", 404)
        if self.command != _METHODS[path]:
            raise RefusedError(f"{path} takes {_METHODS[path]}, not {self.command}", 405)
        server = self.server
        assert isinstance(server, ChatServer)
        if path == _MODELS:
            return model_list(server.name, server.since, server.revision)
        return completion(server.backend.complete(read_request(self._body(), server.name, server.constrained)), server.name)

    def _body(self) -> bytes:
        """The request's body. Only JSON is read: a web page cannot send that here without asking first."""
        if self.headers.get_content_type() != "application/json":
            raise RefusedError(f"Content-Type {self.headers.get_content_type()!r}; expected application/json", 415)
        told = self.headers.get("Content-Length", "")
        length = body_length(told)
        if length is None:
            raise RefusedError(f"Content-Length {told[:80]!r}; expected a number", 411)
        if length > _BODY_BYTES:
            raise RefusedError(f"request of {length} bytes; allowed: {_BODY_BYTES}", 413)
        body = self.rfile.read(length)
        self.arrived()
        return body

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
            while dropped < 4 * _BODY_BYTES and (part := self.connection.recv(2**16)):
                dropped += len(part)


def read_request(body: bytes, model: str, constrained: bool) -> ChatRequest:
    """A request, checked. Without a temperature it is 1, as OpenAI's is; a seed tells samples of one request apart.

    Args:
        body: JSON.
        model: name of the model that is served.
        constrained: whether replies can be held to a schema.

    Raises:
        RefusedError: with the fields that are wrong.
    """
    try:
        asked = _Body.model_validate_json(body)
    except ValidationError as error:
        wrong = error.errors(include_url=False, include_input=False, include_context=False)
        lines = [f"{'.'.join(map(str, one['loc'])) or 'body'}: {one['msg']}" for one in wrong[:3]]
        more = f"; and {len(wrong) - 3} more" if len(wrong) > 3 else ""
        raise RefusedError("; ".join(lines) + more) from error
    if asked.model != model:
        raise RefusedError(f"model {asked.model!r} is not served; allowed: {model}", 404, "model_not_found")
    return ChatRequest(
        tuple(_message(turn, f"messages.{index}") for index, turn in enumerate(asked.messages)),
        _schema(asked.response_format, constrained),
        asked.max_completion_tokens or asked.max_tokens or _MAX_TOKENS,
        1.0 if asked.temperature is None else asked.temperature,
        asked.seed or 0,
    )


def _message(turn: _Turn, where: str) -> ChatMessage:
    parts = [turn.content] if isinstance(turn.content, str) else turn.content
    content: list[str | ChatImage] = []
    for index, part in enumerate(parts):
        if isinstance(part, _Picture):
            content.append(_picture(part.image_url.url, f"{where}.content.{index}"))
        else:
            content.append(part if isinstance(part, str) else part.text)
    return ChatMessage("system" if turn.role == "developer" else turn.role, tuple(content))


def _picture(url: str, where: str) -> ChatImage:
    found = _DATA_URL.fullmatch(url)
    if found is None:
        raise RefusedError(f"{where}: expected data:image/png;base64,... or data:image/jpeg;base64,..., got {url[:40]!r}")
    try:
        data = base64.b64decode(found[2], validate=True)
    except binascii.Error as error:
        raise RefusedError(f"{where}: the picture is not base64: {error}") from error
    return ChatImage(data, cast(Literal["image/png", "image/jpeg"], found[1]))


def _schema(asked: _Format | None, constrained: bool) -> type[BaseModel] | None:
    if asked is None or asked.type == "text":
        return None
    if asked.json_schema is None:
        raise RefusedError("response_format.json_schema: missing")
    if not constrained:
        raise RefusedError(
            "response_format.type: this server cannot hold replies to a schema; allowed: text. Start it with constrained=true"
        )
    return type(asked.json_schema.name, (_Given,), {"given": asked.json_schema.json_schema, "__module__": __name__})


def completion(reply: ChatReply, model: str) -> dict[str, Any]:
    """The `chat.completion` object of a reply; `system_fingerprint` is the exact revision."""
    refused = reply.finish_reason == "refusal"
    said = {"content": None, "refusal": reply.text} if refused else {"content": reply.text, "refusal": None}
    choice = {
        "index": 0,
        "message": {"role": "assistant", **said},
        "logprobs": None,
        "finish_reason": "content_filter" if refused else reply.finish_reason,
    }
    return {
        "id": f"chatcmpl-{uuid.uuid4().hex}",
        "object": "chat.completion",
        "created": int(time.time()),
        "model": model,
        "system_fingerprint": reply.model,
        "choices": [choice],
        "usage": {
            "prompt_tokens": reply.prompt_tokens,
            "completion_tokens": reply.completion_tokens,
            "total_tokens": reply.prompt_tokens + reply.completion_tokens,
        },
    }


def model_list(model: str, since: int, revision: str = "") -> dict[str, Any]:
    """The list of the one model, loaded at `since` in seconds of Unix time.

    `revision` tells which weights these are; OpenAI's format has no such field, clients that do not know it pass over it.
    """
    card = {"id": model, "object": "model", "created": since, "owned_by": "local"}
    return {"object": "list", "data": [card | ({"revision": revision} if revision else {})]}
