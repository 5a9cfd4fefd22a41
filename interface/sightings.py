"""What an episode has shown so far: what came into view when, and what the log lets one believe.

Folded observation by observation, so that planners, and the sequences that models learn from, know the same.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

from interface.belief import Belief
from interface.observation import HistoryItem


class Seen(Protocol):
    """The part of an observation that is told in words; `interface.observation.Observation` is one."""

    @property
    def instruction(self) -> str: ...
    @property
    def robot(self) -> str: ...
    @property
    def visible_objects(self) -> tuple[str, ...]: ...
    @property
    def known_objects(self) -> tuple[str, ...]: ...
    @property
    def history(self) -> tuple[HistoryItem, ...]: ...


@dataclass(frozen=True, slots=True)
class Shown:
    """The words of an observation without the rest of it."""

    instruction: str
    robot: str
    visible_objects: tuple[str, ...]
    known_objects: tuple[str, ...]
    history: tuple[HistoryItem, ...] = ()


class Sightings:
    """One episode's.

    Attributes:
        known: ids seen so far, and the room's furniture.
        visible: ids in view.
        new: ids that came into view with the newest observation.
        found_at: where the robot was when it first saw each thing; None for what was known from the start.
        belief: what the log of steps and codes says.
    """

    def __init__(self) -> None:
        self.known: tuple[str, ...] = ()
        self.visible: tuple[str, ...] = ()
        self.new: tuple[str, ...] = ()
        self.found_at: dict[str, str | None] = {}
        self.belief = Belief()

    def look(self, seen: Seen, self_closing: Sequence[str] = ()) -> None:
        """Takes in an observation.

        Args:
            seen: the newest one.
            self_closing: doors of which the instruction says that they fall shut.
        """
        here = None
        for item in reversed(seen.history):
            if item.step.startswith("GoTo(") and item.feedback.endswith(" ok"):
                here = item.step[len("GoTo(") :].split(",")[0].rstrip(")")
                break
        self.known, self.visible = seen.known_objects, seen.visible_objects
        self.new = tuple(name for name in self.known if name not in self.found_at)
        self.found_at |= dict.fromkeys(self.new, here)
        self.belief = Belief.of(seen.history, self_closing)
