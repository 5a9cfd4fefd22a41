"""The paper's tables and figures, assembled from the runs that exist: ours, and the paper's beside it in columns of their own.

A cell is empty when nothing was run for it; nothing is run here. Paper: Tables II (main), III (re-planning), IV (ablation),
and the figures of failure types and of the benchmark's distributions.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from configs.compose import group_file, groups
from configs.schema.eval import ExperimentConfig
from configs.schema.planner import CHAT_KINDS
from data.files import write_text
from proprio_mllm.report.figures import distribution_figures, failure_figure
from proprio_mllm.report.paper import PAPER_ROWS, paper_ablation, paper_main, paper_replanning
from proprio_mllm.report.runs import newest
from proprio_mllm.report.stored import Run, find_runs
from proprio_mllm.report.table import Table, first_try_cell, in_time_cell, rate_cell

_CATEGORIES: Final = ("essential", "optional", "single")
_PAPER_NOTE: Final = "paper: printed in the paper, another simulator and a 7B model; not comparable in size, shown apart."


#: A model and its cells: the run to show, if there is one, and the category.
_Row = tuple[str | None, list[tuple[Run | None, str]]]
#: Runs that a note names.
_NAMED: Final = 6
#: What a place's columns are: success, success in time, share of first tries in reach.
_RATES: Final = ("", " in time", " first try %")
_COSTS: Final = ("invalid %", "broken", "calls", "tokens", "USD", "model")


def _planner(name: str) -> Mapping[str, Any]:
    """A planner's configuration file; empty for one that has none."""
    return group_file("planner", name)


def _label(name: str) -> str:
    return str(_planner(name).get("label", name))


def _models(runs: Sequence[Run], planner: str) -> list[str | None]:
    """Models that have answered a planner, the newest first; [None] for a planner without runs or backends."""
    found = [run.backend.get("model", "") for run in runs if run.metadata["planner"] == planner and not run.machinery]
    return list(dict.fromkeys(found)) or [None]


def _title(planner: str, model: str | None) -> str:
    """A row's name: the planner's label, and the model behind it where that is a choice or not the planner's own."""
    label, kind = _label(planner), _planner(planner).get("kind")
    if not model or (kind == "plain" and _own_model(planner) == model):
        return label
    if Path(model).is_dir():
        model = Path(model).resolve().name
    return f"Plain prompting ({model})" if kind == "plain" else f"{label} ({model})"


def _own_model(planner: str) -> str:
    """The model that a planner's file names through its backend; empty for one that the user gives as a folder."""
    named = [entry for entry in _planner(planner).get("defaults", ()) if isinstance(entry, dict)]
    backend = next((value for entry in named for key, value in entry.items() if "/backend" in key), None)
    if backend is None:
        return ""
    model = str(group_file("backend", backend).get("model", ""))
    return "" if model == "???" else model


def _costs(shown: Sequence[Run]) -> tuple[str, ...]:
    """What the runs of a row cost, per episode, how much of it was invalid or broke, and who answered."""
    records = [record for run in {run.folder: run for run in shown}.values() for record in run.records]
    if not records:
        return ("",) * len(_COSTS)
    calls = sum(record.planner_calls for record in records)
    invalid = sum(record.invalid_output for record in records)
    prices = [record.planner_usd for record in records]
    usd = "" if None in prices else f"{sum(filter(None, prices)) / len(records):.4f}"
    broken = sum(len(run.broken) for run in {run.folder: run for run in shown}.values())
    tokens = sum(record.planner_tokens for record in records)
    return (
        f"{100 * invalid / calls:.1f}" if calls else "", str(broken), f"{calls / len(records):.1f}",
        f"{tokens / len(records):.0f}", usd, "; ".join(dict.fromkeys(run.model for run in shown if run.model)),
    )  # fmt: skip


def _rates(run: Run | None, category: str) -> tuple[str, str, str]:
    """Success, success in time, first tries; of a run that is not finished they say how many episodes there will be."""
    row = None if run is None else run.row(category)
    if run is None or row is None:
        return "", "", ""
    planned = run.planned(category)
    rest = "" if row.episodes == planned else f" of {planned}"
    return rate_cell(row) + rest, in_time_cell(row) + rest, first_try_cell(row)


def _columns(places: Iterable[str]) -> list[str]:
    """Headings of `_rates` of each place."""
    return [f"{place}{suffix}" for place in places for suffix in _RATES]


def _filled(rows: Sequence[_Row]) -> Sequence[_Row]:
    """The models of a planner with a run to show; of a planner without any, one empty row in its own name."""
    return [row for row in rows if any(run is not None for run, _ in row[1])] or [(None, rows[0][1])]


def _left_out(
    cfg: ExperimentConfig,
    difficulties: Sequence[str],
    robots: Sequence[str],
    runs: Sequence[Run],
    shown: Sequence[Run | None],
) -> tuple[str, ...]:
    """What to know of runs of these planners, robots and difficulties that fill no cell."""
    folders = {run.folder for run in shown if run is not None}
    asked = [run for run in runs if run.metadata["planner"] in cfg.planners and run.folder not in folders]
    titles = [run.title for run in asked if run.metadata["robot"] in robots and run.metadata["difficulty"] in difficulties]
    if not titles:
        return ()
    more = f" and {len(titles) - _NAMED} more" if len(titles) > _NAMED else ""
    return (
        f"Not shown, since they are over a part of the tasks, with other settings, of a script, or older or smaller than "
        f"a run that is shown: {'; '.join(titles[:_NAMED])}{more}.",
    )


def _own_row(title: str, cells: Sequence[tuple[Run | None, str]]) -> tuple[str, ...]:
    """A row of ours from (run, category) per cell."""
    shown = [run for run, _ in cells if run is not None]
    return (title, "ours", *(text for run, category in cells for text in _rates(run, category)), *_costs(shown))


def _paper_row(method: str, values: Mapping[Any, float], places: Sequence[Any]) -> tuple[str, ...]:
    """A row of the paper's figures; it names no costs."""
    rest = ("",) * (len(_RATES) - 1)
    cells = (text for place in places for text in (f"{values[place]:.2f}" if place in values else "", *rest))
    return (method, "paper", *cells, *("",) * len(_COSTS))


def main_table(cfg: ExperimentConfig, runs: Sequence[Run]) -> Table:
    """Success by category and robot: a row per planner and model, the paper's row of that method below it."""
    places = [(category, robot) for category in _CATEGORIES for robot in cfg.robots]
    difficulty, paper = cfg.difficulties[0], dict(paper_main())
    body: list[tuple[str, ...]] = []
    shown: list[Run | None] = []
    for name in cfg.planners:
        rows = [
            (model, [(newest(runs, name, robot, difficulty, category, model=model), category) for category, robot in places])
            for model in _models(runs, name)
        ]
        shown += [run for _, cells in rows for run, _ in cells]
        body += [_own_row(_title(name, model), cells) for model, cells in _filled(rows)]
        method = PAPER_ROWS.get(name, (None, None, None))[0]
        if method is not None:
            body.append(_paper_row(method, paper.pop(method), places))
    body += [_paper_row(method, values, places) for method, values in paper.items()]
    columns = ("planner", "source", *_columns(f"{category} {robot}" for category, robot in places), *_COSTS)
    notes = (
        "ours: success within 50 steps, and within the task's own time limit (in time), in %, 95 % interval over tasks, "
        "successes/episodes, `of N` in a run that is not finished; first try: share of first tries in reach. calls, "
        "tokens, USD: means per episode; invalid: share of calls; broken: attempts that failed for reasons outside the "
        "planner, run again and not scored.",
        _PAPER_NOTE,
        *_left_out(cfg, (difficulty,), cfg.robots, runs, shown),
    )
    return Table(f"Success by category ({difficulty})", columns, tuple(body), notes)


def replanning_table(cfg: ExperimentConfig, runs: Sequence[Run]) -> Table:
    """Success at each difficulty on dual-arm essential tasks, with reflection and without."""
    robot, paper = cfg.robots[0], dict(paper_replanning())
    body: list[tuple[str, ...]] = []
    shown: list[Run | None] = []
    for name in cfg.planners:
        method = PAPER_ROWS.get(name, (None, None, None))[1]
        reflects = _planner(name).get("kind") in ("mllm", *CHAT_KINDS)
        for reflection, suffix in (("on", ""), ("off", " without reflection"))[: 2 if reflects else 1]:
            rows = [
                (
                    model,
                    [
                        (newest(runs, name, robot, difficulty, "essential", reflection, model), "essential")
                        for difficulty in cfg.difficulties
                    ],
                )
                for model in _models(runs, name)
            ]
            shown += [run for _, cells in rows for run, _ in cells]
            body += [_own_row(f"{_title(name, model)}{suffix}", cells) for model, cells in _filled(rows)]
            values = paper.pop(f"{method}{suffix}", None)
            if values is not None:
                body.append(_paper_row(f"{method}{suffix}", values, cfg.difficulties))
    body += [_paper_row(method, values, cfg.difficulties) for method, values in paper.items()]
    columns = ("planner", "source", *_columns(cfg.difficulties), *_COSTS)
    notes = (
        "Low-level skills succeed in 100 % (easy), 50 % (medium), 20 % (hard) of the cases. Without reflection: see "
        "docs/planners.md for what each planner then leaves out.",
        _PAPER_NOTE,
        *_left_out(cfg, cfg.difficulties, (robot,), runs, shown),
    )
    return Table(f"Re-planning, dual-arm essential, {robot}", columns, tuple(body), notes)


def ablation_table(cfg: ExperimentConfig, runs: Sequence[Run]) -> Table:
    """Success and failure types of the ablations on dual-arm essential tasks, ours and the paper's in separate columns."""
    robot, difficulty = cfg.robots[0], cfg.difficulties[0]
    paper = paper_ablation()
    body: list[tuple[str, ...]] = []
    shown: list[Run | None] = []
    for name in cfg.planners:
        run = newest(runs, name, robot, difficulty, "essential")
        shown.append(run)
        row = None if run is None else run.row("essential")
        own = (
            ("",) * 6
            if row is None
            else (*_rates(run, "essential"), *map(str, (row.navigation, row.body_adjustment, row.logical)))
        )
        values = paper.get(PAPER_ROWS.get(name, (None, None, None))[2] or "")
        printed = ("", "", "", "")
        if values is not None:
            counts = (f"{values[kind]:.0f}" for kind in ("navigation", "body_adjustment", "logical"))
            printed = (f"{values['success_percent']:.2f}", *counts)
        body.append((_label(name), *own, *printed))
    kinds = ("success", "navigation", "body adj.", "logical")
    columns = ("planner", "success", "in time", "first try %", *kinds[1:], *(f"paper {kind}" for kind in kinds))
    left_out = _left_out(cfg, (difficulty,), (robot,), runs, shown)
    notes = ("The paper counts failures over 133 tasks x 50 trials.", _PAPER_NOTE, *left_out)
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

    Raises:
        ValueError: when a planner is named that does not exist and has no run.
    """
    folder = output / "experiments"
    folder.mkdir(parents=True, exist_ok=True)
    runs = find_runs(output)
    known = {*groups()["planner"], *(str(run.metadata["planner"]) for run in runs)}
    unknown = [name for name in cfg.planners if name not in known]
    if unknown:
        raise ValueError(f"experiment.planners: {unknown[0]!r} is no planner and no run's; allowed: {', '.join(sorted(known))}")
    if cfg.name in _FIGURES:
        return None, _FIGURES[cfg.name](cfg, runs, folder)
    table = _TABLES[cfg.name](cfg, runs)
    texts = {".md": table.to_markdown(), ".csv": table.to_csv(), ".tex": table.to_latex()}
    files = [folder / f"{cfg.name}{suffix}" for suffix in texts]
    for path, text in zip(files, texts.values(), strict=True):
        write_text(path, text)
    return table, files
