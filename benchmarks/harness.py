"""What the evaluation harness costs, every ratio within one run.

    python benchmarks/harness.py [--tasks 12] [--repeats 1] [--weights weights/tiny/full] [--out FILE]

* workers: the expert without a picture, the same episodes on one worker and on two; the ratio is of episodes per second from
the start of the first episode to the end of the run, `with_start` of those from the command on. * overhead: the share of an
evaluation's wall time that is neither the simulator's `reset` and `step` nor the planner: goals, records, ledger, hashes,
progress. * cost: hours that 6,650 and 35,900 episodes take at the measured cost per episode; on 64 and 1,024 cores if they
scale as two do. * batches: planner calls per second of one core, asked 1, 2, 4 and 8 at a time.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import statistics
import tempfile
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

import sim.tasks  # noqa: F401  # chooses the OpenGL backend before anything draws
from configs.schema.eval import EvalConfig
from configs.schema.planner import BuiltInPlanner, ModelPlanner
from configs.schema.robot import RobotConfig
from interface.feedback import Feedback
from interface.observation import Observation
from interface.steps import PlanStep
from proprio_mllm.evaluation.episode import GoalReport, RunnableSession, Stats
from proprio_mllm.evaluation.run import EvalRun, evaluate
from proprio_mllm.evaluation.sessions import open_session
from proprio_mllm.evaluation.worker import EpisodeJob, WorkerSetup
from proprio_mllm.planners.protocol import Planner, TaskInfo
from sim.tasks.task import Task, load_benchmark, write_tasks

EXPERT = BuiltInPlanner("expert", "expert", "Expert", image_size=0)
EPISODES = (6_650, 35_900)
CORES = (2, 64, 1_024)


class Timed:
    """A session that notes the seconds spent in the simulator."""

    def __init__(self, session: RunnableSession, spent: list[float]) -> None:
        self._session, self._spent = session, spent

    def reset(self, seed: int) -> Observation:
        started = time.perf_counter()
        seen = self._session.reset(seed)
        self._spent.append(time.perf_counter() - started)
        return seen

    def step(self, step: PlanStep) -> tuple[Observation, Feedback]:
        started = time.perf_counter()
        seen = self._session.step(step)
        self._spent.append(time.perf_counter() - started)
        return seen

    def goals(self) -> GoalReport:
        return self._session.goals()

    def stats(self) -> Stats:
        return self._session.stats()

    def stance(self) -> tuple[float, float, float, float]:
        return self._session.stance()

    def relations(self) -> Mapping[str, Sequence[str]]:
        return self._session.relations()


def config(tasks: Path, folder: Path, workers: int) -> EvalConfig:
    return EvalConfig(EXPERT, RobotConfig("h1"), workers=workers, tasks=str(tasks), output=str(folder))


def scaling(tasks: Path, folder: Path, repeats: int) -> dict[str, Any]:
    """Episodes per second on one worker and on two, in turn."""
    rates: dict[int, list[tuple[float, float]]] = {1: [], 2: []}
    costs: list[float] = []
    count = 0
    for number in range(repeats):
        for workers in rates:
            began = time.time()
            run, first_s = _with_first(config(tasks, folder / f"{number}-{workers}", workers))
            ended = time.time()
            count = len(run.records)
            rates[workers].append((count / (ended - first_s), count / (ended - began)))
            if workers == 1:
                costs.append((ended - first_s) / count)
    ratio = {
        name: statistics.median(two[k] / one[k] for one, two in zip(rates[1], rates[2], strict=True))
        for k, name in enumerate(("speed_up", "with_start"))
    }
    return {"episodes": count, "seconds_per_episode": statistics.median(costs), **ratio}


def _with_first(cfg: EvalConfig) -> tuple[EvalRun, float]:
    """A run, and the time at which its first episode began, by the clock of `time.time`."""
    import proprio_mllm.evaluation.run as harness

    arrived: list[float] = []
    append = harness.Ledger.append

    def noted(self: Any, record: Any) -> None:
        arrived.append(time.time() - record.wall_s)
        append(self, record)

    harness.Ledger.append = noted
    try:
        return evaluate(cfg), min(arrived)
    finally:
        harness.Ledger.append = append


def overhead(tasks: Path, folder: Path) -> dict[str, float]:
    """Shares of the wall time of an evaluation in this process, after one episode that fills the caches."""
    spent: list[float] = []

    def opener(setup: WorkerSetup, job: EpisodeJob, planner: Planner) -> RunnableSession:
        opened = open_session(job.robot, setup.difficulty, setup.start, job.task, job.episode_seed, planner)
        return Timed(opened, spent)

    cfg = config(tasks, folder / "warm", 0)
    evaluate(dataclasses.replace(cfg, limit=1), opener)
    spent.clear()
    started = time.perf_counter()
    run = evaluate(dataclasses.replace(cfg, output=str(folder / "overhead")), opener)
    wall = time.perf_counter() - started
    planner = sum(record.planner_s for record in run.records)
    return {
        "wall_s": wall,
        "simulator": sum(spent) / wall,
        "planner": planner / wall,
        "harness": 1.0 - (sum(spent) + planner) / wall,
    }


def cost(seconds_per_episode: float, speed_up: float) -> dict[str, float]:
    """Hours per number of episodes and cores."""
    share = speed_up / 2.0  # of a core's work that is left when another one works beside it
    return {
        f"{episodes}_episodes_{cores}_cores_h": episodes * seconds_per_episode / (cores * share) / 3600.0
        for episodes in EPISODES
        for cores in CORES
    }


def batches(weights: Path, tasks: Sequence[Task]) -> dict[str, float]:
    """Planner calls per second of one core, the first observation of eight tasks."""
    import torch

    from proprio_mllm.planners.registry import make_planner

    torch.set_num_threads(1)
    planner: Any = make_planner(ModelPlanner("model", "mllm", "Model", str(weights)))
    seen = []
    for task in tasks:
        session = open_session(RobotConfig("h1"), "easy", "fixed", task, 0, planner)
        seen.append(dataclasses.replace(session.reset(0), step=0, time_limit=task.time_limit))
    states = [planner.begin(TaskInfo(one.instruction, "h1", 9), np.random.default_rng(0)) for one in seen]
    rates: dict[str, float] = {}
    for size in (1, 2, 4, 8):
        taken = []
        for _ in range(4):
            started = time.process_time()
            for first in range(0, len(seen), size):
                planner.step_batch(seen[first : first + size], states[first : first + size])
            taken.append(time.process_time() - started)
        rates[f"batch_{size}_calls_per_s"] = len(seen) / min(taken)
    return rates | {"batch_8_over_1": rates["batch_8_calls_per_s"] / rates["batch_1_calls_per_s"]}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tasks", type=int, default=12, help="tasks of the benchmark, evenly spread")
    parser.add_argument("--repeats", type=int, default=1)
    parser.add_argument("--weights", type=Path, default=Path(__file__).parent.parent / "weights" / "tiny" / "full")
    parser.add_argument("--out", type=Path)
    arguments = parser.parse_args()
    everything = load_benchmark()
    spread = np.linspace(0, len(everything) - 1, min(arguments.tasks, len(everything))).round().astype(int)
    chosen = [everything[i] for i in spread]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_tasks(chosen, folder / "tasks.jsonl")
        rows: dict[str, Any] = {"workers": scaling(folder / "tasks.jsonl", folder, arguments.repeats)}
        rows["overhead"] = overhead(folder / "tasks.jsonl", folder)
        rows["cost"] = cost(rows["workers"]["seconds_per_episode"], rows["workers"]["speed_up"])
        rows["batches"] = batches(arguments.weights, chosen[:8])
    for title, values in rows.items():
        print(title)
        for key, value in values.items():
            print(f"  {key:32s} {value if not isinstance(value, float) else round(value, 3)}")
    if arguments.out:
        arguments.out.parent.mkdir(parents=True, exist_ok=True)
        arguments.out.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
