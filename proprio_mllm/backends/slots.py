"""At most so many calls to a backend at once, over all threads and processes of a run.

A slot is a lock file (`filelock`), which the operating system frees when the process that holds it dies. Whoever wants one
stands in line at a further lock, so that a busy process cannot keep others out; the first in line alone looks for a free slot.
Paper: none (engineering).
"""

from __future__ import annotations

import contextlib
import itertools
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Final

from filelock import FileLock, Timeout

from proprio_mllm.backends.protocol import Backend, BackendSetupError, ChatReply, ChatRequest

__all__ = ["Slots", "SlottedBackend"]

_POLL_S: Final = 0.02


class Slots:
    """The slots of one backend.

    Args:
        count: of slots; the same in every process.
        folder: of the lock files, made when absent; None makes one for this process alone.

    Raises:
        ValueError: when there would be none.
        BackendSetupError: when the folder cannot be made.
    """

    def __init__(self, count: int, folder: Path | None) -> None:
        if count < 1:
            raise ValueError(f"slots {count} must be positive")
        self._own = tempfile.TemporaryDirectory(prefix="slots-") if folder is None else None
        self._folder = Path(self._own.name) if self._own is not None else Path(folder or "")
        self._count = count
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise BackendSetupError(f"no folder for slots at {self._folder}: {error}") from error

    @contextlib.contextmanager
    def taken(self) -> Iterator[None]:
        """A block that holds a slot; waits for one.

        Raises:
            BackendSetupError: when the lock files cannot be used.
        """
        try:
            slot = self._take()
        except OSError as error:
            raise BackendSetupError(f"slots at {self._folder} cannot be used: {error}") from error
        try:
            yield
        finally:
            slot.release()

    def close(self) -> None:
        """Removes the folder that was made for this process alone."""
        if self._own is not None:
            self._own.cleanup()

    def _take(self) -> FileLock:
        with FileLock(self._folder / "line.lock", poll_interval=_POLL_S):
            for number in itertools.cycle(range(self._count)):
                slot = FileLock(self._folder / f"slot{number:04d}.lock")
                with contextlib.suppress(Timeout):
                    slot.acquire(timeout=0)
                    return slot
                if number == self._count - 1:
                    time.sleep(_POLL_S)
        raise AssertionError("the cycle of slots ended")


class SlottedBackend:
    """Asks `inner` while it holds a slot.

    Args:
        inner: what is asked; closed with this one.
        slots: of which each call takes one; closed with this one.
    """

    def __init__(self, inner: Backend, slots: Slots) -> None:
        self.identity = inner.identity
        self._inner = inner
        self._slots = slots

    def complete(self, request: ChatRequest) -> ChatReply:
        """The reply; waits for a slot first.

        Raises:
            BackendError: as of `inner`.
        """
        with self._slots.taken():
            return self._inner.complete(request)

    def close(self) -> None:
        """Closes the slots and the backend that is asked."""
        self._inner.close()
        self._slots.close()
