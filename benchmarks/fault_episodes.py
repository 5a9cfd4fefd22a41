"""Episodes that fail for a known reason, acted out in the simulator: what the failure types are validated on.

The list follows from whatever the benchmark holds and a seed. For every cause and robot (`Cell`) tasks are drawn in a seeded
order that changes family from task to task; each is acted out by the expert with that fault injected, and counts when it failed
and the mistake was made where it matters (`FaultyPlanner.mattered`). What does not count gives its place to the next task.
Neither the order nor that choice looks at the type that the episode was given.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from benchmarks.fault_injection import CAUSES, LATE_SLIPS, SLIPS, Cause, FaultyPlanner
from configs.schema.robot import RobotConfig
from interface.actions import ACTIONS, ActionKind
from interface.episode import EpisodeRecord, Outcome
from interface.failures import FailureCategory
from interface.steps import PlanStep
from proprio_mllm.evaluation.episode import EpisodeKeyFields, Limits, RunnableSession, run_episode
from proprio_mllm.evaluation.seeds import episode_seed, stream
from proprio_mllm.evaluation.sessions import open_session
from sim.tasks.task import BENCHMARK_PATH, Task, load_benchmark

#: Episodes per cause and robot; logical has twice as many causes as each of the others.
_QUOTA: Final[Mapping[FailureCategory, int]] = {
    FailureCategory.NAVIGATION: 3,
    FailureCategory.BODY_ADJUSTMENT: 3,
    FailureCategory.LOGICAL: 2,
}
#: Tasks that are tried for each place.
_TRIES: Final = 6
#: Share of episodes with a passing failure besides the cause.
_SLIP_SHARE: Final = 0.6
#: The fault may strike at once, or after fewer arm actions than this.
_AFTER: Final = 3


@dataclass(frozen=True, slots=True)
class Cell:
    """A cause on a robot, and how many episodes of it are wanted."""

    cause: str
    robot: str
    count: int
    seed: int


@dataclass(frozen=True, slots=True)
class Scripted:
    """One episode before it is run; fields as for `FaultyPlanner`."""

    task: str
    family: str
    robot: str
    cause: str
    gives_up: bool
    slip: str | None
    late: bool
    after: int
    seed: int


@dataclass(frozen=True, slots=True)
class ScriptedResult:
    """What became of a scripted episode.

    Attributes:
        episode: what was asked for.
        record: as in a ledger.
        mattered: whether the mistake was made where it matters.
        slipped: whether there was a passing failure.
        unmet: ids that the goals are about that did not hold at the end.
    """

    episode: Scripted
    record: EpisodeRecord
    mattered: bool
    slipped: bool
    unmet: tuple[str, ...]

    @property
    def counts(self) -> bool:
        """Whether it is part of the validation."""
        return self.mattered and self.record.outcome is Outcome.FAILURE

    @property
    def expected(self) -> FailureCategory:
        """The type of its cause."""
        return CAUSES[self.episode.cause].category

    @property
    def expected_invalid(self) -> bool:
        """Whether it must be flagged for invalid output."""
        return CAUSES[self.episode.cause].invalid or (self.slipped and self.episode.slip == "stammers")


def cells(robots: Sequence[str], seed: int, per_cause: int | None = None) -> list[Cell]:
    """Every cause on every robot.

    Args:
        robots: their names.
        seed: of the draws.
        per_cause: episodes per cell; None for the numbers that balance the types.
    """
    return [
        Cell(name, robot, _QUOTA[cause.category] if per_cause is None else per_cause, seed)
        for name, cause in CAUSES.items()
        for robot in robots
    ]


def read_plans(path: Path | None = None) -> dict[tuple[str, str], tuple[str, ...]]:
    """Names of the actions of the expert's certificates, in order, by task and robot."""
    path = path or BENCHMARK_PATH.parent / "certificates.jsonl"
    found: dict[tuple[str, str], tuple[str, ...]] = {}
    for line in path.read_text(encoding="utf-8").splitlines():
        raw = json.loads(line)
        found[raw["task"], raw["robot"]] = tuple(a.name for text in raw["plan"] for a in PlanStep.parse(text).actions)
    return found


def drawn(cell: Cell, tasks: Sequence[Task], plans: Mapping[tuple[str, str], tuple[str, ...]]) -> list[Scripted]:
    """The episodes that may fill a cell, in the order they are tried: a seeded one, with families taking turns."""
    rng = stream(episode_seed(cell.seed, cell.cause, cell.robot, 0), "scripted")
    cause = CAUSES[cell.cause]
    fitting = [task for task in tasks if (plan := plans.get((task.id, cell.robot))) and _meets(cause, task, plan)]
    families: dict[str, list[Task]] = {}
    for index in rng.permutation(len(fitting)):
        families.setdefault(fitting[index].family, []).append(fitting[index])
    rounds = max((len(group) for group in families.values()), default=0)
    ordered = [group[turn] for turn in range(rounds) for group in families.values() if turn < len(group)]
    return [_scripted(cell, task, plans[task.id, cell.robot], rng) for task in ordered[: _TRIES * cell.count]]


def _meets(cause: Cause, task: Task, plan: tuple[str, ...]) -> bool:
    """Whether a task could meet a fault at all, as far as that can be told without running it."""
    return cause.fits(task, plan) and (cause.believes is None or cause.believes(task, np.random.default_rng(0)) is not None)


def _scripted(cell: Cell, task: Task, plan: Sequence[str], rng: np.random.Generator) -> Scripted:
    arms = sum(ACTIONS[name].kind in (ActionKind.ARM, ActionKind.TWO_ARM) for name in plan)
    slip = str(rng.choice(sorted(SLIPS))) if rng.random() < _SLIP_SHARE else None
    late = slip in LATE_SLIPS and CAUSES[cell.cause].believes is None and bool(rng.random() < 0.5)
    gives_up = bool(rng.random() < 0.5)
    after = int(rng.integers(max(min(arms, _AFTER), 1)))
    return Scripted(task.id, task.family, cell.robot, cell.cause, gives_up, slip, late, after, cell.seed)


def run_scripted(episode: Scripted, task: Task) -> ScriptedResult:
    """Acts an episode out with the harness's own runner, at difficulty easy."""
    planner = FaultyPlanner(task, episode.cause, episode.gives_up, episode.slip, episode.late, episode.after)
    own_seed = episode_seed(episode.seed, task.id, episode.robot, 0)
    fields = EpisodeKeyFields("scripted", episode.robot, task.id, task.category, "easy", 0, episode.seed, episode.cause)
    opened: list[RunnableSession] = []

    def open_one() -> RunnableSession:
        opened.append(open_session(RobotConfig(episode.robot), "easy", "fixed", task, own_seed, planner))
        return opened[-1]

    record = run_episode(open_one, planner, fields, task.instruction, Limits.of(task.time_limit, "task"), own_seed)
    broken = record.outcome is Outcome.INFRASTRUCTURE_ERROR
    unmet = () if broken else tuple(sorted(opened[-1].goals().unmet_objects))
    return ScriptedResult(episode, record, planner.mattered, planner.slipped, unmet)


class CellRunner:
    """Fills cells, one after the other; made once per process.

    Args:
        tasks: what to draw from; the benchmark when None.
    """

    def __init__(self, tasks: Sequence[Task] | None = None) -> None:
        self._tasks = {task.id: task for task in (load_benchmark() if tasks is None else tasks)}
        self._plans = read_plans()

    def __call__(self, job: Cell) -> list[ScriptedResult]:
        """Episodes of a cell in the order they were tried, up to as many that count as are wanted."""
        results: list[ScriptedResult] = []
        for episode in drawn(job, list(self._tasks.values()), self._plans):
            if sum(result.counts for result in results) == job.count:
                break
            results.append(run_scripted(episode, self._tasks[episode.task]))
        return results
