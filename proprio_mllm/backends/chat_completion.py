"""What a server's chat completion says, read from its bytes.

Only what is needed is looked at, so that servers which leave out or add fields can be used; what is needed is checked. Usage
that is absent or makes no sense counts as unknown, 0 tokens. Tokens of hidden thoughts are charged as written ones; of servers
that count them in the total alone (Gemini) the total is read.

Format: OpenAI's API reference, object `chat.completion`. Paper: none (engineering).
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from typing import Any, Final

from pydantic import BaseModel, Field, ValidationError

from proprio_mllm.backends.protocol import ChatReply, FinishReason, LostReplyError

__all__ = ["read_completion", "read_usage", "shown_name"]

_FINISHED: Final[Mapping[str, FinishReason]] = {
    "length": "length",
    "max_tokens": "length",
    "content_filter": "refusal",
    "refusal": "refusal",
    "safety": "refusal",
    "recitation": "refusal",
    "prohibited_content": "refusal",
}
_SURROGATE: Final = re.compile(rb"\\u[dD][89a-fA-F]")
#: More tokens than any call has; a count above it makes no sense.
_MOST_TOKENS: Final = 10**9
#: Longest name of a model; it goes into every ledger line and table.
_NAME_CHARACTERS: Final = 200
#: Ends of replies that are neither whole nor cut at their limit.
_BROKEN: Final = frozenset({"error", "abort"})


class _Part(BaseModel):
    type: str | None = "text"
    text: str | None = None


class _Message(BaseModel):
    content: str | list[_Part] | None = None
    refusal: str | None = None

    @property
    def text(self) -> str:
        """The content; of parts, as some servers send, the texts among them."""
        if isinstance(self.content, list):
            return "".join(part.text or "" for part in self.content if part.type == "text")
        return self.content or ""


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
    if kind != "application/json" and not kind.endswith("+json"):
        raise LostReplyError(f"the reply is {kind!r}, not JSON: {_text(body)}")
    try:
        completion = _Completion.model_validate_json(_whole(body))
    except ValidationError as error:
        first = error.errors(include_url=False, include_context=False)[0]
        where = ".".join(map(str, first["loc"]))
        raise LostReplyError(
            f"the reply is no chat completion: {where + ': ' if where else ''}{first['msg']}: {_text(body)}"
        ) from None
    choice = completion.choices[0]
    finished = str(choice.finish_reason or "stop").lower()
    if finished in _BROKEN:
        raise LostReplyError(f"the reply broke off with finish_reason {finished!r}")
    prompt_tokens, completion_tokens = read_usage(completion.usage)
    return ChatReply(
        text=choice.message.text or choice.message.refusal or "",
        prompt_tokens=prompt_tokens,
        completion_tokens=completion_tokens,
        finish_reason="refusal" if choice.message.refusal else _FINISHED.get(finished, "stop"),
        model=shown_name(_answered(completion.model or "", completion.system_fingerprint or "")),
    )


def _answered(model: str, fingerprint: str) -> str:
    """Model and exact revision; a fingerprint that names the model, as this project's server gives it, says both."""
    return fingerprint if fingerprint.startswith(f"{model}@") else f"{model} {fingerprint}".strip()


def read_usage(usage: object) -> tuple[int, int]:
    """Tokens read and written; (0, 0) when they are not known."""
    if not isinstance(usage, Mapping):
        return 0, 0
    prompt, written = usage.get("prompt_tokens"), usage.get("completion_tokens", 0)
    total = usage.get("total_tokens", 0)
    counts = [
        count
        for count in (prompt, written, total)
        if isinstance(count, int) and not isinstance(count, bool) and 0 <= count <= _MOST_TOKENS
    ]
    if len(counts) < 3:
        return 0, 0
    return counts[0], max(counts[1], counts[2] - counts[0])


def _whole(body: bytes) -> bytes:
    """A body without halves of surrogate pairs, which a reply that was cut inside a character can spell and UTF-8 cannot."""
    if _SURROGATE.search(body) is None:
        return body
    try:
        return json.dumps(json.loads(body), ensure_ascii=False).encode(errors="replace")
    except (ValueError, RecursionError):
        return body  # no JSON; the parser below says why


def shown_name(text: str) -> str:
    """A name that a server tells, in one line, without what a terminal would obey, and not too long."""
    return "".join(character for character in " ".join(text.split()) if character.isprintable())[:_NAME_CHARACTERS]


def _text(body: bytes) -> str:
    return " ".join(body.decode(errors="replace").split())
