"""Calls of many threads answered together: order, limits, errors of one's own, and the end."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor

import pytest

from proprio_mllm.backends.batching import Batcher
from proprio_mllm.backends.protocol import BackendError


class Doubler:
    """Doubles numbers; waits in its first batch until it is let go, and stumbles over what it is told to."""

    def __init__(self) -> None:
        self.batches: list[list[int]] = []
        self.entered, self.go = threading.Event(), threading.Event()
        self.poison: int | None = None

    def __call__(self, numbers: Sequence[int]) -> list[int | Exception]:
        self.batches.append(list(numbers))
        if len(self.batches) == 1:
            self.entered.set()
            assert self.go.wait(30)
        if self.poison in numbers:
            raise ZeroDivisionError(f"over {self.poison}")
        return [BackendError(f"{n} is negative") if n < 0 else 2 * n for n in numbers]


def until(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 30
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.002)


def held(pool: ThreadPoolExecutor, batcher: Batcher[int, int], doubler: Doubler, numbers: Sequence[int]) -> list[Future[int]]:
    """Asks for each number in order; the first is under way and the others wait, until `go`."""
    asked = [pool.submit(batcher.ask, numbers[0])]
    assert doubler.entered.wait(30)
    for count, number in enumerate(numbers[1:], 1):
        asked.append(pool.submit(batcher.ask, number))
        until(lambda count=count: len(batcher._waiting) == count)
    return asked


def test_who_waits_is_answered_together_oldest_first() -> None:
    doubler = Doubler()
    batcher: Batcher[int, int] = Batcher(doubler, 3)
    with ThreadPoolExecutor(8) as pool:
        asked = held(pool, batcher, doubler, range(8))
        doubler.go.set()
        assert [one.result(30) for one in asked] == [2 * n for n in range(8)]
    assert doubler.batches == [[0], [1, 2, 3], [4, 5, 6], [7]]
    assert (batcher.questions, batcher.batches) == (8, 4)


def test_an_error_in_place_of_an_answer_is_its_callers() -> None:
    doubler = Doubler()
    batcher: Batcher[int, int] = Batcher(doubler, 8)
    with ThreadPoolExecutor(4) as pool:
        asked = held(pool, batcher, doubler, (1, 2, -3, 4))
        doubler.go.set()
        with pytest.raises(BackendError, match="-3 is negative"):
            asked[2].result(30)
        assert [asked[i].result(30) for i in (0, 1, 3)] == [2, 4, 8]


def test_an_error_that_nobody_foresaw_reaches_who_caused_it() -> None:
    """The first of a broken batch is told, rightly or not; the others are asked one by one."""
    doubler = Doubler()
    doubler.poison = 3
    batcher: Batcher[int, int] = Batcher(doubler, 3)
    with ThreadPoolExecutor(6) as pool:
        asked = held(pool, batcher, doubler, (1, 3, 4, 5, 6))
        doubler.go.set()
        with pytest.raises(ZeroDivisionError, match="over 3"):
            asked[1].result(30)
        assert [asked[i].result(30) for i in (0, 2, 3, 4)] == [2, 8, 10, 12]
    assert doubler.batches == [[1], [3, 4, 5], [4], [5], [6]]


def test_a_wrong_number_of_answers_is_refused() -> None:
    batcher: Batcher[int, int] = Batcher(lambda numbers: [], 3)
    with pytest.raises(ValueError, match="0 answers to 1 questions"):
        batcher.ask(1)


def test_closing_waits_for_the_batch_under_way() -> None:
    doubler = Doubler()
    batcher: Batcher[int, int] = Batcher(doubler, 1)
    with ThreadPoolExecutor(4) as pool:
        asked = held(pool, batcher, doubler, (1, 2, 3))
        closing = pool.submit(batcher.close)
        until(lambda: batcher._closed)
        assert not closing.done()
        doubler.go.set()
        closing.result(30)
        assert asked[0].result(30) == 2
        for one in asked[1:]:
            with pytest.raises(BackendError, match="closed"):
                one.result(30)
    with pytest.raises(BackendError, match="closed"):
        batcher.ask(4)


def test_many_threads_get_their_own_answers() -> None:
    doubler = Doubler()
    doubler.go.set()
    batcher: Batcher[int, int] = Batcher(doubler, 4)
    with ThreadPoolExecutor(16) as pool:
        assert list(pool.map(batcher.ask, range(400))) == [2 * n for n in range(400)]
    assert sorted(n for batch in doubler.batches for n in batch) == list(range(400))
    assert max(map(len, doubler.batches)) <= 4


def test_the_limit_is_positive() -> None:
    with pytest.raises(ValueError, match="limit 0 must be positive"):
        Batcher(lambda numbers: [], 0)
