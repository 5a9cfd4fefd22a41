"""How this project's worker processes start: one thread each, and gone when the process that made them is gone.

Workers are spawned, never forked, because neither torch nor an OpenGL context survives a fork. A killed parent cannot tell its
workers to stop, so each watches for its parent's death. Paper: none (engineering).
"""

from __future__ import annotations

import multiprocessing
import os
import threading
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ProcessPoolExecutor, as_completed
from typing import TypeVar

Result = TypeVar("Result")


def worker_pool(workers: int) -> ProcessPoolExecutor:
    """A pool of so many of these processes."""
    return ProcessPoolExecutor(workers, multiprocessing.get_context("spawn"), start_worker)


def computed(calls: Mapping[int, Callable[[], Result]], workers: int) -> Iterator[tuple[int, Result]]:
    """Numbers and results of calls as they are finished; one that fails ends it, and those that have not begun are left.

    Args:
        calls: by number; a worker process has to be able to read them.
        workers: processes; with 1, or a single call, they run in this one.
    """
    if workers == 1 or len(calls) < 2:
        for number, call in calls.items():
            yield number, call()
        return
    with worker_pool(min(workers, len(calls))) as pool:
        futures = {pool.submit(call): number for number, call in calls.items()}
        try:
            for future in as_completed(futures):
                yield futures.pop(future), future.result()
        finally:
            pool.shutdown(cancel_futures=True)


def start_worker() -> None:
    """Initializer of a process pool: limits the numeric libraries to one thread and ends this process with its parent."""
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ[name] = "1"
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()  # returns at once when it was gone before this process had come so far
        os._exit(1)
