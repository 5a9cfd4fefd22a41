"""So many calls at once, and not one more: over threads, processes, and processes that die."""

from __future__ import annotations

import signal
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from proprio_mllm.backends.protocol import Backend, BackendError, BackendSetupError, ChatReply
from proprio_mllm.backends.slots import SlottedBackend
from tests.backends.loopback import Answering, ask, finished, started

#: Threads whose calls note when they began and ended, in the clock that all processes share.
PROCESS = """
import sys, time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from proprio_mllm.backends.slots import SlottedBackend
from tests.backends.loopback import Answering, ask
def reply(request):
    start = time.monotonic()
    time.sleep(float(sys.argv[3]))
    return start, time.monotonic()
backend = SlottedBackend(Answering(reply=reply), int(sys.argv[2]), Path(sys.argv[1]))
print('ready', flush=True)
sys.stdin.read(1)
with ThreadPoolExecutor(6) as pool:
    for start, end in pool.map(lambda _: backend.complete(ask()), range(30)):
        print(start, end)
"""


class Counting:
    """Counts calls under way."""

    def __init__(self) -> None:
        self.lock, self.now, self.most = threading.Lock(), 0, 0

    def reply(self, request: object) -> ChatReply:
        with self.lock:
            self.now += 1
            self.most = max(self.most, self.now)
        time.sleep(0.01)
        with self.lock:
            self.now -= 1
        return ChatReply("ok")


@pytest.mark.parametrize("shared", [True, False])
def test_threads(tmp_path: Path, shared: bool) -> None:
    counting = Counting()
    inner = Answering(reply=counting.reply)
    backend = SlottedBackend(inner, 3, tmp_path / "new" / "slots" if shared else None)
    assert isinstance(backend, Backend) and backend.identity == "answering"
    with ThreadPoolExecutor(12) as pool:
        assert len(list(pool.map(lambda _: backend.complete(ask()), range(30)))) == 30
    assert counting.most == 3
    backend.close()
    assert inner.closed
    assert (tmp_path / "new" / "slots").exists() is shared


def test_processes(tmp_path: Path) -> None:
    processes = [started(PROCESS, tmp_path, 3, 0.02) for _ in range(2)]
    for process in processes:
        assert process.stdout is not None and process.stdin is not None
        assert process.stdout.readline() == "ready\n"
    for process in processes:
        assert process.stdin is not None
        process.stdin.write("x")
        process.stdin.flush()
    spans = [[tuple(map(float, line.split())) for line in text.splitlines()] for text in finished(*processes)]
    events = sorted((when, change) for one in spans for start, end in one for when, change in ((start, 1), (end, -1)))
    now, most = 0, 0
    for _, change in events:
        now += change
        most = max(most, now)
    assert most == 3
    assert len(events) == 120
    # neither process waited until the other was done
    first, second = (sorted(start for start, _ in one) for one in spans)
    assert first[3] < second[-1] and second[3] < first[-1]


def test_a_process_that_dies_gives_its_slots_back(tmp_path: Path) -> None:
    process = started(PROCESS, tmp_path, 2, 60)
    assert process.stdout is not None and process.stdin is not None
    process.stdout.readline()
    process.stdin.write("x")
    process.stdin.flush()
    while len(list(tmp_path.glob("slot*.lock"))) < 2:
        time.sleep(0.01)
    backend = SlottedBackend(Answering(), 2, tmp_path)
    with ThreadPoolExecutor(1) as pool:
        waiting = pool.submit(backend.complete, ask())
        with pytest.raises(TimeoutError):
            waiting.result(0.3)
        process.send_signal(signal.SIGKILL)
        assert waiting.result(5.0).text == "reply to what now?"
    process.communicate()


def test_an_error_gives_the_slot_back(tmp_path: Path) -> None:
    def fail(request: object) -> ChatReply:
        raise BackendError("no")

    backend = SlottedBackend(Answering(reply=fail), 1, tmp_path)
    for _ in range(3):
        with pytest.raises(BackendError, match="no"):
            backend.complete(ask())


def test_waiting_costs_little(tmp_path: Path) -> None:
    held, free = threading.Barrier(3), threading.Event()

    def hold(request: object) -> ChatReply:
        held.wait(5.0)
        free.wait(5.0)
        return ChatReply("held")

    holding, others = SlottedBackend(Answering(reply=hold), 2, tmp_path), SlottedBackend(Answering(), 2, tmp_path)
    with ThreadPoolExecutor(18) as pool:
        holders = [pool.submit(holding.complete, ask()) for _ in range(2)]
        held.wait(5.0)
        calls = [pool.submit(others.complete, ask()) for _ in range(16)]
        before = time.process_time()
        time.sleep(0.5)
        assert time.process_time() - before < 0.1
        assert not any(one.done() for one in calls)
        free.set()
        for one in (*holders, *calls):
            one.result(5.0)


def test_wrong_slots(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="slots 0 must be positive"):
        SlottedBackend(Answering(), 0, tmp_path)
    (tmp_path / "file").write_text("")
    with pytest.raises(BackendSetupError, match=r"slots at .*file.slots cannot be used"):
        SlottedBackend(Answering(), 1, tmp_path / "file" / "slots")
    backend = SlottedBackend(Answering(), 1, tmp_path / "gone")
    (tmp_path / "gone").rmdir()
    (tmp_path / "gone").write_text("")
    with pytest.raises(BackendSetupError, match=r"slots at .*gone cannot be used"):
        backend.complete(ask())
