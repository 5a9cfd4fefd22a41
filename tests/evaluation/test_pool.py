"""Workers: results, retries, and processes that die."""

from __future__ import annotations

import functools
import operator
import os
from concurrent.futures import Future
from concurrent.futures.process import BrokenProcessPool
from typing import Any

import pytest

from proprio_mllm.evaluation import pool
from proprio_mllm.evaluation.pool import run_jobs

ADD = functools.partial(functools.partial, operator.add, 1)
REFUSED: Any = functools.partial(int, "no number")
EXIT = functools.partial(functools.partial, os._exit)


def test_in_process() -> None:
    assert list(run_jobs(lambda: ADD(), [1, 2, 3], 0, lambda r: False, lambda job, why: -1)) == [2, 3, 4]


def test_failed_results_are_given_out_and_tried_again() -> None:
    results = list(run_jobs(lambda: ADD(), [1, 2], 0, lambda r: r == 2, lambda job, why: -1, retries=2))
    assert results == [2, 3, 2, 2]


def test_processes() -> None:
    results = run_jobs(ADD, list(range(7)), 2, lambda r: False, lambda job, why: -1)
    assert sorted(results) == [1, 2, 3, 4, 5, 6, 7]


def test_a_job_that_meets_a_broken_pool_is_not_lost(monkeypatch: pytest.MonkeyPatch) -> None:
    pools = 0

    class Pool:
        """Breaks at the second job of the first pool, as when a worker has died while a result was being handled."""

        def __init__(self, *_: object) -> None:
            nonlocal pools
            pools += 1
            self.jobs = 0

        def submit(self, do: object, job: int) -> Future[int]:
            self.jobs += 1
            if pools == 1 and self.jobs == 2:
                raise BrokenProcessPool
            future: Future[int] = Future()
            future.set_result(job + 1)
            return future

        def shutdown(self, **_: object) -> None: ...

    monkeypatch.setattr(pool, "ProcessPoolExecutor", Pool)
    results = list(run_jobs(ADD, [1, 2, 3], 1, lambda r: False, lambda job, why: -1))
    assert (sorted(results), pools) == ([2, 3, 4], 2)


def test_a_dying_process_is_replaced_and_the_job_given_up_after_its_retries() -> None:
    lost = []

    def lose(job, why):
        lost.append((job, why))
        return "lost"

    assert list(run_jobs(EXIT, [3], 1, lambda r: False, lose, retries=1)) == ["lost"]
    assert lost == [(3, "the worker process died in 2 attempts")]


@pytest.mark.parametrize("workers", [0, 2])
def test_a_worker_that_cannot_be_made_ends_the_jobs_with_its_own_error(workers: int) -> None:
    with pytest.raises(ValueError, match="'no number'"):
        list(run_jobs(REFUSED, [1, 2, 3], workers, lambda r: False, lambda job, why: -1))
