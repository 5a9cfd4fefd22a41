"""Runs one episode: a session, a planner, and the record of what became of it.

The loop: show the observation, ask for a step, let the session act it out, until the goals hold, the planner says `Done()`, or
the step budget is used up. A reply outside the grammar costs a step and comes back as the code `InvalidOutput`. The runner
keeps history and step count itself, so that invalid replies are part of both.

Every exception is caught here (elsewhere only around a user's planner file): whatever breaks in simulator or planner becomes an
infrastructure error, which is recorded and never scored.
"""

from __future__ import annotations

import dataclasses
import logging
import math
import operator
import time
import traceback
from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from data.interface.episode import EpisodeRecord, Outcome
from data.interface.feedback import Feedback
from data.interface.observation import HistoryItem, Observation
from data.interface.steps import PlanStep
from proprio_mllm.evaluation.attribution import INVALID_OUTPUT, attribute
from proprio_mllm.evaluation.seeds import stream
from proprio_mllm.planners.protocol import Planner, PlannerReply, TaskInfo, Usage

__all__ = [
    "Ask",
    "Begin",
    "Episode",
    "EpisodeKeyFields",
    "GoalReport",
    "RunnableSession",
    "Stats",
    "Watcher",
    "answer",
    "episode_steps",
    "run_episode",
]

logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class GoalReport:
    """Which goals hold.

    Attributes:
        met: one entry per goal.
        unmet_objects: ids that goals which do not hold are about (`attribution.unmet_objects`).
    """

    met: tuple[bool, ...]
    unmet_objects: frozenset[str]


@dataclass(frozen=True, slots=True)
class Stats:
    """Costs of an episode in the simulated world: base path in metres, seconds, share of arm-steps in which an arm acted."""

    path_length_m: float
    makespan_s: float
    arm_utilisation: float


class RunnableSession(Protocol):
    """What the runner needs of a session; `proprio_mllm.evaluation.sessions` gives the simulator's."""

    def reset(self, seed: int) -> Observation:
        """Starts the session's task anew."""
        ...

    def step(self, step: PlanStep) -> tuple[Observation, Feedback]:
        """Acts a plan step out."""
        ...

    def goals(self) -> GoalReport:
        """Which goals hold now."""
        ...

    def stats(self) -> Stats:
        """Costs so far."""
        ...

    def relations(self) -> Mapping[str, Sequence[str]]:
        """What holds of which objects now (`held`, `open`, `on Table_1` …), for audits of a critic."""
        ...


#: Called before every step and once at the end with the observation, and the reply and feedback that led to it.
Watcher = Callable[[Observation, PlannerReply | None, Feedback | None], None]


@dataclass(frozen=True, slots=True)
class EpisodeKeyFields:
    """The fields of a record that are known before the episode."""

    planner: str
    robot: str
    task: str
    category: str
    difficulty: str
    trial: int
    seed: int
    config_hash: str


@dataclass(frozen=True, slots=True)
class Begin:
    """An episode asks its planner to start: answered by nothing."""

    task: TaskInfo
    rng: np.random.Generator


@dataclass(frozen=True, slots=True)
class Ask:
    """An episode asks its planner for the next step: answered by a `PlannerReply`."""

    observation: Observation
    feedback: Feedback | None


#: An episode that pauses wherever it needs its planner; first one `Begin`, then `Ask`s, at its end the record.
Episode = Generator[Begin | Ask, PlannerReply | None, EpisodeRecord]


def run_episode(
    open_session: Callable[[], RunnableSession],
    planner: Planner,
    fields: EpisodeKeyFields,
    instruction: str,
    step_budget: int,
    episode_seed: int,
    watch: Watcher | None = None,
) -> EpisodeRecord:
    """Runs an episode to its end with a planner of its own; see `episode_steps` for the arguments.

    Returns:
        The record; on any exception one with the outcome `INFRASTRUCTURE_ERROR` and the error's text.
    """
    episode = episode_steps(open_session, fields, instruction, step_budget, episode_seed, watch)
    said: PlannerReply | Exception | None = None
    try:
        while True:
            said = answer(planner, episode.throw(said) if isinstance(said, Exception) else episode.send(said))
    except StopIteration as end:
        return end.value


def answer(planner: Planner, request: Begin | Ask) -> PlannerReply | Exception | None:
    """What a planner says to a request, or the error it meets; None once it has begun."""
    try:
        if isinstance(request, Begin):
            planner.reset(request.task, request.rng)
            return None
        return planner.step(request.observation, request.feedback)
    except Exception as error:  # noqa: BLE001  # handed to the episode that it belongs to, which records it
        return error


def episode_steps(
    open_session: Callable[[], RunnableSession],
    fields: EpisodeKeyFields,
    instruction: str,
    step_budget: int,
    episode_seed: int,
    watch: Watcher | None = None,
) -> Episode:
    """An episode that pauses wherever it needs its planner, so that several can go side by side in one thread.

    Args:
        open_session: makes the session; called inside the guarded part.
        fields: the episode's key.
        instruction: the task's instruction.
        step_budget: steps allowed, without those that a contingency spoils: they are acted out and recorded, not charged.
        episode_seed: the episode's seed (`seeds.episode_seed`), for the session and the planner's random stream.
        watch: sees every observation.

    Yields:
        What the planner is asked. An exception thrown in becomes part of the record.

    Returns:
        The record; on any exception one with the outcome `INFRASTRUCTURE_ERROR` and the error's text.
    """
    started = time.perf_counter()
    tally = _Tally()
    try:
        session = open_session()
        observation = session.reset(episode_seed)
        yield Begin(TaskInfo(instruction, fields.robot, step_budget), stream(episode_seed, "planner"))
        done = yield from _loop(session, observation, step_budget, tally, watch)
        goals, stats = session.goals(), session.stats()
    except Exception as error:  # noqa: BLE001  # an episode must never end the run; the record tells what happened
        logger.warning("%s on %s, trial %d: %s", fields.planner, fields.task, fields.trial, error)
        message = "".join(traceback.format_exception(error))[-2000:]
        return _record(fields, tally, time.perf_counter() - started, message=message)
    success = all(goals.met)
    return dataclasses.replace(
        _record(fields, tally, time.perf_counter() - started),
        outcome=Outcome.SUCCESS if success else Outcome.FAILURE,
        failure=None if success else attribute(tally.trace, goals.unmet_objects),
        budget_exhausted=not success and not done,
        goal_conditions_met=sum(goals.met) / len(goals.met),
        makespan_s=round(stats.makespan_s, 3),
        path_length_m=round(stats.path_length_m, 3),
        arm_utilisation=round(stats.arm_utilisation, 4),
    )


class _Tally:
    """Running sums of an episode."""

    def __init__(self) -> None:
        self.trace: list[dict[str, Any]] = []
        self.invalid = 0
        self.usage = Usage()
        self.tokens = 0
        self.planner_s = 0.0

    def add(self, reply: PlannerReply) -> None:
        """Adds what a reply has cost; a planner may count in NumPy, but in nothing that a ledger cannot hold."""
        own = reply.usage
        calls, cached, reflections = (_whole(name, getattr(own, name)) for name in ("calls", "cached", "reflections"))
        usd = None if own.usd is None else _finite("usage.usd", own.usd)
        if not all(isinstance(model, str) for model in own.models):
            raise TypeError(f"the reply's usage.models are {own.models!r}; allowed: names")
        self.usage += Usage(calls, cached, reflections, usd, tuple(own.models))
        self.tokens += _whole("tokens", int(reply.tokens))
        self.planner_s += _finite("latency_s", reply.latency_s)


def _whole(name: str, value: int) -> int:
    count = operator.index(value)
    if not 0 <= count < 2**63:
        raise ValueError(f"the reply's {name} are below 0 or above 2**63")
    return count


def _finite(name: str, value: float) -> float:
    if not math.isfinite(value):
        raise ValueError(f"the reply's {name} is {value}; allowed: a finite number")
    return float(value)


def _loop(
    session: RunnableSession,
    observation: Observation,
    step_budget: int,
    tally: _Tally,
    watch: Watcher | None,
) -> Generator[Ask, PlannerReply | None, bool]:
    """Steps until the end; returns whether the planner ended the episode itself."""
    history: list[HistoryItem] = []
    reply: PlannerReply | None = None
    feedback: Feedback | None = None
    ended = False
    charged = 0
    while charged < step_budget:
        shown = _shown(observation, history, charged, step_budget)
        if watch is not None:
            watch(shown, reply, feedback)
        reply = yield Ask(shown, None if feedback is None else feedback.public())
        if not isinstance(reply, PlannerReply):
            raise TypeError(f"the planner's step() gave {type(reply).__name__}; allowed: PlannerReply")
        tally.add(reply)
        if reply.step is None:
            feedback = None
            charged += 1
            tally.invalid += 1
            text = " ".join(reply.text.split())[:80]
            history.append(HistoryItem(text, f"{text} {INVALID_OUTPUT}".strip()))
            tally.trace.append(_invalid(reply))
            continue
        observation, feedback = session.step(reply.step)
        charged += not feedback.struck
        history.append(HistoryItem(reply.step.to_text(), feedback.to_text()))
        tally.trace.append(_traced(reply.step, feedback))
        ended = any(action.name == "Done" for action in reply.step.actions)
        if ended or all(session.goals().met):
            break
    if watch is not None:
        watch(_shown(observation, history, charged, step_budget), reply, feedback)
    return ended


def _shown(observation: Observation, history: list[HistoryItem], step: int, step_budget: int) -> Observation:
    return dataclasses.replace(observation, history=tuple(history), step=step, step_budget=step_budget)


def _invalid(reply: PlannerReply) -> dict[str, Any]:
    outcome = {"action": "", "ok": False, "code": INVALID_OUTPUT, "category": "logical", "margins": {}, "contingency": ""}
    return {"step": reply.text[:400], "outcomes": [outcome | {"message": str(reply.error)[:200]}], "duration_s": 0.0}


def _traced(step: PlanStep, feedback: Feedback) -> dict[str, Any]:
    outcomes = [
        {
            "action": outcome.action.to_text(),
            "ok": outcome.success,
            "code": outcome.code,
            "category": None if outcome.category is None else outcome.category.value,
            "margins": {name: round(float(value), 4) for name, value in outcome.margins.items()},
            "contingency": outcome.contingency,
        }
        for outcome in feedback.outcomes
    ]
    return {"step": step.to_text(), "outcomes": outcomes, "duration_s": round(float(feedback.duration_s), 3)}


def _record(fields: EpisodeKeyFields, tally: _Tally, wall_s: float, message: str = "") -> EpisodeRecord:
    trace: tuple[Mapping[str, object], ...] = tuple(tally.trace)
    return EpisodeRecord(
        **dataclasses.asdict(fields),
        outcome=Outcome.INFRASTRUCTURE_ERROR,
        failure=None,
        invalid_output=tally.invalid,
        budget_exhausted=False,
        goal_conditions_met=0.0,
        steps=len(tally.trace),
        makespan_s=0.0,
        path_length_m=0.0,
        arm_utilisation=0.0,
        planner_calls=tally.usage.calls,
        planner_tokens=tally.tokens,
        cached_calls=tally.usage.cached,
        reflections=tally.usage.reflections,
        planner_usd=None if tally.usage.usd is None else round(tally.usage.usd, 8),
        models=tally.usage.models,
        planner_s=round(tally.planner_s, 4),
        wall_s=round(wall_s, 3),
        trace=trace,
        message=message,
    )
