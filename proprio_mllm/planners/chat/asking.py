"""Asks a backend for one of the reply kinds, and keeps count of what an answer has cost.

A reply that is not what was asked for is the planner's failure and comes back as an `Answer` without a value; a call that got
no reply raises and ends the episode as an infrastructure error.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Generic, TypeVar

from pydantic import BaseModel

from interface.steps import PlanStep
from proprio_mllm.backends.protocol import Backend, ChatImage, ChatMessage, ChatRequest
from proprio_mllm.planners.chat.replies import ReplyError, read_reply
from proprio_mllm.planners.protocol import PlannerReply, Usage, parse_reply

T = TypeVar("T", bound=BaseModel)
#: Purpose of the calls that reflect on a failure.
REFLECTION = "reflection"


@dataclass(frozen=True, slots=True)
class Answer(Generic[T]):
    """A reply: the object that was asked for, or why there is none.

    Attributes:
        text: as the model wrote it.
        value: None when the reply is not of the kind.
        error: why not.
    """

    text: str
    value: T | None
    error: str = ""


class Asker:
    """Calls for one planner step after the other; `taken` hands over the costs since the last time.

    Args:
        backend: who answers.
        max_tokens: longest reply.
        temperature: 0 asks for the most likely reply.
        seed: tells the samples of an episode apart from another's when the temperature is above 0.
    """

    def __init__(self, backend: Backend, max_tokens: int = 2048, temperature: float = 0.0, seed: int = 0) -> None:
        self._backend, self._max_tokens, self._temperature, self._seed = backend, max_tokens, temperature, seed
        self._usage, self._tokens, self._seconds = Usage(), 0, 0.0
        self._samples = 0

    def ask(self, system: str, content: tuple[str | ChatImage, ...], schema: type[T], purpose: str = "plan") -> Answer[T]:
        """One call.

        Args:
            system: who the model is and what it may say.
            content: the question, texts and pictures.
            schema: kind of the reply.
            purpose: what the call is for.

        Raises:
            BackendError: when there is no reply.
        """
        messages = (ChatMessage("system", (system,)), ChatMessage("user", content))
        sample = self._seed + self._samples if self._temperature > 0.0 else 0
        self._samples += 1
        request = ChatRequest(messages, schema, self._max_tokens, self._temperature, sample, purpose)
        reply = self._backend.complete(request)
        models = (reply.model,) if reply.model else ()
        self._usage += Usage(1, int(reply.cached), int(purpose == REFLECTION), reply.cost_usd, models)
        self._tokens += reply.prompt_tokens + reply.completion_tokens
        self._seconds += reply.latency_s
        try:
            return Answer(reply.text, read_reply(reply, schema))
        except ReplyError as error:
            return Answer(reply.text, None, str(error))

    def parsed(self, text: str) -> PlannerReply:
        """The reply that says one plan step, with the costs since the last one; text outside the grammar carries no step."""
        said = parse_reply(text)
        return self.reply(said.text, said.step, said.error)

    def reply(self, text: str, step: PlanStep | None, error: str = "") -> PlannerReply:
        """A planner's reply with the costs since the last one."""
        usage, tokens, seconds = self._usage, self._tokens, self._seconds
        self._usage, self._tokens, self._seconds = Usage(), 0, 0.0
        return PlannerReply(text, step, error, tokens, seconds, usage)
