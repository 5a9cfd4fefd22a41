"""OpenAI's chat completions as a server of one model reads and writes them: JSON to `ChatRequest`, `ChatReply` to JSON.

What would change the reply and cannot be honoured (tools, several choices, streaming, stop words, `top_p`) is refused, not
ignored. Pictures come inside the request as data URLs: nothing is fetched, no file is opened.

Paper: none (engineering).
"""

from __future__ import annotations

import base64
import binascii
import re
import time
import uuid
from collections.abc import Sequence
from typing import Annotated, Any, ClassVar, Final, Literal, cast

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from proprio_mllm.backends.protocol import ChatImage, ChatMessage, ChatReply, ChatRequest

__all__ = ["WireError", "completion", "error_object", "model_list", "read_request"]

_DATA_URL: Final = re.compile(r"data:(image/(?:png|jpeg));base64,(.*)", re.DOTALL)
_MAX_TOKENS: Final = 2048


class WireError(ValueError):
    """A request that gets an error instead of a completion.

    Args:
        message: what was expected and what came.
        status: of the HTTP reply.
        code: OpenAI's short name of the error, if it has one.
    """

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
    content: str | list[Annotated[_Text | _Picture, Field(discriminator="type")]]


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
        """The schema as it came."""
        return cls.given


def read_request(body: bytes, model: str, constrained: bool) -> ChatRequest:
    """A request, checked. Without a temperature it is 1, as OpenAI's is; a seed tells samples of one request apart.

    Args:
        body: JSON.
        model: name of the model that is served.
        constrained: whether replies can be held to a schema.

    Raises:
        WireError: with the fields that are wrong.
    """
    try:
        asked = _Body.model_validate_json(body)
    except ValidationError as error:
        raise WireError(_explained(error)) from error
    if asked.model != model:
        raise WireError(f"model {asked.model!r} is not served; allowed: {model}", 404, "model_not_found")
    longest = asked.max_completion_tokens or asked.max_tokens or _MAX_TOKENS
    temperature = 1.0 if asked.temperature is None else asked.temperature
    messages = tuple(_message(turn, f"messages.{index}") for index, turn in enumerate(asked.messages))
    return ChatRequest(messages, _schema(asked.response_format, constrained), longest, temperature, asked.seed or 0)


def _explained(error: ValidationError) -> str:
    """The first few wrong fields, and what was expected of each."""
    found = error.errors(include_url=False, include_input=False, include_context=False)
    lines = [f"{'.'.join(map(str, one['loc'])) or 'body'}: {one['msg']}" for one in found[:3]]
    return "; ".join(lines) + (f"; and {len(found) - 3} more" if len(found) > 3 else "")


def _message(turn: _Turn, where: str) -> ChatMessage:
    role = "system" if turn.role == "developer" else turn.role
    parts: Sequence[_Text | _Picture] = (
        [_Text(type="text", text=turn.content)] if isinstance(turn.content, str) else turn.content
    )
    if not parts:
        raise WireError(f"{where}.content: expected at least one part, got none")
    content = tuple(
        part.text if isinstance(part, _Text) else _picture(part.image_url.url, f"{where}.content.{index}")
        for index, part in enumerate(parts)
    )
    return ChatMessage(role, content)


def _picture(url: str, where: str) -> ChatImage:
    found = _DATA_URL.fullmatch(url)
    if found is None:
        raise WireError(f"{where}: expected data:image/png;base64,... or data:image/jpeg;base64,..., got {url[:40]!r}")
    try:
        data = base64.b64decode(found[2], validate=True)
    except binascii.Error as error:
        raise WireError(f"{where}: the picture is not base64: {error}") from error
    return ChatImage(data, cast(Literal["image/png", "image/jpeg"], found[1]))


def _schema(asked: _Format | None, constrained: bool) -> type[BaseModel] | None:
    if asked is None or asked.type == "text":
        return None
    if asked.json_schema is None:
        raise WireError("response_format.json_schema: missing")
    if not constrained:
        raise WireError(
            "response_format.type: this server cannot hold replies to a schema; allowed: text. Start it with constrained=true"
        )
    return type(asked.json_schema.name, (_Given,), {"given": asked.json_schema.json_schema, "__module__": __name__})


def completion(reply: ChatReply, model: str) -> dict[str, Any]:
    """The `chat.completion` object of a reply; `system_fingerprint` is the exact revision."""
    refused = reply.finish_reason == "refusal"
    return {
        "id": f"chatcmpl-{uuid.uuid4().hex}",
        "object": "chat.completion",
        "created": int(time.time()),
        "model": model,
        "system_fingerprint": reply.model,
        "choices": [
            {
                "index": 0,
                "message": {
                    "role": "assistant",
                    "content": None if refused else reply.text,
                    "refusal": reply.text if refused else None,
                },
                "logprobs": None,
                "finish_reason": "content_filter" if refused else reply.finish_reason,
            }
        ],
        "usage": {
            "prompt_tokens": reply.prompt_tokens,
            "completion_tokens": reply.completion_tokens,
            "total_tokens": reply.prompt_tokens + reply.completion_tokens,
        },
    }


def model_list(model: str, since: int, revision: str = "") -> dict[str, Any]:
    """The list of the one model.

    Args:
        model: its name.
        since: when it was loaded, in seconds of Unix time.
        revision: which weights these are; OpenAI's format has no such field, clients that do not know it pass over it.
    """
    card = {"id": model, "object": "model", "created": since, "owned_by": "local"}
    return {"object": "list", "data": [card | ({"revision": revision} if revision else {})]}


def error_object(message: str, status: int, code: str | None = None) -> dict[str, Any]:
    """OpenAI's error object."""
    kind = "invalid_request_error" if status < 500 else "server_error"
    return {"error": {"message": message, "type": kind, "param": None, "code": code}}
