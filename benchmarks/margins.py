"""How close to failure the expert acts: `python -m benchmarks.margins tasks=50`.

The expert solves every n-th task of the benchmark on each robot twice: as it is, and with noise of `disturb` (metres, radians)
on all positions before every step. The last digits of a simulation differ between processors by less; an expert with margins
does not notice either. Not part of any experiment.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from configs.arguments import command, read_arguments
from data.workers import worker_pool
from interface.bodies import PAPER_ROBOTS
from proprio_mllm.report.statistics import wilson
from sim.expert.expert import Expert
from sim.session.session import Session
from sim.tasks.task import load_benchmark


@dataclass(frozen=True)
class MarginsConfig:
    """What is disturbed.

    Attributes:
        tasks: tasks a robot, spread over the benchmark.
        disturb: standard deviation of the noise.
        seed: of the noise.
        workers: processes.
    """

    tasks: int = 50
    disturb: float = 1e-6
    seed: int = 0
    workers: int = 2

    def __post_init__(self) -> None:
        if self.tasks < 1 or self.disturb < 0.0:
            raise ValueError(f"tasks {self.tasks} must be positive and disturb {self.disturb} not negative")


def disturbed(session: Session, scale: float, rng: np.random.Generator) -> None:
    """Moves every joint and every free object a little."""
    model, data = session.world.model, session.world.data
    mujoco.mj_integratePos(model, data.qpos, rng.normal(scale=scale, size=model.nv), 1.0)
    mujoco.mj_forward(model, data)


def solved(job: tuple[str, int, float, int]) -> bool:
    """Whether the expert solves a task within 50 steps."""
    robot, index, scale, seed = job
    task, session = load_benchmark()[index], Session(robot, "easy", image_size=0)
    session.reset(task, seed=task.seed)
    rng, expert = np.random.default_rng((seed, index)), Expert(session)
    expert.reset()
    while not session.finished:
        if scale:
            disturbed(session, scale, rng)
        session.step(expert.next_step())
    success = session.succeeded
    session.close()
    return success


@command()
def main(arguments: Sequence[str]) -> int:
    """Command line; prints a JSON object per robot."""
    config = read_arguments(MarginsConfig, arguments)
    tasks = load_benchmark()
    chosen = np.unique(np.linspace(0, len(tasks) - 1, min(config.tasks, len(tasks))).round().astype(int)).tolist()
    with worker_pool(config.workers) as pool:
        for robot in PAPER_ROBOTS:
            jobs = [(robot, index, scale, config.seed) for scale in (0.0, config.disturb) for index in chosen]
            found = list(pool.map(solved, jobs))
            still, moved = found[: len(chosen)], found[len(chosen) :]
            line = {"robot": robot, "tasks": len(chosen), "undisturbed": sum(still), "disturbed": sum(moved)}
            line |= {"interval": [round(limit, 3) for limit in wilson(sum(moved), len(moved))]}
            line |= {"differ": [tasks[i].id for i, a, b in zip(chosen, still, moved, strict=True) if a != b]}
            sys.stdout.write(json.dumps(line) + "\n")
            sys.stdout.flush()
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
