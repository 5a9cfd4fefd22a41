"""Episodes on several processes: each worker has its own simulator, planner and one thread.

Physics and rendering take about as long as the small model (measured: about 0.3 s of one core per step each), so one model per
worker keeps every core busy. A large model is better asked for many episodes at once, in this process (`run_here`) or in
one of its own (`serving`). Workers are spawned, never forked, because torch and GL are loaded. Rows of a batch of one do not
depend on what else runs, so results do not depend on the number of workers.

A worker that dies takes its pool with it; the pool is made anew, and an episode that was under way when that happened more than
`retries` times becomes an infrastructure error.
"""

from __future__ import annotations

import logging
from collections import Counter, deque
from collections.abc import Callable, Hashable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from multiprocessing import get_context
from typing import Any, Generic, Protocol, TypeVar

from data.workers import start_worker

logger = logging.getLogger(__name__)

J = TypeVar("J")
R = TypeVar("R")
J_contra = TypeVar("J_contra", contravariant=True)
R_co = TypeVar("R_co", covariant=True)


class Worker(Protocol[J_contra, R_co]):
    """Does one job after the other; made once per process."""

    def __call__(self, job: J_contra) -> R_co:
        """The result of a job."""
        ...


_make: Callable[[], Any] | None = None
_worker: Any = None


def _start(make: Callable[[], Any]) -> None:
    global _make
    start_worker()
    _make = make


def _do(job: Any) -> Any:
    """Makes the worker with its first job: an error in an initializer would look like a process that died."""
    global _worker
    if _worker is None:
        assert _make is not None
        _worker = _make()
    return _worker(job)


@dataclass
class _Attempt(Generic[J]):
    job: J
    number: int = 1


def run_jobs(
    make: Callable[[], Worker[J, R]],
    jobs: Sequence[J],
    workers: int,
    failed: Callable[[R], bool],
    lost: Callable[[J, str], R],
    retries: int = 1,
) -> Iterator[R]:
    """Results in the order they are ready.

    Args:
        make: makes a worker; must be picklable unless `workers` is 0.
        jobs: what is to be done, in the order it is started.
        workers: processes; 0 does everything here.
        failed: whether a result is worth another attempt. Every attempt's result is given out.
        lost: the result of a job whose process died too often, with the reason.
        retries: further attempts per job.

    Raises:
        Exception: what `make` raises, wherever it runs; no job is to blame for it.
    """
    queue = [_Attempt(job) for job in jobs]
    if workers == 0:
        worker = make()
        while queue:
            attempt = queue.pop(0)
            result = worker(attempt.job)
            yield result
            if failed(result) and attempt.number <= retries:
                queue.append(_Attempt(attempt.job, attempt.number + 1))
        return
    while queue:
        yield from _run_pool(make, queue, min(workers, len(queue)), failed, lost, retries)


def run_here(
    run: Callable[[deque[J], int], Iterator[tuple[J, R]]],
    jobs: Sequence[J],
    count: int,
    failed: Callable[[R], bool],
    name: Callable[[J], Hashable],
    retries: int = 1,
) -> Iterator[R]:
    """Results of jobs done in this process, up to `count` at a time, in the order they are ready.

    Args:
        run: does the jobs of a queue, and what is appended to it meanwhile, so many at a time; gives each with its result.
        jobs: what is to be done, in the order it is started.
        count: jobs at a time.
        failed: whether a result is worth another attempt. Every attempt's result is given out.
        name: what tells jobs apart.
        retries: further attempts per job.
    """
    queue, attempts = deque(jobs), Counter[Hashable]()
    for job, result in run(queue, count):
        yield result
        attempts[name(job)] += 1
        if failed(result) and attempts[name(job)] <= retries:
            queue.append(job)


def _run_pool(
    make: Callable[[], Worker[J, R]],
    queue: list[_Attempt[J]],
    workers: int,
    failed: Callable[[R], bool],
    lost: Callable[[J, str], R],
    retries: int,
) -> Iterator[R]:
    """Works the queue off with one pool; returns early, with a shorter queue, when a process dies."""
    running: dict[Future[R], _Attempt[J]] = {}
    pool = ProcessPoolExecutor(workers, get_context("spawn"), _start, (make,))
    try:
        while queue or running:
            while queue and len(running) < workers:
                attempt = queue[0]
                running[pool.submit(_do, attempt.job)] = attempt  # raises when a process has died: the attempt stays queued
                queue.pop(0)
            ready, _ = wait(running, return_when=FIRST_COMPLETED)
            for future in ready:
                attempt = running[future]
                result = future.result()
                del running[future]
                yield result
                if failed(result) and attempt.number <= retries:
                    queue.append(_Attempt(attempt.job, attempt.number + 1))
    except BrokenProcessPool:
        logger.warning("a worker process died; starting new ones")
        for attempt in running.values():
            if attempt.number <= retries:
                queue.append(_Attempt(attempt.job, attempt.number + 1))
            else:
                yield lost(attempt.job, f"the worker process died in {attempt.number} attempts")
    finally:
        pool.shutdown(wait=True, cancel_futures=True)
