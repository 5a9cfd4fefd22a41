"""What a planner is: `reset` at the start of an episode, then one reply per observation.

A planner sees `Observation` and `Feedback` and nothing else. What it answers may be text outside the action grammar: the reply
then carries no step, and the episode runner counts it and gives it back as a failure, it never crashes.

Paper: problem formulation (policy over observation, proprioception and feedback).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Protocol, runtime_checkable

import numpy as np

from interface.episode import STEP_LIMIT
from interface.feedback import Feedback
from interface.observation import HistoryItem, Observation
from interface.steps import ActionError, PlanStep


@dataclass(frozen=True, slots=True)
class TaskInfo:
    """What a planner is told at the start.

    Attributes:
        instruction: the task in natural language.
        robot: robot name.
        time_limit: steps within which the task is done in time.
        step_limit: steps after which the episode ends.
    """

    instruction: str
    robot: str
    time_limit: int
    step_limit: int = STEP_LIMIT


@dataclass(frozen=True, slots=True)
class Usage:
    """What answers cost.

    Attributes:
        calls: calls of a model.
        cached: how many of them were answered from a cache.
        reflections: how many of them reflected on a failure.
        usd: price; None where a call's price is not known.
        models: exact models that answered, each once.
    """

    calls: int = 0
    cached: int = 0
    reflections: int = 0
    usd: float | None = 0.0
    models: tuple[str, ...] = ()

    def __add__(self, other: Usage) -> Usage:
        usd = None if self.usd is None or other.usd is None else self.usd + other.usd
        models = tuple(dict.fromkeys((*self.models, *other.models)))
        return Usage(self.calls + other.calls, self.cached + other.cached, self.reflections + other.reflections, usd, models)


#: A call of a planner that says nothing about its calls.
ONE_CALL: Final = Usage(calls=1)


@dataclass(frozen=True, slots=True)
class PlannerReply:
    """One answer.

    Attributes:
        text: what the planner wrote.
        step: the plan step it means, None when the text is outside the grammar.
        error: why there is no step.
        tokens: tokens read and written, 0 for planners without a language model.
        latency_s: seconds the planner took.
        usage: calls behind the answer; a step of a plan that was made earlier has none.
    """

    text: str
    step: PlanStep | None
    error: str = ""
    tokens: int = 0
    latency_s: float = 0.0
    usage: Usage = ONE_CALL


@runtime_checkable
class Planner(Protocol):
    """Plans one episode at a time."""

    #: Whether it looks at the simulator's state; tables mark it.
    privileged: bool
    #: Side of the square image it wants to see, pixels.
    image_size: int

    def reset(self, task: TaskInfo, rng: np.random.Generator) -> None:
        """Forgets the last episode; `rng` is the only source of randomness of the new one."""
        ...

    def step(self, observation: Observation, feedback: Feedback | None) -> PlannerReply:
        """The next plan step; `feedback` is None at the first step and after an invalid reply."""
        ...


@runtime_checkable
class BatchPlanner(Protocol):
    """Answers the observations of several running episodes at once, for models that run in this process.

    What an episode needs to remember between its steps is in a state that `begin` makes and the caller keeps; a row's answer
    depends on its own observation and state, not on the other rows, up to the rounding of sums.
    """

    #: Side of the square image it wants to see, pixels.
    image_size: int

    def begin(self, task: TaskInfo, rng: np.random.Generator) -> Any:
        """The state of a new episode; `rng` is its only source of randomness."""
        ...

    def step_batch(self, observations: Sequence[Observation], states: Sequence[Any] | None = None) -> list[PlannerReply]:
        """One reply per observation.

        Args:
            observations: one per episode; earlier feedback is in each one's history.
            states: the episodes' states, in the same order; None only where a planner draws nothing.
        """
        ...


class WeightsError(RuntimeError):
    """A model folder that is not there; the message names it and the command that makes it."""


def check_weights(folder: str | Path, train: str) -> Path:
    """The folder of a stored model.

    Args:
        folder: where the model should be.
        train: command that makes it.

    Raises:
        WeightsError: when there is no stored model.
    """
    path = Path(folder)
    if not (path / "config.json").is_file():
        raise WeightsError(f"no weights at {path}: make them with `{train}`, or set planner.weights=FOLDER")
    return path


def succeeded(item: HistoryItem) -> bool:
    """Whether every action of an earlier step succeeded."""
    return all(part.endswith(" ok") for part in item.feedback.split("; "))


def parse_reply(text: str, tokens: int = 0, latency_s: float = 0.0) -> PlannerReply:
    """A reply from a planner's text: its first line that is not empty, read as a plan step."""
    line = next((line.strip() for line in text.splitlines() if line.strip()), "")
    try:
        return PlannerReply(text, PlanStep.parse(line), tokens=tokens, latency_s=latency_s)
    except ActionError as error:
        return PlannerReply(text, None, str(error), tokens, latency_s)
