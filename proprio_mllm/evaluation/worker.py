"""What a worker process does: open a session for a job, let the planner act, hand back the record.

Everything in here is plain data or made inside the process, so that jobs and results can be sent between processes.
"""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from configs.schema.eval import DifficultyName, PlannerConfig, StartName
from configs.schema.robot import RobotConfig
from data.records import EpisodeRecord, Outcome
from proprio_mllm.evaluation.episode import EpisodeKeyFields, RunnableSession, run_episode
from proprio_mllm.planners.protocol import Planner
from proprio_mllm.planners.registry import make_planner
from sim.tasks.task import Task

if TYPE_CHECKING:
    from proprio_mllm.evaluation.recording import RolloutRecorder

__all__ = ["EpisodeJob", "EpisodeResult", "EpisodeWorker", "Opener", "WorkerSetup", "lost_episode"]


@dataclass(frozen=True, slots=True)
class WorkerSetup:
    """What all episodes of a worker share.

    Attributes:
        planner: who plans.
        difficulty: success of low-level skills.
        start: see `EvalConfig.start`.
        contingency: see `EvalConfig.contingencies`.
    """

    planner: PlannerConfig
    difficulty: DifficultyName
    start: StartName
    contingency: str = "default"


@dataclass(frozen=True, slots=True)
class EpisodeJob:
    """One episode to run.

    Attributes:
        fields: its key.
        robot: which robot acts.
        task: its task.
        luck: its seed.
        record: whether observations are kept for training.
    """

    fields: EpisodeKeyFields
    robot: RobotConfig
    task: Task
    luck: int
    record: bool = False


@dataclass(frozen=True, slots=True)
class EpisodeResult:
    """A finished episode, with the row for `rollouts` shards when it was asked for."""

    record: EpisodeRecord
    rollout: Mapping[str, Any] | None = None


#: Opens a session for a job and attaches privileged planners to it.
Opener = Callable[[WorkerSetup, EpisodeJob, Planner], RunnableSession]


def _open(setup: WorkerSetup, job: EpisodeJob, planner: Planner) -> RunnableSession:
    from proprio_mllm.evaluation.sessions import open_session  # physics and rendering load only where they run

    return open_session(job.robot, setup.difficulty, setup.start, job.task, job.luck, planner, contingency=setup.contingency)


class EpisodeWorker:
    """Runs episodes one after the other.

    Args:
        setup: what they share.
        opener: opens sessions; the simulator's by default.
    """

    def __init__(self, setup: WorkerSetup, opener: Opener = _open) -> None:
        logging.basicConfig(level=logging.WARNING, format="%(levelname)s %(name)s: %(message)s")
        self.setup = setup
        self._opener = opener
        if setup.planner.kind == "expert":
            from proprio_mllm.evaluation.privileged import ExpertPlanner

            self.planner: Planner = ExpertPlanner(setup.planner.image_size)
        else:
            if setup.planner.kind == "mllm":
                import torch

                torch.set_num_threads(1)
            self.planner = make_planner(setup.planner)

    def __call__(self, job: EpisodeJob) -> EpisodeResult:
        """Runs one episode."""
        recorder = _recorder() if job.record else None
        opened: list[RunnableSession] = []

        def open_session() -> RunnableSession:
            opened.append(self._opener(self.setup, job, self.planner))
            return opened[-1]

        record = run_episode(
            open_session,
            self.planner,
            job.fields,
            job.task.instruction,
            job.task.step_budget,
            job.luck,
            None if recorder is None else recorder.watch,
        )
        if recorder is None or record.outcome is Outcome.INFRASTRUCTURE_ERROR:
            return EpisodeResult(record)
        return EpisodeResult(record, recorder.row(job.task, record, opened[-1].relations()))


def _recorder() -> RolloutRecorder:
    from proprio_mllm.evaluation.recording import RolloutRecorder  # training's row format brings torch, which few runs need

    return RolloutRecorder()


def lost_episode(job: EpisodeJob, message: str) -> EpisodeResult:
    """The result of an episode whose process died."""
    record = EpisodeRecord(
        **dataclasses.asdict(job.fields),
        outcome=Outcome.INFRASTRUCTURE_ERROR,
        failure=None,
        invalid_output=0,
        budget_exhausted=False,
        goal_conditions_met=0.0,
        steps=0,
        makespan_s=0.0,
        path_length_m=0.0,
        arm_utilisation=0.0,
        planner_calls=0,
        planner_tokens=0,
        planner_s=0.0,
        wall_s=0.0,
        message=message,
    )
    return EpisodeResult(record)
