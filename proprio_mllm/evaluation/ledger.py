"""The ledger: one JSON line per finished episode, appended and flushed to disk at once.

A run that is killed at any moment loses at most the episodes that were under way. A line that was cut short is dropped on
opening. Episodes are known by their key, so a second run does only what is missing. Infrastructure errors are kept as lines,
but they do not count as done: they are run again.
"""

from __future__ import annotations

import dataclasses
import fcntl
import json
import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, Final, Self

from configs.validate import ConfigError, build
from data.files import parse_json
from interface.episode import EpisodeRecord, Outcome

LEDGER_VERSION: Final = 3
#: Fields that lines of older versions lack; the record's own defaults stand in.
_SINCE_3: Final = frozenset({"in_time", "stuck"})
_LACKING: Final = {
    1: _SINCE_3 | frozenset(("cached_calls", "reflections", "planner_usd", "models")),
    2: _SINCE_3,
    LEDGER_VERSION: frozenset(),
}

#: Fields that are never below 0.
_COUNTED: Final = (
    "trial", "invalid_output", "steps", "makespan_s", "path_length_m", "arm_utilisation", "planner_calls", "planner_tokens",
    "planner_s", "wall_s", "cached_calls", "reflections",
)  # fmt: skip

#: (planner, robot, task, difficulty, trial, seed, config hash)
EpisodeKey = tuple[str, str, str, str, int, int, str]


class LedgerError(ValueError):
    """A ledger line that cannot be read; the message names file and line."""


def key_of(record: EpisodeRecord) -> EpisodeKey:
    """What makes an episode the same one."""
    return (
        record.planner,
        record.robot,
        record.task,
        record.difficulty,
        record.trial,
        record.seed,
        record.config_hash,
    )


def to_json(record: EpisodeRecord) -> dict[str, Any]:
    """Plain form of a record, with the ledger's version."""
    return {"version": LEDGER_VERSION, **dataclasses.asdict(record)}


def from_json(raw: Mapping[str, Any]) -> EpisodeRecord:
    """Reads `to_json` back, and lines of versions 1 and 2.

    Raises:
        LedgerError: on another version, missing or unknown fields, or a value of another type or that no episode has.
    """
    values = dict(raw)
    version = values.pop("version", None)
    if version not in _LACKING:
        raise LedgerError(f"ledger version {version!r} is unknown; this code reads {', '.join(map(str, _LACKING))}")
    names = {f.name for f in dataclasses.fields(EpisodeRecord)} - _LACKING[version]
    if set(values) != names:
        raise LedgerError(f"missing fields {sorted(names - set(values))}, unknown fields {sorted(set(values) - names)}")
    try:
        record = build(EpisodeRecord, values)
    except ConfigError as error:
        raise LedgerError(str(error)) from error
    if not 0.0 <= record.goal_conditions_met <= 1.0:
        raise LedgerError(f"goal_conditions_met {record.goal_conditions_met} outside [0, 1]")
    below = [name for name in _COUNTED if getattr(record, name) < 0]
    if below:
        raise LedgerError(f"{below[0]} {getattr(record, below[0])} is below 0")
    broke = record.outcome is Outcome.INFRASTRUCTURE_ERROR
    if not broke and (record.failure is None) != (record.outcome is Outcome.SUCCESS):
        raise LedgerError(f"outcome {record.outcome.value!r} with failure {record.failure!r}")
    return record


def read_ledger(path: Path) -> list[EpisodeRecord]:
    """Records of a ledger in the order they were written; a last line without an end is left out.

    Raises:
        LedgerError: on a line that is complete but not a record.
    """
    if not path.is_file():
        return []
    records: list[EpisodeRecord] = []
    lines = path.read_bytes().split(b"\n")[:-1]  # what follows the last line end was cut short
    for number, line in enumerate(lines, start=1):
        try:
            records.append(from_json(parse_json(line)))
        except (ValueError, TypeError, AttributeError) as error:
            raise LedgerError(f"{path}, line {number}: {error}") from error
    return records


def scored(records: Iterable[EpisodeRecord]) -> dict[EpisodeKey, EpisodeRecord]:
    """The episodes that count, by key: the first score of a key stands, infrastructure errors never do."""
    found: dict[EpisodeKey, EpisodeRecord] = {}
    for record in records:
        if record.outcome is not Outcome.INFRASTRUCTURE_ERROR:
            found.setdefault(key_of(record), record)
    return found


class Ledger:
    """Appends to a ledger file; one process writes, and the system gives its lock back when it ends.

    Args:
        path: made with its folder when absent; a line that was cut short is removed.

    Raises:
        LedgerError: when another process writes it.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        path.parent.mkdir(parents=True, exist_ok=True)
        self._handle = path.open("ab")
        try:
            fcntl.flock(self._handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            self._handle.close()
            raise LedgerError(f"{path} is being written by another process: the same command is running already") from None
        content = path.read_bytes()
        whole = content.rfind(b"\n") + 1
        if whole != len(content):
            self._handle.truncate(whole)

    def append(self, record: EpisodeRecord) -> None:
        """Writes one record and waits until it is on the disk; halves of characters, which UTF-8 has not, become `?`."""
        line = json.dumps(to_json(record), ensure_ascii=False, separators=(",", ":"), allow_nan=False)
        self._handle.write(line.encode(errors="replace") + b"\n")
        self._handle.flush()
        os.fsync(self._handle.fileno())

    def close(self) -> None:
        """Closes the file."""
        self._handle.close()

    def __enter__(self) -> Self:
        """The ledger itself."""
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        """Closes the file."""
        self.close()
