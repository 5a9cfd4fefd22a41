"""Lessons in the simulator: the teacher's steps with mistakes among them, or a model's own steps (DAgger).

Demonstrations hardly show what follows a learned planner's own mistakes: placing with an empty hand, picking up what it holds,
asking for an object it has not seen, going where it stands. So the model of stage `words` acts on training tasks and its
teacher, that of `proprio_mllm.evaluation.lessons`, names the right step in each state. This is the bridge that `train.py`
wires: training asks with a `DaggerRequest` and reads `demos` shards.

Part files are a function of the request and their number, so a run can be killed and continued. The paper has no such data; its
pretrained backbone reads feedback in plain words already.
"""

from __future__ import annotations

import copy
import dataclasses
import functools
import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from tqdm import tqdm

from configs.schema.collect import CollectConfig
from data.shards import Manifest, ShardWriter, config_hash
from data.workers import computed
from interface.actions import ACTIONS, ActionKind
from interface.bodies import PAPER_ROBOTS, Arm
from interface.observation import HistoryItem, Observation
from interface.steps import Action, PlanStep
from proprio_mllm.planners.protocol import TaskInfo
from proprio_mllm.planners.scripted.planner import ScriptedPlanner
from proprio_mllm.training.rollouts import DaggerRequest
from sim.scene.compiler import PHYSICS

#: Episodes of a part.
_PER_PART: Final = 10
#: Raised when the same request gives other rows, so that older ones are not taken for it.
_VERSION: Final = 3


def collect_dagger(request: DaggerRequest, robots: Sequence[str] = PAPER_ROBOTS, workers: int = 2) -> None:
    """Lets the model act and writes a complete shard folder; an interrupted one is continued part by part.

    Args:
        request: the model, how many episodes, and where they go.
        robots: robots, in turn.
        workers: processes; 1 stays in this one.
    """
    config = CollectConfig(
        "demos", str(request.folder), request.episodes, tuple(robots), seed=request.seed, image_size=request.image_size,
        part_size=_PER_PART, noise=request.teacher_share, workers=workers, foreseen=request.foreseen,
    )  # fmt: skip
    model = str(request.model)
    job = functools.partial(_lessons, config, student=model)
    with tqdm(desc="practice", unit="part") as bar:

        def report(done: int, parts: int) -> None:
            bar.total, bar.n = parts, done
            bar.refresh()

        about = {"student": model, "teacher_share": request.teacher_share}
        key = config_hash({"request": request.config_hash, "version": _VERSION})
        _write(config, key, job, about, report, overwrite=True)


def collect_lessons(
    config: CollectConfig, progress: Callable[[int, int], None] | None = None, overwrite: bool = False
) -> Manifest:
    """Writes a complete folder of the teacher's lessons in the simulator; an interrupted one is continued part by part.

    Args:
        config: how many, of whom, and where they go.
        progress: called with (parts done, parts in all).
        overwrite: start over when the folder holds something else.
    """
    keyed = {name: value for name, value in dataclasses.asdict(config).items() if name not in ("out", "workers")}
    keyed["version"] = _VERSION
    report = progress or (lambda done, parts: None)
    return _write(config, config_hash(keyed), functools.partial(_lessons, config), {"config": keyed}, report, overwrite)


def _write(
    config: CollectConfig,
    key: str,
    job: Callable[[int], list[dict[str, Any]]],
    about: Mapping[str, Any],
    progress: Callable[[int, int], None],
    overwrite: bool,
) -> Manifest:
    """Writes the parts that are missing; `job` computes one."""
    writer = ShardWriter(Path(config.out), config.kind, key, overwrite)
    total = -(-config.count // config.part_size)
    missing = writer.missing(total)
    progress(total - len(missing), total)
    calls = {part: functools.partial(job, part) for part in missing}
    for done, (part, rows) in enumerate(computed(calls, config.workers), total - len(missing) + 1):
        writer.write(part, rows)
        progress(done, total)
    return writer.finish({**about, "physics": PHYSICS})


def _lessons(config: CollectConfig, part: int, student: str | None = None) -> list[dict[str, Any]]:
    """One part of a folder of lessons."""
    os.environ.setdefault("MUJOCO_GL", "egl")
    from sim.collection.demonstrations import lessons_of_part

    if student is None:
        return list(lessons_of_part(config, part, Rules()))
    import torch

    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # as in a worker process: their number decides the order of sums, and training has its own
    try:
        return list(lessons_of_part(config, part, Rules(), _in_words(student)))
    finally:
        torch.set_num_threads(threads)


class Rules:
    """The scripted planner as a `Teacher` of `sim.collection.demonstrations`."""

    def __init__(self) -> None:
        self._planner = ScriptedPlanner()

    def __call__(self, observation: Observation) -> tuple[PlanStep, Action | None] | None:
        if not observation.history:
            self._planner.reset(_task(observation), np.random.default_rng(0))
        step, job = self._planner.decide(observation)
        if job is None:
            return None
        arm = job.arm or (Arm.RIGHT if ACTIONS[job.verb].kind is ActionKind.ARM else None)
        return step, job.action(arm) if job.target else None

    def after(self, observation: Observation, refused: HistoryItem) -> PlanStep | None:
        later = dataclasses.replace(observation, history=(*observation.history, refused))
        step, job = copy.deepcopy(self._planner).decide(later)
        return None if job is None else step


def _in_words(model: str) -> Callable[[Observation], PlanStep | None]:
    """A words model as a student of `sim.collection.demonstrations`."""
    from proprio_mllm.planners.words import WordsPlanner

    planner = WordsPlanner.load(Path(model))

    def step(observation: Observation) -> PlanStep | None:
        if not observation.history:
            planner.reset(_task(observation), np.random.default_rng(0))
        return planner.step(observation, None).step

    return step


def _task(observation: Observation) -> TaskInfo:
    return TaskInfo(observation.instruction, observation.robot, observation.time_limit)
