"""A table of the paper from nothing: `make reproduce TABLE=main` (replanning, ablation, failures, distributions).

Runs what the table needs and what is not there, and says before it starts how long that takes; prints the table, and beside
each published run (docs/results) whether the rerun agrees: whether its share lies within the published interval. What
needs a language model behind an API or a folder of weights that is not there is named and left out.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal

import eval as evaluation
from configs.arguments import command, read_arguments
from configs.compose import compose
from configs.schema.eval import EvalConfig
from configs.schema.planner import CHAT_KINDS, ModelPlanner
from configs.validate import build
from proprio_mllm.report.runs import newest
from proprio_mllm.report.stored import Run, find_runs
from tools.publish import results

EXPERIMENTS: Final = {
    "main": "main_table",
    "replanning": "replanning_table",
    "ablation": "ablation_table",
    "failures": "failure_figure",
    "distributions": "distribution_figures",
}
#: Seconds of one core per episode, planner's part included, measured over 718 episodes each on AMD EPYC cores.
_SECONDS: Final = {"expert": 1.5, "scripted": 1.3, "random": 2.0, "words": 2.6}
_MODEL_SECONDS: Final = 4.3
_CORES: Final = 2


@dataclass(frozen=True)
class ReproduceConfig:
    """What is made.

    Attributes:
        table: main, replanning, ablation, failures or distributions.
        output: folder of all runs.
        dry: say what would be run, and run nothing.
    """

    table: Literal["main", "replanning", "ablation", "failures", "distributions"]
    output: str = "outputs"
    dry: bool = False


@dataclass(frozen=True, slots=True)
class Needed:
    """One run of a table.

    Attributes:
        planner, robot, difficulty: of the run.
        why_not: why it cannot be made here; empty where it can.
    """

    planner: str
    robot: str
    difficulty: str
    why_not: str = ""

    @property
    def words(self) -> tuple[str, ...]:
        """Of the command line."""
        return (f"planner={self.planner}", f"robot={self.robot}", f"difficulty={self.difficulty}")


def needed(table: str) -> Iterator[Needed]:
    """The runs of a table in its order."""
    experiment = build(EvalConfig, compose("eval", [f"experiment={EXPERIMENTS[table]}"])).experiment
    assert experiment is not None
    for planner in experiment.planners:
        try:
            cfg = build(EvalConfig, compose("eval", [f"planner={planner}"])).planner
        except ValueError as error:
            reason = "needs a backend" if "backend" in str(error) else str(error)
        else:
            reason = "needs a backend" if cfg.kind in CHAT_KINDS else ""
            if isinstance(cfg, ModelPlanner) and not Path(cfg.weights).is_dir():
                reason = f"no weights {cfg.weights}"
        for robot in experiment.robots:
            for difficulty in experiment.difficulties:
                yield Needed(planner, robot, difficulty, reason)


def agreements(runs: Sequence[Run], results: Mapping[str, Mapping[str, Any]]) -> Iterator[str]:
    """A line for each published run that has been made again."""
    for result in results.values():
        settings = tuple(result[name] for name in ("planner", "robot", "difficulty", "category", "reflection"))
        run = newest(runs, *settings)
        again = None if run is None else run.row(result["category"])
        if run is None or again is None or again.episodes != run.planned(result["category"]):
            continue
        row = result["rows"][result["category"]]
        verdict = "agrees" if row["low"] <= again.success_rate <= row["high"] else "DIFFERS"
        yield (
            f"{' '.join(settings)}: published {row['successes']}/{row['episodes']} [{row['low']:.0%}, {row['high']:.0%}], "
            f"here {again.successes}/{again.episodes}: {verdict}"
        )


@command(ValueError, OSError)
def main(arguments: Sequence[str]) -> int:
    """Command line; 1 where a run fails or a published figure does not come out again."""
    config = read_arguments(ReproduceConfig, arguments)
    todo, runs = list(needed(config.table)), find_runs(Path(config.output))
    missing: list[Needed] = []
    for one in todo:
        found = newest(runs, one.planner, one.robot, one.difficulty)
        there = found is not None and found.complete
        sys.stdout.write(f"{' '.join(one.words)}: {'there' if there else one.why_not or 'to be run'}\n")
        if not there and not one.why_not:
            missing.append(one)
    minutes = sum(_SECONDS.get(one.planner, _MODEL_SECONDS) for one in missing) * 359 / 60 / _CORES
    sys.stdout.write(f"{len(missing)} runs, about {minutes:.0f} minutes on {_CORES} cores\n")
    if config.dry:
        return 0
    failed = sum(evaluation.main([*one.words, f"output={config.output}"]) != 0 for one in missing)
    failed += evaluation.main([f"experiment={EXPERIMENTS[config.table]}", f"output={config.output}"]) != 0
    lines = list(agreements(find_runs(Path(config.output)), results()))
    sys.stdout.write("\n".join(lines) + "\n")
    return 1 if failed or any(line.endswith("DIFFERS") for line in lines) else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
