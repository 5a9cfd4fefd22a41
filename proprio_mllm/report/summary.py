"""From a ledger to the figures of a run: `summary.json`.

Keys of `summary.json`: `schema_version`; `planner`, `label`, `privileged`, `robot`, `difficulty`, `config_hash`, `provenance`
(command, weights, seed …); `complete` (every planned episode is scored); `planned`; `infrastructure_errors` (attempts that
broke, not scored); `seconds` (sum of `wall_s` over episodes, `planner` part); and `rows`, one per category and one for `all`:

| key | meaning |
|---|---|
| `category` | single, optional, essential, all |
| `tasks`, `episodes`, `successes` | counts |
| `success_rate`, `low`, `high`, `interval` | in [0, 1]; 95 % limits over tasks; `wilson`, `bootstrap` or `none` |
| `in_time`, `in_time_rate`, `in_time_low`, `in_time_high` | successes within the task's time limit, likewise |
| `navigation`, `body_adjustment`, `logical` | failed episodes by type; they add up to the failures |
| `budget_exhausted`, `stuck` | failed episodes that used up their steps; that only repeated themselves and were ended |
| `invalid_output` | replies outside the grammar; `invalid_rate` is per call |
| `goal_conditions` | mean share of goals met |
| `steps`, `makespan_s`, `path_length_m`, `arm_utilisation` | means per episode |
| `calls`, `tokens`, `planner_s` | means per episode |
| `reflections`, `usd` | means per episode; `usd` is null where a price is not known |
| those of `metrics.Extras` | against the expert's certificates, at `easy`, and beside the expert |

A figure without an episode is null.
"""

from __future__ import annotations

import dataclasses
import json
import math
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from data.files import write_text
from interface.episode import EpisodeRecord, Outcome
from interface.failures import FailureCategory
from proprio_mllm.report.metrics import Extras, References, extras_of
from proprio_mllm.report.statistics import rate_interval

SUMMARY_VERSION: Final = 2
#: Order of rows in every table.
CATEGORIES: Final = ("single", "optional", "essential")


@dataclass(frozen=True, slots=True)
class Row:
    """Figures of one category; see the module for the keys."""

    category: str
    tasks: int
    episodes: int
    successes: int
    success_rate: float
    low: float
    high: float
    interval: str
    in_time: int
    in_time_rate: float
    in_time_low: float
    in_time_high: float
    navigation: int
    body_adjustment: int
    logical: int
    budget_exhausted: int
    stuck: int
    invalid_output: int
    invalid_rate: float
    goal_conditions: float
    steps: float
    makespan_s: float
    path_length_m: float
    arm_utilisation: float
    calls: float
    tokens: float
    planner_s: float
    reflections: float
    usd: float
    extras: Extras

    def to_json(self) -> dict[str, Any]:
        """Plain form; figures without an episode are None."""
        values = dataclasses.asdict(self)
        return _plain(values | values.pop("extras"))


def _plain(values: Mapping[str, Any]) -> dict[str, Any]:
    return {
        name: (None if math.isnan(value) else round(value, 6)) if isinstance(value, float) else value
        for name, value in values.items()
    }


def by_task(
    records: Iterable[EpisodeRecord], of: Callable[[EpisodeRecord], bool] = lambda record: record.outcome is Outcome.SUCCESS
) -> dict[str, list[bool]]:
    """Successes, or whatever is asked for, per task, trials in order; infrastructure errors are left out."""
    found: dict[str, list[bool]] = defaultdict(list)
    for record in sorted(records, key=lambda r: (r.task, r.trial)):
        if record.outcome is not Outcome.INFRASTRUCTURE_ERROR:
            found[record.task].append(of(record))
    return dict(found)


def _row(category: str, records: Sequence[EpisodeRecord], references: References) -> Row:
    def mean(of: Callable[[EpisodeRecord], float]) -> float:
        return float(np.mean([of(record) for record in records])) if records else float("nan")

    def failures(kind: FailureCategory) -> int:
        return sum(record.failure is kind for record in records)

    tasks = by_task(records)
    interval, in_time = rate_interval(tasks), rate_interval(by_task(records, lambda record: record.in_time))
    calls = sum(record.planner_calls for record in records)
    invalid = sum(record.invalid_output for record in records)
    return Row(
        category=category,
        tasks=len(tasks),
        episodes=len(records),
        successes=sum(record.outcome is Outcome.SUCCESS for record in records),
        success_rate=interval.rate,
        low=interval.low,
        high=interval.high,
        interval=interval.method,
        in_time=sum(record.in_time for record in records),
        in_time_rate=in_time.rate,
        in_time_low=in_time.low,
        in_time_high=in_time.high,
        navigation=failures(FailureCategory.NAVIGATION),
        body_adjustment=failures(FailureCategory.BODY_ADJUSTMENT),
        logical=failures(FailureCategory.LOGICAL),
        budget_exhausted=sum(record.budget_exhausted for record in records),
        stuck=sum(record.stuck for record in records),
        invalid_output=invalid,
        invalid_rate=invalid / calls if calls else float("nan"),
        goal_conditions=mean(lambda r: r.goal_conditions_met),
        steps=mean(lambda r: r.steps),
        makespan_s=mean(lambda r: r.makespan_s),
        path_length_m=mean(lambda r: r.path_length_m),
        arm_utilisation=mean(lambda r: r.arm_utilisation),
        calls=mean(lambda r: r.planner_calls),
        tokens=mean(lambda r: r.planner_tokens),
        planner_s=mean(lambda r: r.planner_s),
        reflections=mean(lambda r: r.reflections),
        usd=mean(lambda r: float("nan") if r.planner_usd is None else r.planner_usd),
        extras=extras_of(records, references),
    )


def rows_of(
    records: Iterable[EpisodeRecord], categories: Sequence[str] = CATEGORIES, references: References | None = None
) -> list[Row]:
    """One row per category and one for all; infrastructure errors are not scored.

    Args:
        records: of one run.
        categories: rows before the last.
        references: what path lengths, steps and contingencies are measured against; nothing by default.
    """
    known = references or References()
    valid = [record for record in records if record.outcome is not Outcome.INFRASTRUCTURE_ERROR]
    rows = [_row(category, [record for record in valid if record.category == category], known) for category in categories]
    return [*rows, _row("all", valid, known)]


def write_json(path: Path, values: Mapping[str, Any]) -> None:
    """Writes JSON atomically."""
    write_text(path, json.dumps(values, indent=2, ensure_ascii=False, allow_nan=False) + "\n")
