"""Worker processes end with the process that made them, at whatever moment it dies, and what they compute comes back."""

from __future__ import annotations

import contextlib
import os
import random
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import pytest

from data.workers import computed

SCRIPT = """
import time
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from os import getpid
from data.workers import start_worker

if __name__ == "__main__":
    with ProcessPoolExecutor(1, mp_context=get_context("spawn"), initializer=start_worker) as pool:
        print(pool.submit(getpid).result(), flush=True)
        pool.submit(time.sleep, 60).result()
"""


#: A worker that comes to its initializer only when its parent is long gone, and would then live for a minute.
LATE = """
import sys, time
from multiprocessing import get_context
from data.workers import start_worker

def late():
    print(__import__("os").getpid(), flush=True)
    time.sleep(1.5)
    start_worker()
    time.sleep(60)

if __name__ == "__main__":
    process = get_context("spawn").Process(target=late)
    process.start()
    process.join()
"""


def _alive(pid: int) -> bool:
    try:
        with open(f"/proc/{pid}/stat", encoding="utf-8") as stat:
            return stat.read().rsplit(")", 1)[1].split()[0] != "Z"
    except FileNotFoundError:
        return False


@pytest.mark.parametrize("program", [SCRIPT, LATE], ids=["at work", "still starting"])
def test_workers_end_when_their_parent_is_killed(program: str, tmp_path: Path) -> None:
    script = tmp_path / "parent.py"
    script.write_text(program, encoding="utf-8")
    env = {**os.environ, "PYTHONPATH": os.getcwd()}
    parent = subprocess.Popen([sys.executable, str(script)], stdout=subprocess.PIPE, text=True, env=env)
    assert parent.stdout is not None
    worker = int(parent.stdout.readline())
    assert _alive(worker)
    parent.send_signal(signal.SIGKILL)
    parent.wait()
    deadline = time.monotonic() + 15
    while _alive(worker) and time.monotonic() < deadline:
        time.sleep(0.2)
    assert not _alive(worker)


@pytest.mark.parametrize("workers", [1, 2])
def test_calls_give_their_results_by_number(workers: int) -> None:
    calls = {number: partial(pow, number, 2) for number in (3, 5, 8)}
    assert dict(computed(calls, workers)) == {3: 9, 5: 25, 8: 64}


@pytest.mark.parametrize("workers", [1, 2])
def test_after_a_failure_nothing_new_is_begun(workers: int, tmp_path: Path) -> None:
    calls = {number: partial(subprocess.run, ["sh", "-c", f"sleep 0.2; touch {tmp_path}/{number}"]) for number in range(1, 30)}
    with pytest.raises(ValueError, match="invalid literal"):
        list(computed({0: partial(int, "none"), **calls}, workers))
    assert len(list(tmp_path.iterdir())) < 10


@pytest.mark.slow
def test_no_process_is_left_whenever_its_parent_is_killed(tmp_path: Path) -> None:
    script, mark = tmp_path / "parent.py", f"{os.getpid()}-{tmp_path.name}"
    script.write_text(SCRIPT, encoding="utf-8")
    env = {**os.environ, "PYTHONPATH": os.getcwd(), "LEFT_MARK": mark}
    rng = random.Random(0)
    for _ in range(12):
        parent = subprocess.Popen([sys.executable, str(script)], stdout=subprocess.DEVNULL, env=env)
        time.sleep(rng.uniform(0.0, 2.5))
        parent.send_signal(signal.SIGKILL)
        parent.wait()
    deadline = time.monotonic() + 20
    while (left := _marked(mark)) and time.monotonic() < deadline:
        time.sleep(0.2)
    assert not left


def _marked(mark: str) -> list[int]:
    """Processes that were started with the mark in their environment."""
    found: list[int] = []
    for path in Path("/proc").glob("[0-9]*/environ"):
        with contextlib.suppress(OSError):
            if f"LEFT_MARK={mark}".encode() in path.read_bytes() and _alive(int(path.parent.name)):
                found.append(int(path.parent.name))
    return found
