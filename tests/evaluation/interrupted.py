"""Runs a slow evaluation against the session without a simulator; killed and restarted by test_run."""

from __future__ import annotations

import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

from conftest import FakeSession, make_task

from configs.schema.eval import EvalConfig
from configs.schema.planner import BuiltInPlanner
from configs.schema.robot import RobotConfig
from proprio_mllm.evaluation.run import evaluate
from proprio_mllm.report.runs import write_report
from proprio_mllm.report.stored import load_run
from sim.tasks.task import write_tasks


class SlowSession(FakeSession):
    def step(self, step):
        time.sleep(0.01)
        return super().step(step)


def main(output: Path) -> None:
    output.mkdir(parents=True, exist_ok=True)
    tasks = output / "tasks.jsonl"
    categories = ("single", "optional", "essential")
    if not tasks.exists():
        write_tasks([make_task(f"t{i}", categories[i % 3], budget=12) for i in range(12)], tasks)
    cfg = EvalConfig(
        planner=BuiltInPlanner("random", "random", "Random", image_size=28),
        robot=RobotConfig("h1"),
        trials=2,
        workers=0,
        tasks=str(tasks),
        output=str(output),
    )
    folder = evaluate(cfg, lambda setup, job, planner: SlowSession()).folder
    write_report(load_run(folder))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
