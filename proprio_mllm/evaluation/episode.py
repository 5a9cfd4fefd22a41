"""Runs one episode: a session, a planner, and the record of what became of it.

The loop: show the observation, ask for a step, let the session act it out, until the goals hold, the planner says `Done()`, the
steps run out, or the episode only repeats itself. A reply outside the grammar costs a step and comes back as the code
`InvalidOutput`. The runner keeps history and step count itself, so that invalid replies are part of both.

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
from collections import deque
from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, Literal, Protocol

import numpy as np

from interface.episode import STEP_LIMIT, EpisodeRecord, Outcome
from interface.failures import INVALID_OUTPUT
from interface.feedback import Feedback
from interface.observation import HistoryItem, Observation
from interface.steps import PlanStep
from proprio_mllm.evaluation.attribution import attribute
from proprio_mllm.evaluation.seeds import stream
from proprio_mllm.evaluation.showing import Showing
from proprio_mllm.planners.protocol import Planner, PlannerReply, TaskInfo, Usage

logger = logging.getLogger(__name__)

#: A robot that is not farther from where it was, in metres and radians, has not moved.
_MOVED: Final = 0.02
_EVERYTHING: Final = Showing()


@dataclass(frozen=True, slots=True)
class Limits:
    """What ends an episode. Steps that a contingency spoils are acted out and recorded, but not charged.

    Attributes:
        time: the task's time limit: charged steps within which a success is in time.
        steps: charged steps after which the episode ends.
        stuck: steps after which an episode that only repeats itself ends; 0 lets it run.
    """

    time: int
    steps: int = STEP_LIMIT
    stuck: int = 0

    @staticmethod
    def of(time_limit: int, steps: int | Literal["task"], stuck: int = 0) -> Limits:
        """Limits of a task; `steps` is a number, or `task` for the task's time limit."""
        return Limits(time_limit, time_limit if steps == "task" else steps, stuck)


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

    def stance(self) -> tuple[float, float, float, float]:
        """x, y (m), yaw (rad) and pelvis height (m) of the robot in the world."""
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
    limits: Limits,
    episode_seed: int,
    watch: Watcher | None = None,
    showing: Showing = _EVERYTHING,
) -> EpisodeRecord:
    """Runs an episode to its end with a planner of its own; see `episode_steps` for the arguments.

    Returns:
        The record; on any exception one with the outcome `INFRASTRUCTURE_ERROR` and the error's text.
    """
    episode = episode_steps(open_session, fields, instruction, limits, episode_seed, watch, showing)
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
    limits: Limits,
    episode_seed: int,
    watch: Watcher | None = None,
    showing: Showing = _EVERYTHING,
) -> Episode:
    """An episode that pauses wherever it needs its planner, so that several can go side by side in one thread.

    Args:
        open_session: makes the session; called inside the guarded part.
        fields: the episode's key.
        instruction: the task's instruction.
        limits: what ends it.
        episode_seed: the episode's seed (`seeds.episode_seed`), for the session and the planner's random stream.
        watch: sees every observation.
        showing: what of it the planner sees.

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
        yield Begin(TaskInfo(instruction, fields.robot, limits.time, limits.steps), stream(episode_seed, "planner"))
        end = yield from _loop(session, observation, limits, tally, watch, showing)
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
        budget_exhausted=not success and end == "steps",
        stuck=not success and end == "stuck",
        in_time=success and tally.charged <= limits.time,
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
        self.charged = 0
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


class _Repetition:
    """Whether the last steps are only one or two different ones, each always with the same outcome, view and place.

    Args:
        steps: how many; 0 never says so.
    """

    def __init__(self, steps: int) -> None:
        self._steps = steps
        self._marks: deque[tuple[object, tuple[float, ...]]] = deque(maxlen=max(steps, 1))

    def seen(self, session: RunnableSession, observation: Observation, item: HistoryItem, met: Sequence[bool]) -> None:
        """Takes a step that no contingency struck."""
        if self._steps:
            x, y, yaw, height = session.stance()
            place = (x, y, math.cos(yaw), math.sin(yaw), height)
            self._marks.append(((item, observation.visible_objects, observation.known_objects, tuple(met)), place))

    def forget(self) -> None:
        """Starts anew: the same step may come out otherwise next time."""
        self._marks.clear()

    @property
    def stuck(self) -> bool:
        """Whether it is so."""
        first = dict(reversed(self._marks))
        return (
            0 < len(self._marks) == self._steps
            and len(first) <= 2
            and all(math.dist(place, first[mark]) < _MOVED for mark, place in self._marks)
        )


def _loop(
    session: RunnableSession,
    observation: Observation,
    limits: Limits,
    tally: _Tally,
    watch: Watcher | None,
    showing: Showing,
) -> Generator[Ask, PlannerReply | None, Literal["goals", "done", "steps", "stuck"]]:
    """Steps until the end; returns what ended the episode."""
    history: list[HistoryItem] = []
    reply: PlannerReply | None = None
    feedback: Feedback | None = None
    met: Sequence[bool] = ()
    repetition = _Repetition(limits.stuck)
    end: Literal["goals", "done", "steps", "stuck"] = "steps"
    while tally.charged < limits.steps:
        shown = _shown(observation, history, tally.charged, limits)
        if watch is not None:
            watch(shown, reply, feedback)
        reply = yield Ask(showing.observation(shown), showing.outcome(feedback))
        if not isinstance(reply, PlannerReply):
            raise TypeError(f"the planner's step() gave {type(reply).__name__}; allowed: PlannerReply")
        tally.add(reply)
        if reply.step is None:
            feedback = None
            tally.charged += 1
            tally.invalid += 1
            text = " ".join(reply.text.split())[:80]
            history.append(HistoryItem(text, f"{text} {INVALID_OUTPUT}".strip()))
            tally.trace.append(_invalid(reply))
        else:
            observation, feedback = session.step(reply.step)
            tally.charged += not feedback.struck
            history.append(HistoryItem(reply.step.to_text(), feedback.to_text()))
            tally.trace.append(_traced(reply.step, feedback))
            met = session.goals().met
            if any(action.name == "Done" for action in reply.step.actions):
                end = "done"
                break
            if all(met):
                end = "goals"
                break
        if feedback is not None and feedback.struck:
            repetition.forget()
        else:
            repetition.seen(session, observation, history[-1], met)
        if repetition.stuck:
            end = "stuck"
            break
    if watch is not None:
        watch(_shown(observation, history, tally.charged, limits), reply, feedback)
    return end


def _shown(observation: Observation, history: list[HistoryItem], step: int, limits: Limits) -> Observation:
    return dataclasses.replace(observation, history=tuple(history), step=step, time_limit=limits.time, step_limit=limits.steps)


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
