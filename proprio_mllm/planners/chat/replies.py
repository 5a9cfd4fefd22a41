"""What models are asked to reply: pydantic models, and how a text becomes one of them.

Every reply is validated here, whatever the server promised. JSON may stand in a code fence or after other text: the first
object that is complete counts. Nothing is repaired, but that half a character becomes `?`.
"""

from __future__ import annotations

import json
from typing import TypeVar

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from interface.steps import ActionError, PlanStep
from proprio_mllm.backends.protocol import ChatReply

T = TypeVar("T", bound=BaseModel)
#: Longest reply that is searched for JSON, characters, and most places in it that are tried.
_LONGEST = 200_000
_TRIED = 1000


class ReplyError(ValueError):
    """A reply that is not what was asked for; the message says how."""


class Plan(BaseModel):
    """The next steps, in order."""

    model_config = ConfigDict(extra="ignore")

    reasoning: str = Field(default="", description="what the situation is and why these steps, in one or two sentences")
    steps: list[str] = Field(description="the next steps in order, each written in the action grammar")


class Reflection(BaseModel):
    """What went wrong, and the steps that follow from it."""

    model_config = ConfigDict(extra="ignore")

    cause: str = Field(description="why the last step failed")
    change: str = Field(description="what has to be done differently")
    steps: list[str] = Field(description="the next steps in order, each written in the action grammar")


def read_reply(reply: ChatReply, schema: type[T]) -> T:
    """A model's reply as the object that was asked for.

    Raises:
        ReplyError: when the reply is refused, cut off, empty, not JSON, or not of the schema.
    """
    if reply.finish_reason == "refusal":
        raise ReplyError(f"refused: {_short(reply.text)}")
    if reply.finish_reason == "length":
        raise ReplyError(f"truncated after {reply.completion_tokens} tokens")
    if not reply.text.strip():
        raise ReplyError("empty reply")
    value = read_json(reply.text)
    try:
        return schema.model_validate(value)
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False)[0]
        where = ".".join(map(str, first["loc"])) or "reply"
        raise ReplyError(f"{where}: {first['msg']}") from None


def read_json(text: str) -> object:
    """The first complete JSON object in a text.

    Raises:
        ReplyError: when there is none.
    """
    decoder = json.JSONDecoder()
    text = text[:_LONGEST]
    start = -1
    for _ in range(_TRIED):
        start = text.find("{", start + 1)
        if start < 0:
            break
        try:
            value = decoder.raw_decode(text, start)[0]
            # an escape can spell half a character, which neither a prompt nor a file can hold
            return json.loads(json.dumps(value, ensure_ascii=False).encode(errors="replace"))
        except (ValueError, RecursionError):  # not JSON, or a number of more digits than Python reads
            continue
    raise ReplyError(f"no JSON object in {_short(text)}")


def read_steps(texts: list[str], limit: int) -> tuple[PlanStep, ...]:
    """Steps of a reply, the first `limit` of them.

    Raises:
        ReplyError: when there is none, or one is not of the grammar.
    """
    if not texts:
        raise ReplyError("no steps")
    try:
        return tuple(PlanStep.parse(text) for text in texts[:limit])
    except ActionError as error:
        raise ReplyError(str(error)) from None


def _short(text: str) -> str:
    return repr(" ".join(text.split())[:80])
