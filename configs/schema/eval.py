"""Frozen configuration of evaluation: which planner, on which robot, tasks and contingencies, and which table to assemble."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final, Literal

from configs.schema.backend import BackendConfig
from configs.schema.checks import defaults_of, require, require_used
from configs.schema.execution import Execution
from configs.schema.robot import RobotConfig

CategoryName = Literal["all", "single", "optional", "essential"]
DifficultyName = Literal["easy", "medium", "hard", "natural"]
SplitName = Literal["all", "seen", "unseen"]
StartName = Literal["fixed", "turned", "random"]
BlindName = Literal["none", "image", "motion", "both"]
FeedbackName = Literal["codes", "bit"]
PlannerKind = Literal["mllm", "file", "random", "scripted", "expert", "plain", "llm_planner", "rap", "dag_plan"]
#: Kinds that ask a language model in chats, and so need a backend.
CHAT_KINDS: Final[tuple[PlannerKind, ...]] = ("plain", "llm_planner", "rap", "dag_plan")
#: Fields of a planner that not every kind uses; elsewhere they keep their defaults, so that none is ignored.
_OF_KINDS: Final[Mapping[str, tuple[PlannerKind, ...]]] = {
    "adapter": ("mllm",),
    "temperature": ("mllm",),
    "insist": ("mllm",),
    "blind": ("mllm", *CHAT_KINDS, "file"),
    "replans": (*CHAT_KINDS, "file"),
    "history": (*CHAT_KINDS, "file"),
    "body": (*CHAT_KINDS, "file"),
    "horizon": ("plain", "file"),
    "parallel": ("dag_plan",),
    "image_size": ("random", "scripted", "expert"),
}
ExperimentName = Literal["main_table", "ablation_table", "replanning_table", "failure_figure", "distribution_figures"]


@dataclass(frozen=True)
class PlannerConfig:
    """One planner.

    Attributes:
        name: name in commands, ledgers and tables.
        kind: `mllm` runs a stored model, `file` a class in a Python file, `random` draws legal actions, `scripted` follows
            rules, `expert` looks into the simulator (privileged); `plain`, `llm_planner`, `rap` and `dag_plan` ask the run's
            backend.
        label: name printed in tables.
        weights: folder of a stored model; needed for `mllm`.
        source: `FILE.py:CLASS`; needed for `file`.
        adapter: adapter to activate; None takes the stored model's first.
        train: command that makes the weights, for the message when they are absent.
        temperature: 0 takes the most likely token.
        insist: whether a stored model may take steps that are bound to be refused by what its log tells
            of hands and states, look for something where it has been, end the task with a step that did nothing, and take a
            third time what was refused twice.
        blind: hides the picture, the robot's own body, or both (`proprio_mllm.evaluation.showing`).
        image_size: side of the head view in pixels for `random`, `scripted` and `expert`, 0 for none; others bring their own,
            or have `backend.image_size`.
        reflection: `on` reflects on failures. Planners of a backend ask once more for cause, change and new steps; a stored
            model reads its failed steps in the log, which `off` leaves out.
        replans: most re-plans, reflecting or not, of an episode.
        horizon: steps of a reply of `plain` that are carried out before it asks again.
        history: steps of the log in a backend's prompt.
        body: whether a backend's prompt tells proprioception in words; the paper's baselines have none.
        examples: tasks taken from memory by `llm_planner` and `rap`.
        memory: folder of the memory, made by `python -m proprio_mllm memory`.
        parallel: whether `dag_plan` may use both arms in one step; false does one node at a time.
    """

    name: str
    kind: PlannerKind
    label: str
    weights: str | None = None
    source: str | None = None
    adapter: str | None = None
    train: str = ""
    temperature: float = 0.0
    insist: bool = False
    blind: BlindName = "none"
    image_size: int = 112
    reflection: Literal["on", "off"] = "on"
    replans: int = 5
    horizon: int = 1
    history: int = 20
    body: bool = False
    examples: int = 0
    memory: str | None = None
    parallel: bool = True

    def __post_init__(self) -> None:
        require(self.name.isidentifier(), f"planner name {self.name!r} must be an identifier")
        require((self.weights is not None) == (self.kind == "mllm"), f"kind {self.kind!r} with weights {self.weights!r}")
        require((self.source is not None) == (self.kind == "file"), f"kind {self.kind!r} with source {self.source!r}")
        require(self.temperature >= 0.0, f"temperature {self.temperature} must not be negative")
        require(
            self.image_size == 0 or 16 <= self.image_size <= 2048,
            f"image_size {self.image_size} outside [16, 2048]; 0 takes none",
        )
        for name, low in (("replans", 0), ("horizon", 1), ("history", 1), ("examples", 0)):
            require(getattr(self, name) >= low, f"{name} {getattr(self, name)} must be at least {low}")
        needs = self.kind in ("llm_planner", "rap")
        require((self.memory is not None) == needs, f"kind {self.kind!r} with memory {self.memory!r}")
        require((self.examples > 0) == needs, f"kind {self.kind!r} with examples {self.examples}")
        require_used(self, _OF_KINDS)


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

    planner: PlannerConfig
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
    reflection: Literal["on", "off"] = "on"
    backend: BackendConfig | None = None
    threads: int = 1
    cost_cap_usd: float | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        require(self.trials > 0, f"trials {self.trials} must be positive")
        require(self.steps == "task" or 1 <= self.steps <= 1000, f"steps {self.steps} outside [1, 1000]; allowed too: task")
        require(self.stuck == 0 or 4 <= self.stuck <= 1000, f"stuck {self.stuck} must be 0 or in [4, 1000]")
        require(
            self.batch == 1 or self.planner.kind == "mllm" or (self.planner.kind == "file" and self.backend is None),
            f"batch {self.batch} with planner kind {self.planner.kind!r}; allowed: mllm, or file with begin and step_batch; a "
            "backend has backend.batch",
        )
        chats = self.planner.kind in CHAT_KINDS
        asks = chats or (self.planner.kind == "file" and self.backend is not None)
        require(
            (self.reflection == "on" and self.planner.reflection == "on") or asks or self.planner.kind == "mllm",
            f"reflection 'off' with planner kind {self.planner.kind!r}, which has none; allowed: on",
        )
        require(self.backend is not None or not chats, f"planner {self.planner.name!r} needs a backend; allowed: backend=NAME")
        require(
            self.backend is None or asks,
            f"backend {self.backend.name if self.backend else ''!r} with planner kind {self.planner.kind!r}, which asks none; "
            f"allowed: none, or a planner of kind {', '.join(CHAT_KINDS)}, file",
        )
        for name in ("replans", "history", "body", "horizon") if self.planner.kind == "file" and not asks else ():
            value, default = getattr(self.planner, name), defaults_of(PlannerConfig)[name]
            require(
                value == default, f"planner.{name} {value!r} with planner kind 'file' without a backend; allowed: {default!r}"
            )
        require(1 <= self.threads <= 256, f"threads {self.threads} outside [1, 256]")
        require(
            self.threads == 1 or (asks and self.workers == 0),
            f"threads {self.threads} with planner kind {self.planner.kind!r} and workers {self.workers}; "
            f"allowed: planners that ask a backend, with workers=0",
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
            f"cost_cap_usd {cap} with planner kind {self.planner.kind!r}, which asks no backend; allowed: null",
        )
        require(self.limit is None or self.limit > 0, f"limit {self.limit} must be positive or null")
        require(self.seed >= 0, f"seed {self.seed} must not be negative")
