"""Reads runs back, and writes their reports: `summary.json`, `table.md`, `table.csv`."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from data.files import write_text
from data.records import EpisodeRecord, Outcome
from proprio_mllm.evaluation.ledger import read_ledger
from proprio_mllm.report.summary import CATEGORIES, SUMMARY_VERSION, Row, rows_of, write_json
from proprio_mllm.report.table import Table, run_table

__all__ = ["Run", "find_runs", "load_run", "newest", "run_notes", "run_report", "write_report"]


@dataclass(frozen=True, slots=True)
class Run:
    """A run on disk.

    Attributes:
        folder: its folder.
        metadata: `run.json`.
        records: scored episodes of the plan, in planned order.
        broken: infrastructure errors, every attempt.
    """

    folder: Path
    metadata: Mapping[str, Any]
    records: tuple[EpisodeRecord, ...]
    broken: tuple[EpisodeRecord, ...]

    @property
    def complete(self) -> bool:
        """Whether every planned episode is scored."""
        return len(self.records) == len(self.metadata["planned"])

    def rows(self) -> list[Row]:
        """One row per category that was planned, and one for all."""
        planned = {category for _, category, _, _ in self.metadata["planned"]}
        known = [category for category in CATEGORIES if category in planned]
        return rows_of(self.records, [*known, *sorted(planned - set(known))])

    def row(self, category: str) -> Row | None:
        """The row of one category, None when the run has no such task."""
        return next((row for row in self.rows() if row.category == category and row.episodes), None)


def load_run(folder: Path) -> Run:
    """Reads a run's folder.

    Raises:
        ValueError: when it holds no run, or one of an unknown version.
    """
    path = folder / "run.json"
    if not path.is_file():
        raise ValueError(f"{folder}: no run here (run.json is missing)")
    metadata = json.loads(path.read_text(encoding="utf-8"))
    if metadata.get("version") != 1:
        raise ValueError(f"{path}: run version {metadata.get('version')!r} is unknown; this code reads 1")
    wanted = [(task, trial, own) for task, _, trial, own in metadata["planned"]]
    scores: dict[tuple[str, int, str], EpisodeRecord] = {}
    broken: list[EpisodeRecord] = []
    for record in read_ledger(folder / "ledger.jsonl"):
        if record.outcome is Outcome.INFRASTRUCTURE_ERROR:
            broken.append(record)
        else:
            scores.setdefault((record.task, record.trial, record.config_hash), record)
    return Run(folder, metadata, tuple(scores[key] for key in wanted if key in scores), tuple(broken))


def find_runs(output: Path) -> list[Run]:
    """All runs below `output/eval`, the newest first."""
    paths = sorted(
        (output / "eval").glob("*/run.json"), key=lambda path: (path.stat().st_mtime, path.parent.name), reverse=True
    )
    return [load_run(path.parent) for path in paths]


def run_notes(run: Run) -> list[str]:
    """What to know about a run besides its figures: episodes without a score, broken attempts, a privileged planner."""
    notes = []
    missing = len(run.metadata["planned"]) - len(run.records)
    if missing:
        notes.append(f"{missing} of {len(run.metadata['planned'])} episodes have no score; run the same command again.")
    if run.broken:
        notes.append(f"{len(run.broken)} attempts broke for reasons outside the planner; they are not scored.")
    if run.metadata["privileged"]:
        notes.append("Privileged: this planner looks into the simulator's state.")
    return notes


def run_report(run: Run) -> Table:
    """The table of a run."""
    meta = run.metadata
    return run_table(f"{meta['label']} · {meta['robot']} · {meta['difficulty']}", run.rows(), run_notes(run))


def write_report(run: Run) -> Table:
    """Writes the report files of a run and returns its table."""
    meta, rows, table = run.metadata, run.rows(), run_report(run)
    summary = {
        "schema_version": SUMMARY_VERSION,
        **{name: meta[name] for name in ("planner", "label", "privileged", "robot", "difficulty", "config_hash")},
        "provenance": {
            name: meta[name]
            for name in ("command", "weights", "weights_digest", "tasks", "trials", "category", "limit", "start", "seed")
        },
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
    return table


def newest(runs: Sequence[Run], planner: str, robot: str, difficulty: str, category: str = "all") -> Run | None:
    """The run to show in a cell: of these settings, the one with most episodes of the category, then the newest.

    Runs over a part of the tasks (`limit`) or from other start poses are left out.
    """
    fitting = [
        run
        for run in runs
        if (run.metadata["planner"], run.metadata["robot"], run.metadata["difficulty"]) == (planner, robot, difficulty)
        and (run.metadata["tasks"], run.metadata["limit"], run.metadata["start"]) == ("benchmark", None, "fixed")
        and run.metadata["category"] in ("all", category)
    ]
    rows = [(run, run.row(category)) for run in fitting]
    sized = [(run, row.episodes) for run, row in rows if row is not None]
    return max(sized, key=lambda pair: pair[1], default=(None, 0))[0]  # `runs` is newest first, and max keeps the first
