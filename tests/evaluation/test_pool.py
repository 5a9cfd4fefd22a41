"""Workers: results, retries, and processes that die."""

from __future__ import annotations

import functools
import operator
import os

from proprio_mllm.evaluation.pool import run_jobs

ADD = functools.partial(functools.partial, operator.add, 1)
EXIT = functools.partial(functools.partial, os._exit)


def test_in_process() -> None:
    assert list(run_jobs(lambda: ADD(), [1, 2, 3], 0, lambda r: False, lambda job, why: -1)) == [2, 3, 4]


def test_failed_results_are_given_out_and_tried_again() -> None:
    results = list(run_jobs(lambda: ADD(), [1, 2], 0, lambda r: r == 2, lambda job, why: -1, retries=2))
    assert results == [2, 3, 2, 2]


def test_processes() -> None:
    results = run_jobs(ADD, list(range(7)), 2, lambda r: False, lambda job, why: -1)
    assert sorted(results) == [1, 2, 3, 4, 5, 6, 7]


def test_a_dying_process_is_replaced_and_the_job_given_up_after_its_retries() -> None:
    lost = []

    def lose(job, why):
        lost.append((job, why))
        return "lost"

    assert list(run_jobs(EXIT, [3], 1, lambda r: False, lose, retries=1)) == ["lost"]
    assert lost == [(3, "the worker process died in 2 attempts")]
