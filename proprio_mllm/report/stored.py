"""Reads runs back from their folders."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal

from pydantic import BaseModel, ConfigDict, ValidationError

from interface.episode import EpisodeRecord, Outcome
from proprio_mllm.evaluation.ledger import read_ledger
from proprio_mllm.evaluation.naming import options_of
from proprio_mllm.report.metrics import References
from proprio_mllm.report.summary import CATEGORIES, Row, rows_of

#: Faults of a file that a message names.
_TOLD: Final = 5


class _Config(BaseModel):
    """Of the run's configuration, what reports look into."""

    model_config = ConfigDict(extra="allow")

    planner: dict[str, Any] = {}
    robot: dict[str, Any] = {}
    backend: dict[str, Any] | None = None
    tasks: str = "benchmark"
    contingencies: str = "default"


class _Metadata(BaseModel):
    """What every report reads of `run.json`."""

    model_config = ConfigDict(extra="allow")

    planner: str
    label: str
    privileged: bool
    robot: str
    difficulty: str
    config_hash: str
    command: str
    weights: str | None
    weights_digest: str
    tasks: str
    trials: int
    category: str
    limit: int | None
    start: str
    seed: int
    steps: int | Literal["task"] = "task"
    stuck: int = 0
    planned: list[tuple[str, str, int, str]]
    config: _Config
    backend: dict[str, Any] | None = None


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

    @property
    def robot_config(self) -> Mapping[str, Any]:
        """The robot's configuration; empty for a run without one."""
        return self.metadata["config"].get("robot", {})

    @property
    def backend(self) -> Mapping[str, Any]:
        """The backend's configuration; empty for a run without one."""
        return self.metadata.get("backend") or {}

    @property
    def title(self) -> str:
        """Planner, robot, difficulty, and what it did otherwise than the plain command."""
        meta = self.metadata
        return " · ".join([meta["label"], meta["robot"], meta["difficulty"], *self.options])

    @property
    def options(self) -> tuple[str, ...]:
        """What it did otherwise than the plain command."""
        return tuple(option.replace("_", " ") for option in options_of(self.metadata["config"]))

    @property
    def machinery(self) -> bool:
        """Whether a script stood in for a model: a test of the machinery, which no table of results shows."""
        return self.backend.get("kind") == "scripted"

    @property
    def model(self) -> str:
        """What answered: the exact models as they named themselves, else the backend's revision, else the weights."""
        named = dict.fromkeys(model for record in self.records for model in record.models)
        asked = self.backend.get("revision") or self.backend.get("model", "")
        digest = self.metadata["weights_digest"]
        return ", ".join(named) or asked or (f"weights {digest[:8]}" if digest and self.metadata["weights"] else "")

    def contents(self) -> dict[str, str]:
        """Hash of each planned task's content, by task id."""
        return {task: own.rpartition("-")[2] for task, _, _, own in self.metadata["planned"]}

    def rows(self, references: References | None = None) -> list[Row]:
        """One row per category that was planned, and one for all.

        Args:
            references: what path lengths, steps and contingencies are measured against; nothing by default.
        """
        planned = {category for _, category, _, _ in self.metadata["planned"]}
        known = [category for category in CATEGORIES if category in planned]
        return rows_of(self.records, [*known, *sorted(planned - set(known))], references)

    def row(self, category: str) -> Row | None:
        """The row of one category, None when the run has no such task."""
        return next((row for row in self.rows() if row.category == category and row.episodes), None)

    def planned(self, category: str) -> int:
        """Episodes of one category that were planned."""
        return sum(category in ("all", one) for _, one, _, _ in self.metadata["planned"])


def read_metadata(folder: Path) -> dict[str, Any]:
    """Contents of a run's `run.json`.

    Raises:
        ValueError: when the folder holds no run, one of an unknown version, or one that is damaged; the message names the file.
    """
    path = folder / "run.json"
    if not path.is_file():
        raise ValueError(f"{folder}: no run here (run.json is missing)")
    try:
        metadata = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise ValueError(f"{path}: not JSON ({error})") from error
    version = metadata.get("version") if isinstance(metadata, dict) else None
    if version != 1:
        raise ValueError(f"{path}: run version {version!r} is unknown; this code reads 1")
    try:
        _Metadata.model_validate(metadata)
    except ValidationError as error:
        told = (f"{'.'.join(map(str, one['loc']))}: {one['msg']}" for one in error.errors()[:_TOLD])
        raise ValueError(f"{path}: damaged: {'; '.join(told)}") from error
    return metadata


def load_run(folder: Path) -> Run:
    """Reads a run's folder.

    Raises:
        ValueError: when it holds no run, or one of an unknown version.
    """
    metadata = read_metadata(folder)
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
