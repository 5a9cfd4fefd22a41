"""Reports of runs: `summary.json` and the table as Markdown, CSV and LaTeX; and which run a cell of a bigger table shows."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from configs.schema.checks import defaults_of
from configs.schema.eval import EvalConfig
from data.files import write_text
from proprio_mllm.backends.factory import SPENDING_FILE
from proprio_mllm.backends.protocol import BackendError
from proprio_mllm.backends.spending import Spending
from proprio_mllm.evaluation.naming import as_published
from proprio_mllm.report.references import references_of
from proprio_mllm.report.stored import Run
from proprio_mllm.report.summary import SUMMARY_VERSION, Row, write_json
from proprio_mllm.report.table import Table, run_table


def run_notes(run: Run) -> list[str]:
    """What to know about a run besides its figures: its physics, what has no score or broke, a privileged planner."""
    notes = [f"Made with physics {run.metadata.get('physics', 1)}."]
    missing = len(run.metadata["planned"]) - len(run.records)
    if missing:
        notes.append(f"{missing} of {len(run.metadata['planned'])} episodes have no score.")
    if run.broken:
        notes.append(f"{len(run.broken)} attempts broke for reasons outside the planner; they are not scored.")
    if run.machinery:
        notes.append("A script answered in place of a model: this tests the machinery and is no result.")
    if run.backend and run.records:
        priced = [record.planner_usd for record in run.records]
        spent = "an unknown price" if None in priced else f"{sum(filter(None, priced)):.4f} USD when they were made"
        calls, cached = sum(r.planner_calls for r in run.records), sum(r.cached_calls for r in run.records)
        notes.append(f"{calls} calls of {run.model or 'a model'}, {cached} of them from the cache, at {spent}.")
        notes += _paid(run.folder / SPENDING_FILE)
    if run.metadata["privileged"]:
        notes.append("Privileged: this planner looks into the simulator's state.")
    return notes


def _paid(path: Path) -> list[str]:
    """What the run's own calls have cost, those of broken and unfinished episodes included."""
    if not path.is_file():
        return []
    try:
        spending = Spending(path, None, read_only=True)
        try:
            total, unknown = spending.total_usd(), spending.open_usd()
        finally:
            spending.close()
    except BackendError as error:
        return [f"What this run has paid cannot be read: {error}."]
    lost = f", {unknown:.4f} of it booked for calls whose reply never came" if unknown else ""
    return [f"This run has paid {total:.4f} USD so far, broken and unfinished episodes included{lost}."] if total else []


def run_report(run: Run, rows: Sequence[Row] | None = None) -> Table:
    """The table of a run.

    Args:
        run: the run.
        rows: its rows when they have been made already.
    """
    if rows is None:
        rows = run.rows(references_of(run))
    return run_table(run.title, rows, run_notes(run))


def write_report(run: Run) -> Table:
    """Writes the report files of a run and returns its table."""
    meta, rows = run.metadata, run.rows(references_of(run))
    table = run_report(run, rows)
    summary = {
        "schema_version": SUMMARY_VERSION,
        **{name: meta[name] for name in ("planner", "label", "privileged", "robot", "difficulty", "config_hash")},
        "provenance": {
            name: meta.get(name)
            for name in (
                "command",
                "weights",
                "weights_digest",
                "tasks",
                "trials",
                "category",
                "limit",
                "start",
                "steps",
                "stuck",
                "seed",
                "physics",
                "commit",
                "processor",
            )
        }
        | {"split": meta.get("split", "all")},
        "complete": run.complete,
        "planned": len(meta["planned"]),
        "infrastructure_errors": len(run.broken),
        "seconds": {
            "episodes": round(sum(record.wall_s for record in run.records), 3),
            "planner": round(sum(record.planner_s for record in run.records), 3),
        },
        "rows": [row.to_json() for row in rows],
    }
    write_json(run.folder / "summary.json", summary)
    write_text(run.folder / "table.md", table.to_markdown())
    write_text(run.folder / "table.csv", table.to_csv())
    write_text(run.folder / "table.tex", table.to_latex())
    return table


def newest(
    runs: Sequence[Run],
    planner: str,
    robot: str,
    difficulty: str,
    category: str = "all",
    reflection: str = "on",
    model: str | None = None,
) -> Run | None:
    """The run to show in a cell: of these settings, the one with most episodes of the category, then the newest.

    Runs with another number of steps, with feedback of one bit, over a part of the tasks (`limit`, `split`), from other start
    poses, with other rules of contingencies, with a planner or a backend set otherwise than in its file (`as_published`), or
    with a script in place of a model are left out.

    Args:
        runs: the newest first.
        planner: its name.
        robot: of the cell.
        difficulty: of the cell.
        category: of the cell.
        reflection: `on` or `off`.
        model: name of the backend's model; None takes any.
    """
    usual = defaults_of(EvalConfig)
    fitting = [
        run
        for run in runs
        if (run.metadata["planner"], run.metadata["robot"], run.metadata["difficulty"]) == (planner, robot, difficulty)
        and (run.metadata["tasks"], run.metadata["limit"], run.metadata["start"]) == ("benchmark", None, "fixed")
        and run.metadata.get("steps") == usual["steps"]
        and run.metadata["config"].get("feedback", usual["feedback"]) == usual["feedback"]
        and run.metadata["category"] in ("all", category)
        and (run.metadata.get("split", "all"), run.metadata.get("reflection", "on")) == ("all", reflection)
        and not run.machinery
        and as_published(run.metadata["config"])
        and run.metadata.get("contingencies", "default") == "default"
        and model in (None, run.backend.get("model", ""))
    ]
    rows = [(run, run.row(category)) for run in fitting]
    sized = [(run, row.episodes) for run, row in rows if row is not None]
    return max(sized, key=lambda pair: pair[1], default=(None, 0))[0]  # `runs` is newest first, and max keeps the first
