"""Acts episodes out again from their ledger line, with the same contingencies and no planner: for pictures, films and data.

The ledger holds the plan and the feedback of every step, and a scene and its contingencies follow from the episode's key, so
the same steps give the same world. A step whose codes are not the ledger's is told apart (`Moment.differs`): the simulator has
changed since. An episode whose task is not in its file any more, or is another one under the same id, is refused.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from configs.schema.checks import defaults_of
from configs.schema.eval import EvalConfig
from configs.schema.planner import PLANNER_KINDS, BuiltInPlanner, ModelPlanner, PlannerConfig
from configs.validate import allowed_values, build
from interface.episode import EpisodeRecord
from interface.failures import INVALID_OUTPUT
from interface.feedback import Feedback
from interface.observation import HistoryItem, Observation
from interface.steps import PlanStep
from proprio_mllm.evaluation.episode import Limits
from proprio_mllm.evaluation.run import plan_episodes, select_tasks
from proprio_mllm.evaluation.seeds import episode_seed
from proprio_mllm.evaluation.starts import started
from proprio_mllm.report.stored import Run
from sim.session.session import Session
from sim.tasks.task import Task


class TaskGoneError(ValueError):
    """An episode whose task is not there any more, or has changed since."""


@dataclass(frozen=True, slots=True)
class Episode:
    """All that acting an episode out needs; plain data, so that it can be sent to a process.

    Attributes:
        cfg: the run's configuration.
        task: as the benchmark has it.
        record: the ledger line.
    """

    cfg: EvalConfig
    task: Task
    record: EpisodeRecord

    @property
    def episode_seed(self) -> int:
        """The episode's seed."""
        return episode_seed(self.record.seed, self.record.task, self.record.robot, self.record.trial)


class RunTasks:
    """The tasks of a run, as far as they are still what they were.

    Args:
        run: a run on disk.

    Raises:
        ValueError: when the run's configuration cannot be read, or the file of its tasks is not there.
    """

    def __init__(self, run: Run) -> None:
        self._run = run
        config = dict(run.metadata["config"])
        # options that a planner had then and has no more say nothing about its tasks
        known = PLANNER_KINDS.get(config["planner"].get("kind", ""), PlannerConfig).__dataclass_fields__
        config["planner"] = {name: value for name, value in config["planner"].items() if name in known}
        self.cfg = build(EvalConfig, config, f"{run.folder}/run.json: config")
        # The whole file: which tasks come first may have changed since, which task is meant has not.
        everything = dataclasses.replace(self.cfg, category="all", limit=None, trials=1)
        jobs = plan_episodes(everything, select_tasks(everything), run.metadata["config_hash"])
        self._tasks = {(job.task.id, _content(job.fields.config_hash)): job.task for job in jobs}

    def get(self, record: EpisodeRecord) -> Task | None:
        """The task of a record, None when it is not there any more or has changed."""
        return self._tasks.get((record.task, _content(record.config_hash)))

    def episode(self, record: EpisodeRecord) -> Episode:
        """The record with what acting it out needs.

        Raises:
            TaskGoneError: when its task is not there any more or has changed.
        """
        task = self.get(record)
        if task is None:
            known = any(name == record.task for name, _ in self._tasks)
            why = "has changed since the run" if known else "is not there any more"
            raise TaskGoneError(f"{self._run.folder}: task {record.task!r} of tasks={self.cfg.tasks} {why}")
        return Episode(self.cfg, task, record)


def _content(config_hash: str) -> str:
    """The part of an episode's `config_hash` that covers the task's content."""
    return config_hash.rpartition("-")[2]


def find_record(run: Run, task: str, trial: int) -> EpisodeRecord:
    """The record of an episode.

    Raises:
        ValueError: when the run has no such episode.
    """
    for record in run.records:
        if (record.task, record.trial) == (task, trial):
            return record
    known = allowed_values(task, sorted({record.task for record in run.records}))
    raise ValueError(f"{run.folder}: no episode of task {task!r}, trial {trial}; {known}")


@dataclass(frozen=True, slots=True)
class Moment:
    """The world before the first step, or after a step of the trace.

    Attributes:
        number: 0 at the start, then the step's number from 1.
        text: what the planner wrote; empty at the start.
        feedback: of the step now; None at the start and after an invalid reply.
        codes: a code per action, empty for success.
        expected: the ledger's codes.
        goals: whether each of the task's goals holds.
        observation: what the planner saw next, the history included; its picture has the size the planner asked for.
    """

    number: int
    text: str
    feedback: Feedback | None
    codes: tuple[str, ...]
    expected: tuple[str, ...]
    goals: tuple[bool, ...]
    observation: Observation

    @property
    def differs(self) -> bool:
        """Whether the step ended otherwise than in the ledger."""
        return self.codes != self.expected


class Reenactment:
    """An episode about to be acted out again.

    Args:
        episode: which one.

    Attributes:
        session: at the start of the episode; `moments` moves it on.
    """

    def __init__(self, episode: Episode) -> None:
        cfg = episode.cfg
        self.episode = episode
        robot = cfg.robot.spec or cfg.robot.name
        self.session = Session(robot, cfg.difficulty, _picture_size(cfg.planner), cfg.contingencies)
        self._first = self.session.reset(
            started(episode.task, cfg.start, episode.episode_seed, robot), seed=episode.episode_seed
        )

    def moments(self) -> Iterator[Moment]:
        """The start and every step; the session is closed at the end."""
        seen, history, charged = self._first, [], 0
        yield self._moment(0, "", None, (), (), seen, history, charged)
        for number, entry in enumerate(self.episode.record.trace, start=1):
            text, outcomes = str(entry["step"]), entry["outcomes"]
            assert isinstance(outcomes, Sequence)
            expected = tuple(str(outcome["code"]) for outcome in outcomes)
            feedback: Feedback | None = None
            codes = expected
            if expected == (INVALID_OUTPUT,):
                short = " ".join(text.split())[:80]
                history.append(HistoryItem(short, f"{short} {INVALID_OUTPUT}".strip()))
                charged += 1
            else:
                # Looking around decides what is known, so it is part of acting the episode out.
                seen, feedback = self.session.step(PlanStep.parse(text))
                history.append(HistoryItem(text, feedback.to_text()))
                charged += not feedback.struck
                codes = tuple(outcome.code for outcome in feedback.outcomes)
            yield self._moment(number, text, feedback, codes, expected, seen, history, charged)
        self.session.close()

    def _moment(
        self,
        number: int,
        text: str,
        feedback: Feedback | None,
        codes: tuple[str, ...],
        expected: tuple[str, ...],
        seen: Observation,
        history: Sequence[HistoryItem],
        charged: int,
    ) -> Moment:
        limits = Limits.of(self.episode.task.time_limit, self.episode.cfg.steps)
        shown = dataclasses.replace(seen, history=tuple(history), step=charged, time_limit=limits.time, step_limit=limits.steps)
        return Moment(number, text, feedback, codes, expected, self.session.goal_status(), shown)


def _picture_size(planner: PlannerConfig) -> int:
    """Side of the planner's picture: a model's own while its folder is there, else the configuration's."""
    usual = int(getattr(planner, "image_size", defaults_of(BuiltInPlanner)["image_size"]))
    if isinstance(planner, ModelPlanner) and (path := Path(planner.weights) / "config.json").is_file():
        return int(json.loads(path.read_text(encoding="utf-8")).get("image_size", usual))
    return usual
