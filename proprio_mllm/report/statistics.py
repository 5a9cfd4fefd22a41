"""Intervals for success rates when tasks are the sample.

Trials of one task are correlated: in the paper's tables almost every rate is a multiple of one task, so the effective sample
size is the number of tasks. Where all trials of each task agree (always so with one trial), the interval is Wilson's over
tasks; otherwise a cluster bootstrap draws whole tasks. Planners are compared in pairs on the same tasks and contingencies.

Paper: prints no intervals.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import stats

_DRAWS = 4000


@dataclass(frozen=True, slots=True)
class Interval:
    """A rate with its interval, all in [0, 1], and how it was made (`wilson`, `bootstrap`, `none`)."""

    rate: float
    low: float
    high: float
    method: str


def wilson(successes: int, n: int, confidence: float = 0.95) -> tuple[float, float]:
    """Wilson's score interval of a proportion.

    Raises:
        ValueError: when not 0 <= successes <= n with n > 0, or the confidence is outside (0, 1).
    """
    if n <= 0 or not 0 <= successes <= n:
        raise ValueError(f"expected 0 <= successes <= n and n > 0, got {successes} of {n}")
    if not 0.0 < confidence < 1.0:
        raise ValueError(f"confidence {confidence} outside (0, 1)")
    interval = stats.binomtest(successes, n).proportion_ci(confidence, method="wilson")
    return float(interval.low), float(interval.high)


def cluster_bootstrap(
    clusters: Sequence[Sequence[float]], rng: np.random.Generator, confidence: float = 0.95, draws: int = _DRAWS
) -> tuple[float, float]:
    """Percentile interval of the mean over all values when whole clusters are drawn with replacement.

    Args:
        clusters: values of each task.
        rng: draws the resamples.
        confidence: in (0, 1).
        draws: number of resamples.

    Raises:
        ValueError: without clusters, or with an empty one.
    """
    if not clusters or any(len(cluster) == 0 for cluster in clusters):
        raise ValueError(f"expected clusters with values, got {[len(cluster) for cluster in clusters]}")
    sums = np.array([float(np.sum(cluster)) for cluster in clusters])
    counts = np.array([len(cluster) for cluster in clusters], dtype=float)
    picked = rng.integers(len(clusters), size=(draws, len(clusters)))
    means = sums[picked].sum(axis=1) / counts[picked].sum(axis=1)
    tail = (1 - confidence) / 2
    low, high = np.quantile(means, [tail, 1 - tail])
    return float(low), float(high)


def rate_interval(by_task: Mapping[str, Sequence[bool]], confidence: float = 0.95) -> Interval:
    """Success rate over episodes with an interval over tasks.

    Args:
        by_task: successes of the trials of each task.
        confidence: in (0, 1).
    """
    clusters = [[float(value) for value in by_task[task]] for task in sorted(by_task) if by_task[task]]
    if not clusters:
        return Interval(float("nan"), float("nan"), float("nan"), "none")
    values = [value for cluster in clusters for value in cluster]
    rate = float(np.mean(values))
    if all(len(set(cluster)) == 1 for cluster in clusters):
        low, high = wilson(sum(int(cluster[0]) for cluster in clusters), len(clusters), confidence)
        return Interval(rate, min(low, rate), max(high, rate), "wilson")  # with unequal sizes the two need not agree
    low, high = cluster_bootstrap(clusters, np.random.default_rng(0), confidence)
    return Interval(rate, low, high, "bootstrap")


@dataclass(frozen=True, slots=True)
class Comparison:
    """Two sides of the same tasks.

    Attributes:
        tasks: number of common tasks.
        first: mean of the first side, over tasks.
        second: mean of the second side, over tasks.
        difference: first minus second.
        low: lower limit of the difference's interval.
        high: upper limit.
        p_value: exact sign test (McNemar's with one trial and yes-or-no values) on the tasks where they differ.
        above: tasks on which the first side is higher.
        below: tasks on which it is lower.
    """

    tasks: int
    first: float
    second: float
    difference: float
    low: float
    high: float
    p_value: float
    above: tuple[str, ...]
    below: tuple[str, ...]


def compare(a: Mapping[str, Sequence[float]], b: Mapping[str, Sequence[float]], confidence: float = 0.95) -> Comparison:
    """Compares two sides task by task; the values of a task's trials are averaged first.

    Args:
        a: values of the trials of each task, first side.
        b: the same, second side; tasks of one side only are left out.
        confidence: in (0, 1).

    Raises:
        ValueError: when they share no task.
    """
    common = sorted(task for task in a if a[task] and b.get(task))
    if not common:
        raise ValueError(f"no common task among {len(a)} and {len(b)}")
    means = {task: (float(np.mean(a[task])), float(np.mean(b[task]))) for task in common}
    deltas = [first - second for first, second in means.values()]
    above = tuple(task for task, (first, second) in means.items() if first > second)
    below = tuple(task for task, (first, second) in means.items() if first < second)
    differing = len(above) + len(below)
    p_value = float(stats.binomtest(len(above), differing).pvalue) if differing else 1.0
    low, high = cluster_bootstrap([[d] for d in deltas], np.random.default_rng(0), confidence)
    first, second = (float(np.mean([pair[side] for pair in means.values()])) for side in (0, 1))
    return Comparison(len(common), first, second, float(np.mean(deltas)), low, high, p_value, above, below)


def trained_interval(
    first: NDArray[np.floating], second: NDArray[np.floating], confidence: float = 0.95, draws: int = _DRAWS
) -> tuple[float, float, float]:
    """The difference of two ways to train, and its percentile interval when trainings and tasks are drawn with replacement.

    Trainings are drawn for each side, tasks for both sides together. A training's share is its sum of counts over its sum of
    chances; a side's is the mean of its trainings' shares.

    Args:
        first: (S, T, 2) counts and chances of every training and task.
        second: (R, T, 2) likewise, of the same tasks.
        confidence: in (0, 1).
        draws: number of resamples.

    Returns:
        Difference (first minus second), lower and upper limit; NaN where a side has no chance at all.

    Raises:
        ValueError: when the sides are not of the same tasks, or one is empty.
    """
    sides = (first, second)
    if any(side.ndim != 3 or side.shape[2] != 2 or not side.size for side in sides) or first.shape[1] != second.shape[1]:
        raise ValueError(f"expected (trainings, tasks, 2) of the same tasks, got {first.shape} and {second.shape}")
    rng = np.random.default_rng(0)
    tasks = rng.multinomial(first.shape[1], [1 / first.shape[1]] * first.shape[1], draws)

    def shares(side: NDArray[np.floating], times: NDArray[np.integer]) -> NDArray[np.floating]:
        with np.errstate(invalid="ignore"):
            return np.divide(*np.moveaxis(np.einsum("nt,stc->nsc", times, side), 2, 0))

    drawn = []
    for side in sides:
        picked = rng.integers(len(side), size=(draws, len(side)))
        drawn.append(np.take_along_axis(shares(side, tasks), picked, axis=1).mean(axis=1))
    whole = [shares(side, np.ones((1, side.shape[1]), dtype=np.int64)).mean() for side in sides]
    tail = (1 - confidence) / 2
    low, high = np.nanquantile(drawn[0] - drawn[1], [tail, 1 - tail]) if np.isfinite(whole).all() else (np.nan, np.nan)
    return float(whole[0] - whole[1]), float(low), float(high)
