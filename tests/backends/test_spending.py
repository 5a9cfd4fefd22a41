"""The cap holds: over threads, processes, kills, and whatever becomes of a call."""

from __future__ import annotations

import signal
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from proprio_mllm.backends.prices import Price
from proprio_mllm.backends.protocol import (
    Backend,
    BackendError,
    BackendSetupError,
    ChatReply,
    CostCapError,
    LostReplyError,
)
from proprio_mllm.backends.spending import Spending, SpendingBackend
from tests.backends.loopback import Answering, ask, finished, started

#: 1 USD per token written, so that the bound of a request is about its longest reply.
PRICE = Price(("m",), prompt=0.0, completion=1e6, image_tokens=0, published="2025-01-01", source="here")
PROCESS = """
import sys, time
from pathlib import Path
from proprio_mllm.backends.protocol import CostCapError
from proprio_mllm.backends.spending import Spending
spending = Spending(Path(sys.argv[1]), float(sys.argv[2]))
"""


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "run" / "spending.sqlite"


def raising(error: BaseException):
    def reply(request: object) -> ChatReply:
        raise error

    return reply


def test_the_cost_takes_the_place_of_the_booking(path: Path) -> None:
    spending = Spending(path, 10.0)
    seen = []

    def reply(request: object) -> ChatReply:
        seen.append((spending.total_usd(), spending.open_usd()))
        return ChatReply("ok", 50, 2)

    inner = Answering(reply=reply)
    backend = SpendingBackend(inner, PRICE, spending, "tested")
    assert isinstance(backend, Backend) and backend.identity == "answering"
    assert backend.complete(ask(max_tokens=7)) == ChatReply("ok", 50, 2, cost_usd=2.0)
    assert seen == [(7.0, 7.0)]
    assert (spending.total_usd(), spending.open_usd()) == (2.0, 0.0)
    backend.close()
    assert inner.closed
    assert Spending(path, None).total_usd() == 2.0


def test_a_call_that_might_pass_the_cap_is_not_made(path: Path) -> None:
    inner = Answering(reply=lambda request: ChatReply("ok", 50, 2))
    backend = SpendingBackend(inner, PRICE, Spending(path, 10.0), "tested")
    backend.complete(ask(max_tokens=10))
    message = (
        r"backend tested: a call of up to 9\.0000 USD might pass the cap: 2\.0000 of 10\.0000 USD are spent or booked; a higher"
    )
    with pytest.raises(CostCapError, match=message):
        backend.complete(ask(max_tokens=9))
    assert len(inner.asked) == 1
    backend.complete(ask(max_tokens=8))  # exactly what is left


@pytest.mark.parametrize(
    ("reply", "total"),
    [
        (lambda request: ChatReply("uncounted"), 7.0),
        (lambda request: ChatReply("", finish_reason="refusal"), 0.0),
        (lambda request: ChatReply("half", 5, 3, finish_reason="refusal"), 3.0),
        (lambda request: ChatReply("much", 5, 12), 12.0),
        (raising(LostReplyError("lost")), 7.0),
        (raising(BackendError("overloaded")), 0.0),
        (raising(BackendSetupError("no key")), 0.0),
        (raising(KeyboardInterrupt()), 7.0),
    ],
)
def test_what_becomes_of_a_booking(path: Path, reply, total: float) -> None:
    spending = Spending(path, 10.0)
    backend = SpendingBackend(Answering(reply=reply), PRICE, spending)
    try:
        answer = backend.complete(ask(max_tokens=7))
        assert answer.cost_usd == (None if answer.text == "uncounted" else total)
    except (BackendError, KeyboardInterrupt):
        pass
    assert spending.total_usd() == total


def test_without_bookings_replies_are_priced() -> None:
    assert SpendingBackend(Answering(reply=lambda r: ChatReply("ok", 50, 2)), PRICE, None).complete(ask()).cost_usd == 2.0


def test_no_cap_books_all_the_same(path: Path) -> None:
    spending = Spending(path, None)
    spending.settle(spending.book(1e9), 5.0)
    assert spending.total_usd() == 5.0


def test_wrong_use(path: Path) -> None:
    for cap in (-1.0, float("nan")):
        with pytest.raises(ValueError, match=f"cap_usd {cap} must not be negative"):
            Spending(path, cap)
    spending = Spending(path, 1.0)
    number = spending.book(0.5)
    spending.settle(number, 0.1)
    for wrong in (number, 99):
        with pytest.raises(ValueError, match=f"there is no open booking {wrong}"):
            spending.settle(wrong, 0.1)


def test_threads_do_not_pass_the_cap_together(path: Path) -> None:
    spending = Spending(path, 10.0)
    inner = Answering(reply=lambda request: ChatReply("ok", 50, 1))
    backend = SpendingBackend(inner, PRICE, spending)

    def call(_: int) -> bool:
        try:
            backend.complete(ask(max_tokens=1))
        except CostCapError:
            return False
        return True

    with ThreadPoolExecutor(8) as pool:
        assert sum(pool.map(call, range(40))) == 10
    assert spending.total_usd() == 10.0


def test_processes_do_not_pass_the_cap_together(path: Path) -> None:
    code = PROCESS + (
        "made = 0\n"
        "for _ in range(30):\n"
        "    try:\n"
        "        number = spending.book(1.0)\n"
        "    except CostCapError:\n"
        "        continue\n"
        "    made += 1\n"
        "    spending.settle(number, 1.0)\n"
        "print(made)\n"
    )
    written = finished(*(started(code, path, 25.0) for _ in range(3)))
    assert sum(map(int, written)) == 25
    assert Spending(path, 25.0).total_usd() == 25.0


def test_a_process_that_is_killed_in_a_call_blocks_nothing(path: Path) -> None:
    process = started(PROCESS + "spending.book(3.0)\nprint('booked', flush=True)\ntime.sleep(60)\n", path, 10.0)
    assert process.stdout is not None
    process.stdout.readline()
    process.send_signal(signal.SIGKILL)
    process.communicate()
    spending = Spending(path, 10.0)
    assert (spending.total_usd(), spending.open_usd()) == (3.0, 3.0)  # it may have been charged
    spending.book(7.0)
    with pytest.raises(CostCapError):
        spending.book(0.01)
