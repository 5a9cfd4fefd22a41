"""The paper's tables and figures, assembled from the runs that exist: ours, and the paper's beside it in columns of their own.

A cell is empty when nothing was run for it; nothing is run here. Paper: Tables II (main), III (re-planning), IV (ablation),
and the figures of failure types and of the benchmark's distributions.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Final

import yaml

from configs.compose import CONFIG_DIR
from configs.schema.eval import ExperimentConfig
from data.files import write_text
from proprio_mllm.report.figures import distribution_figures, failure_figure
from proprio_mllm.report.paper import PAPER_ROWS, paper_ablation, paper_main, paper_replanning
from proprio_mllm.report.runs import Run, find_runs, newest
from proprio_mllm.report.table import Table, rate_cell

__all__ = ["EXPERIMENTS", "ablation_table", "assemble", "main_table", "replanning_table"]

_CATEGORIES: Final = ("essential", "optional", "single")
_PAPER_NOTE: Final = "paper: printed in the paper, another simulator and a 7B model; not comparable in size, shown apart."


def _label(name: str) -> str:
    path = CONFIG_DIR / "planner" / f"{name}.yaml"
    return str(yaml.safe_load(path.read_text(encoding="utf-8"))["label"]) if path.is_file() else name


def _cell(runs: Sequence[Run], planner: str, robot: str, difficulty: str, category: str) -> str:
    run = newest(runs, planner, robot, difficulty, category)
    row = None if run is None else run.row(category)
    return "" if row is None else rate_cell(row)


def main_table(cfg: ExperimentConfig, runs: Sequence[Run]) -> Table:
    """Success by category and robot, one row per planner, then the paper's rows."""
    places = [(category, robot) for category in _CATEGORIES for robot in cfg.robots]
    columns = ("planner", "source", *(f"{category} {robot}" for category, robot in places))
    difficulty = cfg.difficulties[0]
    ours = [
        (_label(name), "ours", *(_cell(runs, name, robot, difficulty, category) for category, robot in places))
        for name in cfg.planners
    ]
    printed = [
        (name, "paper", *(f"{values[place]:.2f}" if place in values else "" for place in places))
        for name, values in paper_main().items()
    ]
    notes = ("ours: success in %, 95 % interval over tasks, successes/episodes.", _PAPER_NOTE)
    return Table(f"Success by category ({difficulty})", columns, (*ours, *printed), notes)


def replanning_table(cfg: ExperimentConfig, runs: Sequence[Run]) -> Table:
    """Success at each difficulty on dual-arm essential tasks."""
    robot = cfg.robots[0]
    ours = [
        (_label(name), "ours", *(_cell(runs, name, robot, difficulty, "essential") for difficulty in cfg.difficulties))
        for name in cfg.planners
    ]
    printed = [
        (name, "paper", *(f"{values[d]:.2f}" if d in values else "" for d in cfg.difficulties))
        for name, values in paper_replanning().items()
    ]
    columns = ("planner", "source", *cfg.difficulties)
    notes = ("Low-level skills succeed in 100 % (easy), 50 % (medium), 20 % (hard) of the cases.", _PAPER_NOTE)
    return Table(f"Re-planning, dual-arm essential, {robot}", columns, (*ours, *printed), notes)


def ablation_table(cfg: ExperimentConfig, runs: Sequence[Run]) -> Table:
    """Success and failure types of the ablations on dual-arm essential tasks, ours and the paper's in separate columns."""
    robot, difficulty = cfg.robots[0], cfg.difficulties[0]
    paper = paper_ablation()
    body: list[tuple[str, ...]] = []
    for name in cfg.planners:
        run = newest(runs, name, robot, difficulty, "essential")
        row = None if run is None else run.row("essential")
        own = (
            ("", "", "", "") if row is None else (rate_cell(row), *map(str, (row.navigation, row.body_adjustment, row.logical)))
        )
        values = paper.get(PAPER_ROWS.get(name, (None, None, None))[2] or "")
        printed = ("", "", "", "")
        if values is not None:
            counts = (f"{values[kind]:.0f}" for kind in ("navigation", "body_adjustment", "logical"))
            printed = (f"{values['success_percent']:.2f}", *counts)
        body.append((_label(name), *own, *printed))
    kinds = ("success", "navigation", "body adj.", "logical")
    columns = ("planner", *kinds, *(f"paper {kind}" for kind in kinds))
    notes = ("The paper counts failures over 133 tasks x 50 trials.", _PAPER_NOTE)
    return Table(f"Ablation, dual-arm essential, {robot}, {difficulty}", columns, tuple(body), notes)


_TABLES: Final[Mapping[str, Callable[[ExperimentConfig, Sequence[Run]], Table]]] = {
    "main_table": main_table,
    "replanning_table": replanning_table,
    "ablation_table": ablation_table,
}
_FIGURES: Final[Mapping[str, Callable[[ExperimentConfig, Sequence[Run], Path], list[Path]]]] = {
    "failure_figure": failure_figure,
    "distribution_figures": distribution_figures,
}
EXPERIMENTS: Final = (*_TABLES, *_FIGURES)


def assemble(cfg: ExperimentConfig, output: Path) -> tuple[Table | None, list[Path]]:
    """Makes a table or figure and writes it below `output/experiments`.

    Returns:
        The table, None for a figure; and the files that were written.
    """
    folder = output / "experiments"
    folder.mkdir(parents=True, exist_ok=True)
    runs = find_runs(output)
    if cfg.name in _FIGURES:
        return None, _FIGURES[cfg.name](cfg, runs, folder)
    table = _TABLES[cfg.name](cfg, runs)
    texts = {".md": table.to_markdown(), ".csv": table.to_csv(), ".tex": table.to_latex()}
    files = [folder / f"{cfg.name}{suffix}" for suffix in texts]
    for path, text in zip(files, texts.values(), strict=True):
        write_text(path, text)
    return table, files
