"""Intervals against closed forms and scipy."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import stats

from proprio_mllm.report.statistics import cluster_bootstrap, compare, rate_interval, trained_interval, wilson


@pytest.mark.parametrize(("k", "n"), [(0, 12), (1, 12), (7, 12), (12, 12), (84, 133), (1, 1), (60, 60)])
@pytest.mark.parametrize("confidence", [0.9, 0.95])
def test_wilson_equals_scipy(k: int, n: int, confidence: float) -> None:
    expected = stats.binomtest(k, n).proportion_ci(confidence, method="wilson")
    assert wilson(k, n, confidence) == pytest.approx((expected.low, expected.high), abs=1e-12)


def test_wilson_of_the_papers_cell() -> None:
    assert [round(100 * limit, 1) for limit in wilson(84, 133)] == [54.7, 70.9]


@pytest.mark.parametrize(("k", "n", "confidence"), [(1, 0, 0.95), (-1, 3, 0.95), (4, 3, 0.95), (1, 3, 1.0)])
def test_wilson_refuses(k: int, n: int, confidence: float) -> None:
    with pytest.raises(ValueError, match=str(confidence) if confidence == 1.0 else f"{k} of {n}"):
        wilson(k, n, confidence)


def test_agreeing_trials_count_once() -> None:
    many = {f"t{i}": [i < 3] * 50 for i in range(10)}
    interval = rate_interval(many)
    assert interval.method == "wilson"
    assert (interval.low, interval.high) == wilson(3, 10)
    assert interval.rate == pytest.approx(0.3)


def test_disagreeing_trials_bootstrap_over_tasks() -> None:
    rng = np.random.default_rng(0)
    rates = rng.uniform(size=40)
    tasks = {f"t{i:02d}": list(rng.random(50) < rate) for i, rate in enumerate(rates)}
    interval = rate_interval(tasks)
    means = np.array([np.mean(values) for values in tasks.values()])
    # With clusters of one size the bootstrap's spread is the standard error of the cluster means.
    half = 1.96 * means.std() / math.sqrt(len(means))
    assert interval.method == "bootstrap"
    assert interval.rate == pytest.approx(means.mean())
    assert (interval.high - interval.low) / 2 == pytest.approx(half, rel=0.08)
    assert rate_interval(tasks) == interval


def test_one_missing_trial_does_not_make_an_interval_a_point() -> None:
    by_task = {f"t{i}": [False] * 3 for i in range(36)} | {"t0": [False] * 2}
    interval = rate_interval(by_task)
    assert (interval.rate, interval.low) == (0.0, 0.0)
    assert interval.high == pytest.approx(wilson(0, 36)[1])


def test_no_episode_is_no_number() -> None:
    interval = rate_interval({})
    assert interval.method == "none"
    assert math.isnan(interval.rate)


def test_bootstrap_of_constant_clusters_is_a_point() -> None:
    assert cluster_bootstrap([[1.0], [1.0, 1.0]], np.random.default_rng(0)) == (1.0, 1.0)
    with pytest.raises(ValueError, match=r"\[1, 0\]"):
        cluster_bootstrap([[1.0], []], np.random.default_rng(0))


def test_tasks_that_either_side_wins_make_the_p_value() -> None:
    a = {f"t{i:02d}": [i < 9] for i in range(14)}
    b = {f"t{i:02d}": [9 <= i < 11] for i in range(14)}
    result = compare(a, b)
    assert (len(result.above), len(result.below)) == (9, 2)
    assert result.p_value == pytest.approx(2 * (1 + 11 + 55) / 2**11)  # at most two of eleven coins on one side
    assert (result.first, result.second) == pytest.approx((9 / 14, 2 / 14))
    assert result.low < result.difference < result.high


def test_paired_comparison() -> None:
    a = {f"t{i}": [i < 9] for i in range(12)}
    b = {f"t{i}": [i < 2] for i in range(12)} | {"other": [True]}
    result = compare(a, b)
    assert result.tasks == 12
    assert result.difference == pytest.approx(7 / 12)
    assert result.p_value == pytest.approx(2 * 0.5**7)
    assert 0 < result.low < result.difference < result.high <= 1
    assert (result.above, result.below) == (tuple(f"t{i}" for i in range(2, 9)), ())
    assert compare(a, a).p_value == 1.0
    with pytest.raises(ValueError, match="no common task"):
        compare(a, {"x": [True]})


def shares(*trainings: list[float]) -> np.ndarray:
    """(S, T, 2) of trainings that succeed on these tasks, with one chance each."""
    return np.stack([np.stack([np.asarray(one), np.ones(len(one))], axis=1) for one in trainings])


def test_the_luck_of_trainings_is_in_their_interval() -> None:
    tasks = 20
    lucky, never = [1.0] * tasks, [0.0] * tasks
    assert trained_interval(shares(lucky, never), shares(never, never)) == (0.5, 0.0, 1.0)
    assert trained_interval(shares(lucky, lucky), shares(never)) == (1.0, 1.0, 1.0)


def test_tasks_are_drawn_for_both_sides_together() -> None:
    hard = [float(i % 2) for i in range(40)]  # what differs between tasks cancels, what differs between sides does not
    assert trained_interval(shares(hard), shares(hard)) == (0.0, 0.0, 0.0)
    better = [1.0, *hard[1:]]
    difference, low, high = trained_interval(shares(better), shares(hard))
    expected = compare(*({str(i): [one] for i, one in enumerate(side)} for side in (better, hard)))
    assert difference == pytest.approx(1 / 40)
    assert (low, high) == pytest.approx((expected.low, expected.high), abs=0.02)


def test_a_task_counts_by_its_chances() -> None:
    many = np.array([[[9.0, 10.0], [0.0, 1.0]]])
    none = np.array([[[0.0, 10.0], [0.0, 1.0]]])
    assert trained_interval(many, none)[0] == pytest.approx(9 / 11)
    assert np.isnan(trained_interval(many * 0, none)).all()


@pytest.mark.parametrize("second", [np.zeros((2, 3, 2)), np.zeros((0, 4, 2)), np.zeros((4, 2))])
def test_other_tasks_have_no_interval(second: np.ndarray) -> None:
    with pytest.raises(ValueError, match="of the same tasks, got"):
        trained_interval(np.ones((2, 4, 2)), second)
