"""So many calls at once, and not one more: over threads, processes, and processes that die."""

from __future__ import annotations

import signal
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from proprio_mllm.backends.protocol import Backend, BackendError, BackendSetupError, ChatReply
from proprio_mllm.backends.slots import Slots, SlottedBackend
from tests.backends.loopback import Answering, ask, finished, started

#: Threads that hold slots and note when they began and ended, in the clock that all processes share.
PROCESS = """
import sys, time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from proprio_mllm.backends.slots import Slots
slots = Slots(int(sys.argv[2]), Path(sys.argv[1]))
def call(number):
    with slots.taken():
        start = time.monotonic()
        time.sleep(0.02)
        return start, time.monotonic()
"""
RUN = (
    PROCESS
    + """
print('ready', flush=True)
sys.stdin.read(1)
with ThreadPoolExecutor(6) as pool:
    for start, end in pool.map(call, range(30)):
        print(start, end)
"""
)


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
    slots = Slots(3, tmp_path / "new" / "slots" if shared else None)
    inner = Answering(reply=counting.reply)
    backend = SlottedBackend(inner, slots)
    assert isinstance(backend, Backend) and backend.identity == "answering"
    with ThreadPoolExecutor(12) as pool:
        assert len(list(pool.map(lambda _: backend.complete(ask()), range(30)))) == 30
    assert counting.most == 3
    folder = slots._folder
    backend.close()
    assert inner.closed
    assert folder.exists() is shared


def test_processes(tmp_path: Path) -> None:
    processes = [started(RUN, tmp_path, 3) for _ in range(2)]
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
    code = PROCESS + "taken = [slots._take() for _ in range(2)]\nprint('taken', flush=True)\ntime.sleep(60)\n"
    process = started(code, tmp_path, 2)
    assert process.stdout is not None
    process.stdout.readline()
    got = threading.Event()

    def wait() -> None:
        with Slots(2, tmp_path).taken():
            got.set()

    waiting = threading.Thread(target=wait)
    waiting.start()
    assert not got.wait(0.2)
    process.send_signal(signal.SIGKILL)
    assert got.wait(5.0)
    waiting.join()
    process.communicate()


def test_an_error_gives_the_slot_back(tmp_path: Path) -> None:
    def fail(request: object) -> ChatReply:
        raise BackendError("no")

    backend = SlottedBackend(Answering(reply=fail), Slots(1, tmp_path))
    for _ in range(3):
        with pytest.raises(BackendError, match="no"):
            backend.complete(ask())


def test_waiting_costs_little(tmp_path: Path) -> None:
    slots = Slots(2, tmp_path)

    def call(_: int) -> None:
        with slots.taken():
            pass

    with ThreadPoolExecutor(16) as pool:
        with slots.taken(), slots.taken():
            calls = [pool.submit(call, number) for number in range(16)]
            before = time.process_time()
            time.sleep(0.5)
            assert time.process_time() - before < 0.1
            assert not any(one.done() for one in calls)
        for one in calls:
            one.result(5.0)


def test_wrong_slots(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="slots 0 must be positive"):
        Slots(0, tmp_path)
    (tmp_path / "file").write_text("")
    with pytest.raises(BackendSetupError, match=r"no folder for slots at .*file"):
        Slots(1, tmp_path / "file" / "slots")
    slots = Slots(1, tmp_path / "gone")
    (tmp_path / "gone").rmdir()
    (tmp_path / "gone").write_text("")
    with pytest.raises(BackendSetupError, match=r"slots at .*gone cannot be used"):
        SlottedBackend(Answering(), slots).complete(ask())
