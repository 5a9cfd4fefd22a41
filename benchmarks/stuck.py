"""Whether episodes that were ended as stuck would have succeeded: `python -m benchmarks.stuck runs=[FOLDER,...] episodes=100`.

Takes stuck episodes of finished runs, equally many of each, and runs them again to their last step with
`stuck=0`. Equal seeds and tasks make them the same episodes. Not part of any experiment.
"""

from __future__ import annotations

import dataclasses
import json
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from configs.arguments import command, read_arguments
from configs.schema.eval import EvalConfig
from configs.validate import build
from interface.episode import Outcome
from proprio_mllm.evaluation.run import evaluate, select_tasks
from proprio_mllm.report.stored import load_run
from sim.tasks.task import write_tasks


@dataclass(frozen=True)
class StuckConfig:
    """What is run again.

    Attributes:
        runs: folders of runs.
        episodes: most episodes over all of them.
    """

    runs: tuple[str, ...]
    episodes: int = 100


@command()
def main(arguments: Sequence[str]) -> int:
    """Command line; prints a JSON object per run. Returns 1 when an episode would have succeeded."""
    config = read_arguments(StuckConfig, arguments)
    late = 0
    for folder in config.runs:
        run = load_run(Path(folder))
        cfg = build(EvalConfig, dict(run.metadata["config"]))
        ids = [record.task for record in run.records if record.stuck][: config.episodes // len(config.runs)]
        if not ids:
            continue
        with tempfile.TemporaryDirectory() as place:
            file = Path(place) / "stuck.jsonl"
            write_tasks([task for task in select_tasks(cfg) if task.id in ids], file)
            again = evaluate(dataclasses.replace(cfg, stuck=0, tasks=str(file), output=place))
            solved = [record.task for record in again.records if record.outcome is Outcome.SUCCESS]
            late += len(solved)
            steps = sum(record.steps for record in again.records) / len(again.records)
        line = {"run": run.title, "episodes": len(ids), "steps": round(steps, 1), "would_have_succeeded": solved}
        sys.stdout.write(json.dumps(line) + "\n")
        sys.stdout.flush()
    return int(late > 0)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
