"""Half a minute that says whether this machine does what it should: `python eval.py sanity=true`.

Two short tasks of the benchmark on each robot of the paper, with the expert, which has to solve them, the rules and the tiny
model in words. Nothing of it is kept.
"""

from __future__ import annotations

import logging
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from configs.compose import compose
from configs.schema.eval import EvalConfig
from configs.validate import build
from interface.bodies import PAPER_ROBOTS
from interface.episode import Outcome
from proprio_mllm.evaluation.run import evaluate
from sim.tasks.task import load_benchmark, write_tasks

PLANNERS: Final = ("expert", "scripted", "words")
_CATEGORIES: Final = ("single", "essential")


@dataclass(frozen=True, slots=True)
class Verdict:
    """What became of one planner on one robot.

    Attributes:
        planner: its name.
        robot: the robot.
        solved: tasks that it solved.
        tasks: tasks that it was given.
        broken: the first error that was none of the planner's; empty when there was none.
        seconds: it took.
    """

    planner: str
    robot: str
    solved: int
    tasks: int
    broken: str
    seconds: float

    @property
    def good(self) -> bool:
        """Whether nothing broke, and the expert solved all."""
        return not self.broken and (self.planner != PLANNERS[0] or self.solved == self.tasks)

    def to_text(self) -> str:
        """One line."""
        mark = "ok   " if self.good else "fault"
        return (
            f"{mark}  {self.planner:<9} {self.robot}  {self.solved} of {self.tasks} solved, {self.seconds:.1f} s  {self.broken}"
        )


def sanity(planners: Sequence[str] = PLANNERS, robots: Sequence[str] = PAPER_ROBOTS) -> Iterator[Verdict]:
    """Runs each planner on each robot; tells of each as soon as it is through."""
    benchmark = load_benchmark()
    tasks = [next(task for task in benchmark if task.category == category) for category in _CATEGORIES]
    level = logging.getLogger().level
    logging.getLogger().setLevel(logging.WARNING)
    try:
        with tempfile.TemporaryDirectory(prefix="sanity-") as folder:
            file = Path(folder) / "tasks.jsonl"
            write_tasks(tasks, file)
            common = [f"tasks={file}", "workers=0", f"output={folder}"]
            for planner in planners:
                for robot in robots:
                    started = time.perf_counter()
                    cfg = build(EvalConfig, compose("eval", [f"planner={planner}", f"robot={robot}", *common]))
                    run = evaluate(cfg, told=False)
                    solved = sum(record.outcome is Outcome.SUCCESS for record in run.records)
                    errors = [record.message or record.outcome for record in run.broken]
                    broken = run.stopped or (errors[0].strip().splitlines()[-1] if errors else "")
                    yield Verdict(planner, robot, solved, len(tasks), broken, time.perf_counter() - started)
    finally:
        logging.getLogger().setLevel(level)
