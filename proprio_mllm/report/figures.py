"""Figures of runs: failure types per planner, what the benchmark is made of, how long episodes are. PNG through matplotlib.

Paper: the figure of failure types (stacked bars per planner, both robots) and the benchmark's three distributions (object
types, families of single-arm tasks, categories). Every figure says below itself what it was made from.
"""

from __future__ import annotations

import hashlib
import math
import textwrap
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from configs.schema.eval import ExperimentConfig
from interface.episode import Outcome
from proprio_mllm.report.runs import newest
from proprio_mllm.report.stored import Run
from proprio_mllm.report.summary import Row
from sim.tasks.task import Task, load_benchmark, tasks_text

_COLOURS = {"navigation": "#4477aa", "body_adjustment": "#ee8866", "logical": "#bbbbbb"}
_GREEN = "#228833"
_PALE = "#a6c1d9"
#: Room that a bar's label takes, inches: a line of a list, a bar with its name below.
_LINE_INCH = 0.19
_BAR_INCH = 1.05
#: Longest list that stands in one column.
_COLUMN = 36
#: Shares of episodes that are too small to write a number into, percent.
_TOO_FLAT = 5.0


def new_figure(width: float, height: float, panels: int = 1, lines: int = 1) -> tuple[Figure, list[Axes]]:
    """A figure, inches, and its panels line by line; it draws without a display."""
    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure, list(figure.subplots(lines, panels, squeeze=False).flat)


def save_figure(figure: Figure, path: Path, source: str) -> Path:
    """Writes a figure with a line below it that says what it was made from."""
    width = int(figure.get_figwidth() * 17)
    figure.supxlabel(textwrap.fill(source, width), fontsize=7, color="#555555", x=0.01, ha="left")
    figure.savefig(path, dpi=120)
    return path


def _runs_source(runs: Sequence[Run]) -> str:
    """Which runs a figure shows: their folders, seeds and numbers of scored episodes."""
    if not runs:
        return "No run of these planners was found."
    told = [f"{run.folder.name} (seed {run.metadata['seed']}, {len(run.records)} episodes)" for run in runs]
    return f"Measured in this simulator; not comparable with the paper's figures. Runs: {'; '.join(told)}."


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
    """Stacked bars: share of episodes that failed, by type, with the numbers of episodes in them and above."""
    places = np.arange(len(rows))
    base = np.zeros(len(rows))
    for kind, colour in _COLOURS.items():
        counts = [int(getattr(row, kind)) for _, row in rows]
        share = np.array([100 * count / max(row.episodes, 1) for count, (_, row) in zip(counts, rows, strict=True)])
        bars = axes.bar(places, share, bottom=base, label=kind.replace("_", " "), color=colour, width=0.7)
        axes.bar_label(
            bars, [str(n) if s >= _TOO_FLAT else "" for n, s in zip(counts, share, strict=True)], label_type="center"
        )
        base += share
    for place, top, (_, row) in zip(places, base, rows, strict=True):
        failed = row.navigation + row.body_adjustment + row.logical
        axes.text(float(place), float(top) + 1.0, f"{failed}/{row.episodes}", ha="center", va="bottom", fontsize=8)
    axes.set_xticks(places, [textwrap.fill(name, 13) for name, _ in rows], fontsize=8)
    axes.set_xlim(-0.6, max(len(rows), 1) - 0.4)
    axes.set_ylim(0, 108)
    axes.set_yticks(range(0, 101, 20))
    axes.set_ylabel("failed episodes, %")
    axes.set_title(title)
    if rows:
        axes.legend(frameon=False, ncols=3, loc="upper center", bbox_to_anchor=(0.5, -0.14), fontsize=8)
    else:
        _say_empty(axes)
    axes.spines[["top", "right"]].set_visible(False)


def _say_empty(axes: Axes) -> None:
    axes.text(0.5, 0.5, "no runs", ha="center", va="center", transform=axes.transAxes, color="#777777")
    axes.set_xticks([])
    axes.set_yticks([])


def _shown(cfg: ExperimentConfig, runs: Sequence[Run], robot: str) -> list[Run]:
    found = [newest(runs, name, robot, cfg.difficulties[0]) for name in cfg.planners]
    return [run for run in found if run is not None and run.row("all") is not None]


def failure_figure(cfg: ExperimentConfig, runs: Sequence[Run], folder: Path) -> list[Path]:
    """Failure types per planner, one panel per robot; planners without a run are left out."""
    shown = {robot: _shown(cfg, runs, robot) for robot in cfg.robots}
    width = 1.2 + _BAR_INCH * max(4, *(len(group) for group in shown.values()))
    figure, panels = new_figure(width * len(cfg.robots), 4.4, len(cfg.robots))
    for axes, (robot, group) in zip(panels, shown.items(), strict=True):
        rows = [(str(run.metadata["label"]), row) for run in group if (row := run.row("all")) is not None]
        plot_failures(axes, rows, f"{robot.upper()}, {cfg.difficulties[0]}")
    used = [run for group in shown.values() for run in group]
    return [save_figure(figure, folder / "failure_figure.png", f"Numbers: failed episodes. {_runs_source(used)}")]


def _bars(
    axes: Axes, names: Sequence[str], counts: Mapping[str, int], title: str, part: Mapping[str, int] | None = None
) -> None:
    """Horizontal bars with their numbers, the first one on top; `part` is the darker share of each."""
    places = np.arange(len(names))[::-1]
    bars = axes.barh(places, [counts[name] for name in names], color=_COLOURS["navigation"] if part is None else _PALE)
    if part is not None:
        axes.barh(places, [part.get(name, 0) for name in names], color=_COLOURS["navigation"])
    axes.bar_label(bars, [str(counts[name]) for name in names], padding=2, fontsize=7)
    axes.set_yticks(places, [name.replace("_", " ") for name in names], fontsize=7.5)
    axes.set_ylim(-0.7, max(len(names), 1) - 0.3)
    axes.set_xlim(0, 1.15 * max(counts.values(), default=1))
    axes.xaxis.set_major_locator(MaxNLocator(5, integer=True))
    axes.tick_params(axis="x", labelsize=7)
    axes.set_title(title, fontsize=9)
    axes.spines[["top", "right"]].set_visible(False)


def _ranked(counts: Mapping[str, int]) -> list[str]:
    return sorted(counts, key=lambda name: (-counts[name], name))


def _types(names: Iterable[str]) -> set[str]:
    return {name.rsplit("_", 1)[0] for name in names}


def task_distribution(tasks: Sequence[Task], path: Path) -> Path:
    """Tasks by object type, by family of single-arm and of dual-arm tasks, by category, by room."""
    goals = [_types(name for goal in task.goals for name in goal.object_ids()) for task in tasks]
    placed = [_types(placement.object_id for placement in task.placements) for task in tasks]
    scenes = Counter(kind for named, own in zip(goals, placed, strict=True) for kind in named | own)
    wanted = Counter(kind for named in goals for kind in named)
    single = Counter(task.family for task in tasks if task.category == "single")
    pairs = Counter(task.family for task in tasks if task.category != "single")
    small = {
        "categories": Counter(task.category for task in tasks),
        f"families, {sum(single.values())} single-arm tasks": single,
        "rooms": Counter(task.room for task in tasks),
    }
    types = _ranked(scenes)
    each = max(math.ceil(len(types) / max(1, math.ceil(len(types) / _COLUMN))), 1)
    columns = [types[start : start + each] for start in range(0, len(types), each)] or [[]]
    lines = max(*(len(column) for column in columns), len(pairs), sum(len(counts) + 3 for counts in small.values()))
    figure, panels = new_figure(4.2 * (len(columns) + 2), 1.2 + _LINE_INCH * lines, len(columns) + 2)
    for number, column in enumerate(columns):
        title = "object types: tasks with one in a goal (dark), in the scene" if number == 0 else ""
        _bars(panels[number], column, scenes, title, wanted)
        panels[number].set_xlim(0, 1.15 * max(scenes.values(), default=1))
    _bars(panels[-2], _ranked(pairs), pairs, f"families, {sum(pairs.values())} dual-arm tasks")
    for axes, column in zip(panels[:-1], [*columns, list(pairs)], strict=True):  # lists of any length, lines as high
        axes.set_ylim(len(column) - 0.3 - lines, len(column) - 0.3)
    _stacked(panels[-1], small)
    digest = hashlib.sha256(tasks_text(list(tasks)).encode()).hexdigest()[:12]
    return save_figure(figure, path, f"{len(tasks)} tasks of the benchmark, content {digest}; counts of tasks.")


def _stacked(axes: Axes, groups: Mapping[str, Counter[str]]) -> None:
    """Short lists below each other in the place of one panel."""
    figure, place = axes.figure, axes.get_subplotspec()
    assert place is not None
    axes.remove()
    grid = place.subgridspec(len(groups), 1, height_ratios=[len(counts) + 2 for counts in groups.values()])
    for number, (title, counts) in enumerate(groups.items()):
        _bars(figure.add_subplot(grid[number]), _ranked(counts), counts, title)


def distribution_figures(cfg: ExperimentConfig, runs: Sequence[Run], folder: Path) -> list[Path]:
    """The benchmark's make-up, and steps per episode of each planner that was run."""
    files = [task_distribution(load_benchmark(), folder / "task_distribution.png")]
    shown = {robot: _shown(cfg, runs, robot) for robot in cfg.robots}
    width = 1.2 + _BAR_INCH * max(4, *(len(group) for group in shown.values()))
    figure, panels = new_figure(width * len(cfg.robots), 4.2, len(cfg.robots))
    for axes, (robot, group) in zip(panels, shown.items(), strict=True):
        won = [(run, [r.steps for r in run.records if r.outcome is Outcome.SUCCESS]) for run in group]
        won = [(run, steps) for run, steps in won if steps]
        axes.set_ylabel("steps of successful episodes")
        axes.set_title(f"{robot.upper()}, {cfg.difficulties[0]}")
        axes.spines[["top", "right"]].set_visible(False)
        if won:
            labels = [f"{textwrap.fill(str(run.metadata['label']), 13)}\nn={len(steps)}" for run, steps in won]
            axes.boxplot([steps for _, steps in won], tick_labels=labels, medianprops={"color": _COLOURS["body_adjustment"]})
            axes.tick_params(axis="x", labelsize=8)
            axes.yaxis.set_major_locator(MaxNLocator(integer=True))
        else:
            _say_empty(axes)
    top = max(axes.get_ylim()[1] for axes in panels)
    for axes in panels:  # bodies side by side, on one scale
        axes.set_ylim(0, top)
    used = [run for group in shown.values() for run in group]
    source = f"Box: quartiles; line: median; whiskers: 1.5 quartile ranges. {_runs_source(used)}"
    return [*files, save_figure(figure, folder / "steps_distribution.png", source)]
