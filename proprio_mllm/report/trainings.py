"""Two ways to train side by side, each by the runs of several trainings: what a part of a model brings.

One training with a part and one without differ by their luck as well. The interval here is over both: trainings of each side
and tasks of both sides together are drawn with replacement (`statistics.trained_interval`).

Paper: one training of each ablation, no interval.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from interface.episode import EpisodeRecord, Outcome
from interface.failures import FailureCategory
from proprio_mllm.report.comparison import in_order, other_draws, require_comparable
from proprio_mllm.report.metrics import first_tries
from proprio_mllm.report.statistics import trained_interval
from proprio_mllm.report.stored import Run
from proprio_mllm.report.table import Table

#: Counts of an episode, and how many there could have been.
_Counts = Callable[[EpisodeRecord], tuple[float, float]]


def _failed(kind: FailureCategory) -> _Counts:
    return lambda record: (float(record.failure is kind), 1.0)


def _first_tries(record: EpisodeRecord) -> tuple[float, float]:
    tries = first_tries(record.trace)
    return float(tries.count("reached")), float(len(tries))


_SHARES: Final[Mapping[str, _Counts]] = {
    "success": lambda record: (float(record.outcome is Outcome.SUCCESS), 1.0),
    "in time": lambda record: (float(record.in_time), 1.0),
    "first tries in reach": _first_tries,
    **{f"failed by {kind.replace('_', ' ')}": _failed(kind) for kind in FailureCategory},
}


def compare_trainings(firsts: Sequence[Run], seconds: Sequence[Run]) -> Table:
    """One line per category and figure, the first side minus the second, on the tasks that every run has scored.

    Args:
        firsts: runs of trainings of one kind, on one body, with the same luck.
        seconds: runs of trainings of the other kind.

    Raises:
        ValueError: when the runs did not meet the same tasks and contingencies, two runs of a side are of the same weights, or
            no task is common.
    """
    first, every = firsts[0], [*firsts, *seconds]
    for side in (firsts, seconds):
        found: dict[str, Run] = {}
        for run in side:
            other = found.setdefault(run.metadata["weights_digest"], run)
            if other is not run:
                raise ValueError(f"{other.folder} and {run.folder} are of the same weights, which is one training")
    for run in every[1:]:
        require_comparable(first, run, other_draws(first, run))
    tasks = sorted(set.intersection(*({record.task for record in run.records} for run in every)))
    if not tasks:
        raise ValueError(f"{', '.join(str(run.folder) for run in every)} have no scored task in common")
    category = {record.task: record.category for record in first.records}
    labels = [str(side[0].metadata["label"]) for side in (firsts, seconds)]
    counts = {
        figure: [np.stack([_by_task(run, tasks, of) for run in side]) for side in (firsts, seconds)]
        for figure, of in _SHARES.items()
    }
    body: list[tuple[str, ...]] = []
    for name in (*in_order({category[task] for task in tasks}), "all"):
        chosen = [number for number, task in enumerate(tasks) if name in ("all", category[task])]
        for figure, sides in counts.items():
            body.append((name, figure, str(len(chosen)), *_cells(*(side[:, chosen] for side in sides))))
    columns = ("category", "share", "tasks", *(f"{label} %" for label in labels), "difference", "95 % interval")
    notes = (
        f"{len(firsts)} and {len(seconds)} trainings, in the order of their runs; difference: mean of the first minus mean of "
        "the second; interval: bootstrap over trainings and tasks.",
        *(
            f"{label}: {', '.join(run.folder.name for run in side)}."
            for label, side in zip(labels, (firsts, seconds), strict=True)
        ),
    )
    return Table(f"{labels[0]} against {labels[1]} ({first.metadata['robot']})", columns, tuple(body), notes)


def _by_task(run: Run, tasks: Sequence[str], of: _Counts) -> NDArray[np.float64]:
    """(T, 2) counts of every task and how many there could have been, over its trials."""
    found = {task: np.zeros(2) for task in tasks}
    for record in run.records:
        if record.task in found:
            found[record.task] += of(record)
    return np.stack([found[task] for task in tasks])


def _cells(first: NDArray[np.float64], second: NDArray[np.float64]) -> tuple[str, ...]:
    """The share in every training of both sides, the difference and its interval; empty where nothing could be counted."""
    shares = [
        " ".join(f"{100 * count / out_of:.1f}" if out_of else "-" for count, out_of in side.sum(axis=1))
        for side in (first, second)
    ]
    difference, low, high = (100 * value for value in trained_interval(first, second))
    return (*shares, *(("", "") if np.isnan(difference) else (f"{difference:+.1f}", f"[{low:+.1f}, {high:+.1f}]")))
