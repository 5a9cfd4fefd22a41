"""Frozen configuration of evaluation: which planner, on which robot, tasks and contingencies, and which table to assemble."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from configs.schema.backend import BackendConfig
from configs.schema.checks import defaults_of, require
from configs.schema.execution import Execution
from configs.schema.planner import CHAT_KINDS, AnyPlanner, FilePlanner, ModelPlanner, ReflectionName
from configs.schema.robot import RobotConfig

CategoryName = Literal["all", "single", "optional", "essential"]
DifficultyName = Literal["easy", "medium", "hard", "natural"]
SplitName = Literal["all", "seen", "unseen"]
StartName = Literal["fixed", "turned", "random"]
FeedbackName = Literal["codes", "bit"]
ExperimentName = Literal["main_table", "ablation_table", "replanning_table", "failure_figure", "distribution_figures"]


@dataclass(frozen=True)
class ExperimentConfig:
    """A table or figure of the paper, assembled from the runs that exist.

    Attributes:
        name: which one.
        planners: rows, by planner name.
        robots: robots shown.
        difficulties: difficulties shown.
    """

    name: ExperimentName
    planners: tuple[str, ...]
    robots: tuple[str, ...] = ("x1", "h1")
    difficulties: tuple[DifficultyName, ...] = ("easy",)

    def __post_init__(self) -> None:
        for name in ("planners", "robots", "difficulties"):
            require(bool(getattr(self, name)), f"{name} () must name at least one")


@dataclass(frozen=True)
class EvalConfig(Execution):
    """Everything `eval.py` needs.

    Attributes:
        planner: who plans.
        robot: which robot acts.
        difficulty: success of low-level skills: easy 100 %, medium 50 %, hard 20 %, natural as the rules say.
        contingencies: outcome distributions, a name of `configs/contingency` or of one's own assets.
        category: tasks of one category, or all.
        trials: episodes per task; the contingencies and the random streams differ between trials.
        steps: charged steps of an episode, 50 in the paper; `task` ends it at the task's time limit.
        stuck: an episode ends when its last so many steps are only one or two different ones, each with the same outcome, view
            and place every time; 0 lets it run on.
        start: `fixed` starts where the task says, `turned` there with a heading drawn per trial, `random` anywhere free in the
            room with heading and pelvis height drawn per trial.
        split: tasks whose `split` this is, or all.
        seed: of the contingencies, hashed with task, robot and trial.
        tasks: `benchmark`, or the path of a JSON-lines file of tasks.
        limit: only the first so many tasks of each category.
        feedback: `codes` tells planners why an action failed, `bit` only that it did.
        output: folder of all outputs.
        experiment: assemble this instead of running episodes.
        sanity: run two tasks on each robot with the expert, the rules and the tiny model, and keep nothing.
        watch: show the episodes in the browser, one after the other, in this process (`sim.play.live`).
        reflection: whether failures are reflected on; planners that can take it from here (`planner.reflection`).
        backend: the language model that planners which chat ask, and a planner of a file that takes one; others have none.
        threads: episodes that go on at a time in one process (`workers=0`), each with a planner of its own whose calls wait
            in a thread; for planners that ask a backend.
        cost_cap_usd: most money a run may spend, over all its parts; null sets no limit.
    """

    planner: AnyPlanner
    robot: RobotConfig
    difficulty: DifficultyName = "easy"
    contingencies: str = "default"
    category: CategoryName = "all"
    trials: int = 1
    steps: int | Literal["task"] = 50
    stuck: int = 8
    start: StartName = "fixed"
    split: SplitName = "all"
    seed: int = 0
    tasks: str = "benchmark"
    limit: int | None = None
    feedback: FeedbackName = "codes"
    output: str = "outputs"
    experiment: ExperimentConfig | None = None
    sanity: bool = False
    watch: bool = False
    reflection: ReflectionName = "on"
    backend: BackendConfig | None = None
    threads: int = 1
    cost_cap_usd: float | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        require(self.trials > 0, f"trials {self.trials} must be positive")
        require(self.steps == "task" or 1 <= self.steps <= 1000, f"steps {self.steps} outside [1, 1000]; allowed too: task")
        require(self.stuck == 0 or 4 <= self.stuck <= 1000, f"stuck {self.stuck} must be 0 or in [4, 1000]")
        planner, kind = self.planner, self.planner.kind
        own = isinstance(planner, FilePlanner)
        chats = kind in CHAT_KINDS
        asks = chats or (own and self.backend is not None)
        require(
            self.batch == 1 or isinstance(planner, ModelPlanner) or (own and not asks),
            f"batch {self.batch} with planner kind {kind!r}; allowed: mllm, or file with begin and step_batch; a backend has "
            "backend.batch",
        )
        require(
            self.reflection == "on" or asks or isinstance(planner, ModelPlanner),
            f"reflection 'off' with planner kind {kind!r}, which has none; allowed: on",
        )
        require(self.backend is not None or not chats, f"planner {planner.name!r} needs a backend; allowed: backend=NAME")
        require(
            self.backend is None or asks,
            f"backend {self.backend.name if self.backend else ''!r} with planner kind {kind!r}, which asks none; "
            f"allowed: none, or a planner of kind {', '.join(CHAT_KINDS)}, file",
        )
        for name in ("reflection", "replans", "history", "body", "horizon") if own and not asks else ():
            value, default = getattr(planner, name), defaults_of(FilePlanner)[name]
            require(
                value == default, f"planner.{name} {value!r} with planner kind 'file' without a backend; allowed: {default!r}"
            )
        require(1 <= self.threads <= 256, f"threads {self.threads} outside [1, 256]")
        require(
            self.threads == 1 or (asks and self.workers == 0),
            f"threads {self.threads} with planner kind {kind!r} and workers {self.workers}; allowed: planners that ask a "
            "backend, with workers=0",
        )
        local = self.backend is not None and self.backend.kind == "local"
        require(
            self.workers == 0 or not local,
            f"workers {self.workers} with a model in this process; allowed: workers=0, with threads=N for N episodes at once",
        )
        cap = self.cost_cap_usd
        require(cap is None or 0.0 <= cap < math.inf, f"cost_cap_usd {cap} must be null or a finite number of at least 0")
        require(
            cap is None or asks,
            f"cost_cap_usd {cap} with planner kind {kind!r}, which asks no backend; allowed: null",
        )
        require(self.limit is None or self.limit > 0, f"limit {self.limit} must be positive or null")
        require(self.seed >= 0, f"seed {self.seed} must not be negative")
