"""Slots: so many calls to a backend at once, over all threads and processes of a run.

A slot is a lock on a file, which the operating system gives back when the process that holds it dies. Whoever wants one stands
in line at a further lock; the first in line alone looks for a free slot, every 20 ms, and the others sleep. A thread that asks
again stands behind those that wait, so that a busy process cannot keep others out. Needs a Unix system; processes are spawned,
since a forked one would hold its parent's locks.

Paper: none (engineering).
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Final

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
        self._own: tempfile.TemporaryDirectory[str] | None = None
        if folder is None:
            self._own = tempfile.TemporaryDirectory(prefix="slots-")
            folder = Path(self._own.name)
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise BackendSetupError(f"no folder for slots at {folder}: {error}") from error
        self._folder = folder
        self._line = self._folder / "line.lock"
        self._paths = [self._folder / f"slot{number:04d}.lock" for number in range(count)]

    @contextlib.contextmanager
    def taken(self) -> Iterator[None]:
        """A block that holds a slot; waits for one.

        Raises:
            BackendSetupError: when the lock files cannot be used.
        """
        try:
            handle = self._take()
        except OSError as error:
            raise BackendSetupError(f"slots at {self._folder} cannot be used: {error}") from error
        try:
            yield
        finally:
            os.close(handle)

    def close(self) -> None:
        """Removes the folder that was made for this process alone."""
        if self._own is not None:
            self._own.cleanup()

    def _take(self) -> int:
        line = _opened(self._line)
        try:
            fcntl.flock(line, fcntl.LOCK_EX)
            while True:
                for path in self._paths:
                    handle = _opened(path)
                    try:
                        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
                    except BlockingIOError:
                        os.close(handle)
                    except BaseException:
                        os.close(handle)
                        raise
                    else:
                        return handle
                time.sleep(_POLL_S)
        finally:
            os.close(line)


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


def _opened(path: Path) -> int:
    return os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
