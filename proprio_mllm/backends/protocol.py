"""What a backend is: it answers one chat request at a time, from any thread, and says what the answer cost.

A reply is whatever the model said, cut off, empty or refused replies included; what a planner makes of it is the planner's
matter. What keeps a model from answering (time-outs, overload, broken connections) is a `BackendError`: the episode becomes an
infrastructure error, which is run again and never scored. `BackendSetupError` is one that every further call would meet too
(a wrong key, an unknown model): the run stops.

Paper: baselines of Table II. The paper calls its models through their vendors' APIs at temperature 0 with at most 2,048 tokens.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from typing import Literal, Protocol, runtime_checkable

from pydantic import BaseModel

#: How a reply ended: by itself, cut off at `max_tokens`, or refused by the model or its filter.
FinishReason = Literal["stop", "length", "refusal"]


class BackendError(RuntimeError):
    """A call that got no reply; the message names the backend and the cause, and never a key."""


class BackendSetupError(BackendError):
    """A call that no repetition mends: no key, a wrong one, an unknown model or URL."""


class RequestError(BackendError):
    """A request that the model cannot take, however often it is asked: too long, or a picture that cannot be read."""


class LostReplyError(BackendError):
    """A call that was sent and whose reply did not come whole, or made no sense: it may have been charged."""


class UnreachableError(BackendError):
    """A call that reached no server, all attempts of it: when none ever was answered, it may well be the wrong address."""


class CostCapError(BackendError):
    """A call that might cost more than the run may still spend."""


@dataclass(frozen=True, slots=True)
class ChatImage:
    """An encoded picture, sent as these bytes.

    Attributes:
        data: of a PNG or JPEG file.
        media_type: which of them.
    """

    data: bytes
    media_type: Literal["image/png", "image/jpeg"] = "image/png"

    @property
    def digest(self) -> str:
        """SHA-256 of the bytes."""
        return hashlib.sha256(self.data).hexdigest()


@dataclass(frozen=True, slots=True)
class ChatMessage:
    """One turn: texts and pictures in order."""

    role: Literal["system", "user", "assistant"]
    content: tuple[str | ChatImage, ...]

    @property
    def text(self) -> str:
        """The texts, a blank line between them."""
        return "\n\n".join(part for part in self.content if isinstance(part, str))


@dataclass(frozen=True)
class ChatRequest:
    """A question to a model.

    Attributes:
        messages: the conversation.
        schema: what the reply has to be, as JSON; None for free text. Servers that can are asked to keep to it; the asker
            validates every reply anyway.
        max_tokens: longest reply.
        temperature: 0 asks for the most likely reply.
        sample: which of several samples of one request this is; part of the cache's key when the temperature is above 0.
        purpose: what the call is for, such as `plan` or `reflection`; counted, not sent.
    """

    messages: tuple[ChatMessage, ...]
    schema: type[BaseModel] | None = None
    max_tokens: int = 2048
    temperature: float = 0.0
    sample: int = 0
    purpose: str = "plan"


@dataclass(frozen=True, slots=True)
class ChatReply:
    """What a model answered.

    Attributes:
        text: the reply; empty when there was none.
        prompt_tokens: tokens read, as the model counts them.
        completion_tokens: tokens written.
        latency_s: seconds from question to reply; of a cached reply those it took when it was made.
        finish_reason: how it ended.
        model: exact model or revision that answered, as it names itself.
        cost_usd: price of the call by the price table; 0 where nothing is charged, None where the price is not known.
        cached: whether it comes from the cache, and so has cost nothing now.
    """

    text: str
    prompt_tokens: int = 0
    completion_tokens: int = 0
    latency_s: float = 0.0
    finish_reason: FinishReason = "stop"
    model: str = ""
    cost_usd: float | None = 0.0
    cached: bool = False


@runtime_checkable
class Backend(Protocol):
    """Answers chats. `complete` may be called by several threads at once."""

    @property
    def identity(self) -> str:
        """Model, revision and whatever else decides replies, in one line; part of the cache's key."""
        ...

    def complete(self, request: ChatRequest) -> ChatReply:
        """The reply to a request.

        Raises:
            BackendError: when there is none.
        """
        ...

    def close(self) -> None:
        """Gives back what it holds; a closed backend answers nothing."""
        ...
