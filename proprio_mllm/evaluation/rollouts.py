"""Rollouts for SELU: an actor explores training tasks at a temperature above zero, and its episodes become shards.

This is the bridge that `train.py` wires: training asks with a `RolloutRequest`, reads the shards and never meets the simulator.
Tasks come from the sampler's training split, so no benchmark task is explored; robots take turns; contingencies are on
(`natural`: every rule's own rates). Paper: SELU, rollouts of the actor.
"""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Iterable, Sequence
from typing import Any, Final

from tqdm import tqdm

from configs.schema.eval import DifficultyName
from configs.schema.planner import ModelPlanner
from configs.schema.robot import RobotConfig
from data.shards import ShardWriter
from interface.bodies import PAPER_ROBOTS
from proprio_mllm.evaluation.episode import EpisodeKeyFields
from proprio_mllm.evaluation.scheduling import scheduled
from proprio_mllm.evaluation.seeds import episode_seed
from proprio_mllm.evaluation.worker import EpisodeJob, EpisodeResult, Opener, WorkerSetup
from proprio_mllm.training.rollouts import RolloutRequest
from sim.tasks.task import Task

logger = logging.getLogger(__name__)

_PER_PART: Final = 12
#: Rounds with different seeds do not share tasks, and neither do rollouts and demonstrations.
_FIRST_SEED: Final = 1_500_000_000
_SEEDS_PER_REQUEST: Final = 10_000


def training_tasks(count: int, seed: int) -> list[Task]:
    """Training tasks from seeds that nothing else uses; a third of a second each."""
    from sim.tasks.sample import sample_task

    first = _FIRST_SEED + (seed % 50_000) * _SEEDS_PER_REQUEST
    return [sample_task(first + number) for number in tqdm(range(count), "tasks to explore", unit="task")]


def collect_rollouts(
    request: RolloutRequest,
    tasks: Sequence[Task] | None = None,
    robots: Sequence[str] = PAPER_ROBOTS,
    difficulty: DifficultyName = "natural",
    opener: Opener | None = None,
) -> None:
    """Runs the actor and writes a complete `rollouts` folder; an interrupted one is continued part by part.

    Args:
        request: the actor, how many episodes, at which temperature, and where they go.
        tasks: training tasks, in turn; drawn from the request's seed by default.
        robots: robots, in turn.
        difficulty: success of low-level skills.
        opener: opens sessions; the simulator's by default.

    Raises:
        ValueError: on a temperature of 0, or when a task is not of the training split.
    """
    if request.temperature <= 0.0:
        raise ValueError(f"temperature {request.temperature} must be positive: exploration needs draws")
    writer = ShardWriter(request.folder, "rollouts", request.config_hash, overwrite=True)
    count = -(-request.episodes // _PER_PART)
    missing = writer.missing(count)
    if missing:
        tasks = training_tasks(request.episodes, request.seed) if tasks is None else tasks
        leaked = [task.id for task in tasks if task.split != "train"]
        if leaked:
            raise ValueError(f"rollouts take training tasks only, got {leaked[0]!r}")
        jobs = _jobs(request, tasks, robots, difficulty)
        parts = {i: jobs[i * _PER_PART : (i + 1) * _PER_PART] for i in missing}
        planner = ModelPlanner("actor", "mllm", "Actor", str(request.model), temperature=request.temperature)
        setup = WorkerSetup(planner, difficulty, "fixed", steps="task")
        queue = [job for part in parts.values() for job in part]
        with contextlib.closing(scheduled(request.execution, setup, queue, _never, opener)) as results:
            _write_parts(writer, parts, results, len(jobs))
    if not writer.manifest.complete:
        broken = request.episodes - sum(part.rows for part in writer.manifest.parts.values())
        writer.finish({"actor": str(request.model), "temperature": request.temperature, "infrastructure_errors": broken})


def _write_parts(writer: ShardWriter, parts: dict[int, list[EpisodeJob]], results: Iterable[EpisodeResult], total: int) -> None:
    """Writes every part as soon as its last episode ends; episodes that broke are left out."""
    owner = {_name(job.fields): index for index, jobs in parts.items() for job in jobs}
    left = {index: len(jobs) for index, jobs in parts.items()}
    rows: dict[int, list[dict[str, Any]]] = {index: [] for index in parts}
    with tqdm(total=total, initial=total - sum(left.values()), desc="rollouts", unit="episode") as bar:
        for result in results:
            bar.update(1)
            record = result.record
            index = owner[record.task, record.robot, record.trial]
            left[index] -= 1
            if result.rollout is None:
                logger.warning("rollout of %s broke: %s", record.task, record.message[-300:])
            else:
                rows[index].append(dict(result.rollout))
            if not left[index]:
                writer.write(index, sorted(rows.pop(index), key=lambda row: row["episode"]))


def _jobs(
    request: RolloutRequest, tasks: Sequence[Task], robots: Sequence[str], difficulty: DifficultyName
) -> list[EpisodeJob]:
    jobs: list[EpisodeJob] = []
    for number in range(request.episodes):
        robot, task, trial = robots[number % len(robots)], tasks[number % len(tasks)], number // len(tasks)
        key = request.config_hash
        fields = EpisodeKeyFields("actor", robot, task.id, task.category, difficulty, trial, request.seed, key)
        own_seed = episode_seed(request.seed, task.id, robot, trial)
        jobs.append(EpisodeJob(fields, RobotConfig(robot), task, own_seed, record=True))
    return jobs


def _name(fields: EpisodeKeyFields) -> tuple[str, str, int]:
    return fields.task, fields.robot, fields.trial


def _never(result: EpisodeResult) -> bool:
    return False
