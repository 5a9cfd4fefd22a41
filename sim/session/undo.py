"""Going back and forth in an episode that somebody drives: every step taken back exactly, and taken again."""

from __future__ import annotations

from collections import deque

from sim.session.session import Session, SessionSnapshot


class UndoHistory:
    """Snapshots before and after the present state.

    Args:
        limit: most steps to go back; a snapshot takes about a megabyte.

    Attributes:
        past: snapshots that `undo` returns to, the latest last.
        future: those that `redo` returns to, likewise.
    """

    def __init__(self, limit: int) -> None:
        self.past: deque[SessionSnapshot] = deque(maxlen=limit)
        self.future: deque[SessionSnapshot] = deque(maxlen=limit)

    def clear(self) -> None:
        """Forgets everything."""
        self.past.clear()
        self.future.clear()

    def add(self, before: SessionSnapshot) -> None:
        """Notes the state before a step that has been, or is about to be taken; what was taken back is forgotten."""
        self.past.append(before)
        self.future.clear()

    def undo(self, session: Session) -> bool:
        """Takes the last step back; False when there is none."""
        return _travel(session, self.past, self.future)

    def redo(self, session: Session) -> bool:
        """Takes the last step that was taken back again; False when there is none."""
        return _travel(session, self.future, self.past)


def _travel(session: Session, source: deque[SessionSnapshot], target: deque[SessionSnapshot]) -> bool:
    if not source:
        return False
    target.append(session.snapshot())
    session.restore(source.pop())
    return True
