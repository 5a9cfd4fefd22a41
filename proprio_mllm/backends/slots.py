"""Slots: so many calls to a backend at once, over all threads and processes of a run.

A slot is a file lock (`filelock`), which the operating system gives back when the process that holds it dies. Whoever wants one
first takes a further lock, the line; only its holder looks for a free slot, so a busy process cannot keep others out.

Paper: none (engineering).
"""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Final

from filelock import FileLock, Timeout

from proprio_mllm.backends.protocol import Backend, BackendSetupError, ChatReply, ChatRequest

_POLL_S: Final = 0.02


class SlottedBackend:
    """Asks `inner` while it holds a slot.

    Args:
        inner: what is asked; closed with this one.
        count: of slots; the same in every process.
        folder: of the lock files, made when absent; None shares the slots with no other process.

    Raises:
        ValueError: when there would be no slot.
        BackendSetupError: when the folder cannot be made.
    """

    def __init__(self, inner: Backend, count: int, folder: Path | None) -> None:
        if count < 1:
            raise ValueError(f"slots {count} must be positive")
        self.identity = inner.identity
        self._inner = inner
        self._count = count
        self._folder = folder
        self._own = threading.Semaphore(count)
        if folder is not None:
            with _explained(folder):
                folder.mkdir(parents=True, exist_ok=True)

    def complete(self, request: ChatRequest) -> ChatReply:
        """The reply; waits for a slot first.

        Raises:
            BackendSetupError: when the lock files cannot be used.
            BackendError: as of `inner`.
        """
        with self._own, contextlib.ExitStack() as stack:
            if self._folder is not None:
                with _explained(self._folder):
                    stack.callback(_slot(self._folder, self._count).release)
            return self._inner.complete(request)

    def close(self) -> None:
        """Closes the backend that is asked."""
        self._inner.close()


def _slot(folder: Path, count: int) -> FileLock:
    """A slot that is now held; waits for one."""
    with _lock(folder / "line.lock"):
        while True:
            for number in range(count):
                slot = _lock(folder / f"slot{number:04d}.lock")
                with contextlib.suppress(Timeout):
                    slot.acquire(blocking=False)
                    return slot
            time.sleep(_POLL_S)


def _lock(path: Path) -> FileLock:
    # A lock that only marks a file, as filelock takes where the system has none, would outlive a killed process.
    return FileLock(path, thread_local=False, poll_interval=_POLL_S, fallback_to_soft=False, preserve_lock_file=True)


@contextlib.contextmanager
def _explained(folder: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise BackendSetupError(f"slots at {folder} cannot be used: {error}") from error
