"""Figures of runs: failure types per planner, what the benchmark is made of, how long episodes are. PNG through matplotlib."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from configs.schema.eval import ExperimentConfig
from data.records import Outcome
from proprio_mllm.report.runs import Run, newest
from proprio_mllm.report.summary import Row
from sim.tasks.task import Task, load_benchmark

__all__ = ["distribution_figures", "failure_figure", "plot_failures", "plot_success"]

_COLOURS = {"navigation": "#4477aa", "body_adjustment": "#ee8866", "logical": "#bbbbbb"}
_GREEN = "#228833"


def _figure(width: float, height: float, panels: int = 1) -> tuple[Figure, list[Axes]]:
    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(1, panels, squeeze=False)
    return figure, list(axes[0])


def plot_success(axes: Axes, rows: Sequence[Row], title: str = "") -> None:
    """Bars of the success rate per row with its interval."""
    shown = [row for row in rows if row.episodes]
    rates = np.array([100 * row.success_rate for row in shown])
    limits = np.array([[100 * row.low, 100 * row.high] for row in shown]).reshape(-1, 2)
    errors = np.abs(limits.T - rates) if len(shown) else None
    axes.bar([row.category for row in shown], rates, yerr=errors, capsize=4, color=_GREEN)
    axes.set_ylim(0, 100)
    axes.set_ylabel("success, % (95 % interval over tasks)")
    axes.set_title(title)


def plot_failures(axes: Axes, rows: Sequence[tuple[str, Row]], title: str = "") -> None:
    """Stacked bars: share of episodes that failed, by type."""
    names = [name for name, _ in rows]
    base = np.zeros(len(rows))
    for kind, colour in _COLOURS.items():
        share = np.array([100 * getattr(row, kind) / max(row.episodes, 1) for _, row in rows])
        axes.bar(names, share, bottom=base, label=kind.replace("_", " "), color=colour)
        base += share
    axes.set_ylim(0, 100)
    axes.set_ylabel("failed episodes, %")
    axes.set_title(title)
    axes.tick_params(axis="x", rotation=20)
    axes.legend(frameon=False)


def failure_figure(cfg: ExperimentConfig, runs: Sequence[Run], folder: Path) -> list[Path]:
    """Failure types per planner, one panel per robot; planners without a run are left out."""
    figure, panels = _figure(5.5 * len(cfg.robots), 4.2, len(cfg.robots))
    for axes, robot in zip(panels, cfg.robots, strict=True):
        rows: list[tuple[str, Row]] = []
        for name in cfg.planners:
            run = newest(runs, name, robot, cfg.difficulties[0])
            row = None if run is None else run.row("all")
            if run is not None and row is not None:
                rows.append((str(run.metadata["label"]), row))
        plot_failures(axes, rows, f"{robot}, {cfg.difficulties[0]}")
    path = folder / "failure_figure.png"
    figure.savefig(path, dpi=120)
    return [path]


def _bars(axes: Axes, counts: Counter[str], title: str) -> None:
    names = sorted(counts, key=lambda name: (-counts[name], name))
    axes.barh(names[::-1], [counts[name] for name in names[::-1]], color=_COLOURS["navigation"])
    axes.set_title(title)


def task_distribution(tasks: Sequence[Task], path: Path) -> Path:
    """Tasks by category, family and room, and the objects that goals name."""
    figure, axes = _figure(17, 4.6, 4)
    _bars(axes[0], Counter(task.category for task in tasks), f"{len(tasks)} tasks by category")
    _bars(axes[1], Counter(task.family for task in tasks), "by family")
    _bars(axes[2], Counter(task.room for task in tasks), "by room")
    types = Counter(
        kind for task in tasks for kind in {name.rsplit("_", 1)[0] for goal in task.goals for name in goal.object_ids()}
    )
    _bars(axes[3], Counter(dict(types.most_common(20))), "object types in goals")
    figure.savefig(path, dpi=110)
    return path


def distribution_figures(cfg: ExperimentConfig, runs: Sequence[Run], folder: Path) -> list[Path]:
    """The benchmark's make-up, and steps per episode of each planner that was run."""
    files = [task_distribution(load_benchmark(), folder / "task_distribution.png")]
    figure, panels = _figure(5.5 * len(cfg.robots), 4.2, len(cfg.robots))
    for axes, robot in zip(panels, cfg.robots, strict=True):
        labels: list[str] = []
        steps: list[list[int]] = []
        for name in cfg.planners:
            run = newest(runs, name, robot, cfg.difficulties[0])
            won = [] if run is None else [r.steps for r in run.records if r.outcome is Outcome.SUCCESS]
            if run is not None and won:
                labels.append(str(run.metadata["label"]))
                steps.append(won)
        if steps:
            axes.boxplot(steps, tick_labels=labels)
        axes.set_ylabel("steps of successful episodes")
        axes.set_title(robot)
        axes.tick_params(axis="x", rotation=20)
    path = folder / "steps_distribution.png"
    figure.savefig(path, dpi=120)
    return [*files, path]
