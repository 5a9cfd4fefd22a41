"""What the answer of an OpenAI-compatible server means: a reply, a refusal, or a failure and whose matter it is.

Of a chat completion only what is needed is looked at and checked, so that servers which leave out or add fields can be used.
Usage that is absent or makes no sense counts as unknown, 0 tokens. Tokens of hidden thoughts are charged as written ones; of
servers that count them in the total alone (Gemini) the total is read.

A failure, by status and cause:

- no key, a wrong one, an unknown model or path, a redirect, no money left: `BackendSetupError`;
- 400 and 422 are read: about the key, the model or a parameter that every call sends, `BackendSetupError`; a content policy is
  a refusal, which is a reply; the rest (a prompt too long, a picture that cannot be read) is this request's, `BackendError`;
- 408, 409, 413, 429, 5xx: `BackendError`; no connection: `UnreachableError`;
- time-outs, connections that break, gateways that got no answer, bodies too long: `LostReplyError`, since it may be charged.

Format: OpenAI's API reference, object `chat.completion`. Errors come as an object `error`, the same in a list (Gemini),
`message` or `detail` alone (vLLM), or a page. Paper: none (engineering).
"""

from __future__ import annotations

import contextlib
import json
import re
from collections.abc import Mapping
from typing import Any, Final

import httpx2
import openai
from pydantic import BaseModel, Field, ValidationError

from proprio_mllm.backends.connection import ReplyTooLongError
from proprio_mllm.backends.protocol import (
    BackendError,
    BackendSetupError,
    ChatReply,
    FinishReason,
    LostReplyError,
    UnreachableError,
)

_FINISHED: Final[Mapping[str, FinishReason]] = {
    "length": "length",
    "max_tokens": "length",
    **dict.fromkeys(("content_filter", "refusal", "safety", "recitation", "prohibited_content"), "refusal"),
}
#: Ends of replies that are neither whole nor cut at their limit.
_BROKEN: Final = frozenset({"error", "abort"})
#: More tokens than any call has; a count above it makes no sense.
_MOST_TOKENS: Final = 10**9
#: Longest name of a model; it goes into every ledger line and table.
_NAME_CHARACTERS: Final = 200

_OF_EVERY_CALL: Final = frozenset({401, 402, 403, 404, 405, 410, 415, 501})
_OF_A_REQUEST: Final = frozenset({400, 422})
_OF_A_GATEWAY: Final = frozenset({502, 504})
_POLICY: Final = re.compile(
    r"content_filter|content_policy|content policy|content management policy|safety system|invalid_prompt"
)
_TOO_LONG: Final = re.compile(
    r"context.?length|context window|too long|too large|token count|token limit|exceeds? the max|reduce the length"
)
_SETUP: Final = re.compile(
    r"api.?key|model_not_found|invalid_model|unknown model|model\b.{0,120}\b(not found|not exist|not supported|unknown)"
    r"|unsupported_|unsupported (parameter|value)|unknown_parameter|unrecognized request argument"
    r"|response_format|invalid schema|location is not supported|billing"
)
_NO_MONEY: Final = re.compile(r"insufficient_quota|billing")
#: Errors in which nothing was sent.
_UNSENT: Final = (httpx2.ConnectError, httpx2.ConnectTimeout, httpx2.PoolTimeout, httpx2.ProxyError)


class _Part(BaseModel):
    type: str | None = "text"
    text: str | None = None


class _Message(BaseModel):
    content: str | list[_Part] | None = None
    refusal: str | None = None


class _Choice(BaseModel):
    message: _Message
    finish_reason: Any = None


class _Completion(BaseModel):
    choices: list[_Choice] = Field(min_length=1)
    model: str | None = None
    system_fingerprint: str | None = None
    usage: Any = None


def read_completion(body: bytes, content_type: str | None) -> ChatReply:
    """A reply without its latency and cost.

    Args:
        body: of a response with status 200.
        content_type: of its header.

    Raises:
        LostReplyError: when it is no chat completion; the message names why and holds what the server sent.
    """
    kind = (content_type or "application/json").partition(";")[0].strip().lower()
    sent = _line(body.decode(errors="replace"))
    if kind != "application/json" and not kind.endswith("+json"):
        raise LostReplyError(f"the reply is {kind!r}, not JSON: {sent}")
    with contextlib.suppress(ValueError, RecursionError):  # pydantic says below why it is no JSON
        # A reply that was cut inside a character can spell half of a surrogate pair, which UTF-8 cannot.
        body = json.dumps(json.loads(body), ensure_ascii=False).encode(errors="replace")
    try:
        completion = _Completion.model_validate_json(body)
    except ValidationError as error:
        first = error.errors(include_url=False, include_context=False)[0]
        why = ": ".join(filter(None, (".".join(map(str, first["loc"])), first["msg"])))
        raise LostReplyError(f"the reply is no chat completion: {why}: {sent}") from None
    choice = completion.choices[0]
    finished = str(choice.finish_reason or "stop").lower()
    if finished in _BROKEN:
        raise LostReplyError(f"the reply broke off with finish_reason {finished!r}")
    text, refusal = choice.message.content or "", choice.message.refusal
    if isinstance(text, list):
        text = "".join(part.text or "" for part in text if part.type == "text")
    # A fingerprint that names the model, as this project's server gives it, says both.
    model, fingerprint = completion.model or "", completion.system_fingerprint or ""
    return ChatReply(
        text or refusal or "",
        *_usage(completion.usage),
        finish_reason="refusal" if refusal else _FINISHED.get(finished, "stop"),
        model=shown_name(fingerprint if fingerprint.startswith(f"{model}@") else f"{model} {fingerprint}"),
    )


def shown_name(text: str) -> str:
    """A name that a server tells, in one line, without what a terminal would obey, and not too long."""
    return "".join(character for character in _line(text) if character.isprintable())[:_NAME_CHARACTERS]


def is_refusal(error: openai.OpenAIError) -> bool:
    """Whether a server did not let a request through to the model for what it says."""
    if not isinstance(error, openai.APIStatusError) or error.status_code not in _OF_A_REQUEST:
        return False
    return _POLICY.search(" ".join(_said(error.body)).lower()) is not None


def failure_of(error: openai.OpenAIError, timeout_s: float, retries: int) -> BackendError:
    """The error that a call ends with; its text holds all that the server said, a key that it echoes included.

    Args:
        error: of the OpenAI client.
        timeout_s: of one attempt.
        retries: that the client makes.
    """
    after = f"after {retries + 1} attempt{'s' if retries else ''}"
    if isinstance(error, openai.APIStatusError):
        return _status_failure(error, after)
    if isinstance(error, ReplyTooLongError):
        return LostReplyError(str(error))
    cause = error.__cause__ or error
    why = f"{type(cause).__name__}: {cause}"
    if isinstance(cause, (httpx2.UnsupportedProtocol, httpx2.LocalProtocolError)):
        return BackendSetupError(f"cannot ask: {why}")
    if isinstance(cause, _UNSENT):
        return UnreachableError(f"no connection {after}: {why}")
    if isinstance(error, openai.APITimeoutError):
        return LostReplyError(f"no reply within {timeout_s:g} s, {after}")
    return LostReplyError(f"the connection broke, {after}: {why}")


def _status_failure(error: openai.APIStatusError, after: str) -> BackendError:
    status = error.status_code
    code, message = _said(error.body)
    told = ": ".join(part for part in (f"HTTP {status}", code, message) if part)
    words = f"{code} {message}".lower()
    if 300 <= status < 400:
        return BackendSetupError(f"HTTP {status}: the server sends elsewhere, to {error.response.headers.get('location')}")
    if status in _OF_EVERY_CALL or (status == 429 and _NO_MONEY.search(words)):
        return BackendSetupError(told)
    if status in _OF_A_REQUEST and _SETUP.search(words) and not _TOO_LONG.search(words):
        return BackendSetupError(told)
    if status in _OF_A_GATEWAY:
        return LostReplyError(f"{told} ({after})")
    return BackendError(f"{told} ({after})" if status in (408, 409, 429) or status >= 500 else told)


def _usage(usage: object) -> tuple[int, int]:
    """Tokens read and written; (0, 0) when they are not known."""
    if not isinstance(usage, Mapping):
        return 0, 0
    prompt: Any = usage.get("prompt_tokens")
    written: Any = usage.get("completion_tokens", 0)
    total: Any = usage.get("total_tokens", 0)
    if any(type(count) is not int or not 0 <= count <= _MOST_TOKENS for count in (prompt, written, total)):
        return 0, 0
    return prompt, max(written, total - prompt)


def _said(body: object) -> tuple[str, str]:
    """Code and message of an error's body, each perhaps empty, in one line."""
    if isinstance(body, list) and body:
        body = body[0]
    if isinstance(body, Mapping) and isinstance(body.get("error"), Mapping | str):
        body = body["error"]
    if not isinstance(body, Mapping):
        return "", _line(body)
    names = [body[name] for name in ("code", "type", "status", "param") if isinstance(body.get(name), str)]
    return _line(" ".join(names)), _line(body.get("message") or body.get("detail"))


def _line(text: object) -> str:
    return "" if text is None else " ".join(str(text).split())
