"""Effects of actions as data; `interface.symbolic` carries them out, and planners read from them what an action is for."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import Literal


class Condition(StrEnum):
    """States of objects that actions change."""

    OPEN = "open"
    ON = "on"
    SLICED = "sliced"
    DIRTY = "dirty"
    USED_UP = "used_up"
    FILLED = "filled"


@dataclass(frozen=True, slots=True)
class Become:
    """An object gets into a state.

    Attributes:
        condition: the state.
        value: whether it is in it, None when one cannot know.
        of: the action's target, or the tool in the acting hand.
    """

    condition: Condition
    value: bool | None
    of: Literal["target", "tool"] = "target"


@dataclass(frozen=True, slots=True)
class Grasp:
    """The acting limbs hold the target.

    Attributes:
        in_place: whether it stays where it rests.
    """

    in_place: bool = False


@dataclass(frozen=True, slots=True)
class HoldOpen:
    """The acting hand stays at a door or drawer that would otherwise fall shut."""


@dataclass(frozen=True, slots=True)
class PutDown:
    """What the acting limbs hold comes to rest on or in the target."""


@dataclass(frozen=True, slots=True)
class LetGo:
    """What the acting hand holds stays where it is, or falls; a door with a spring shuts."""


@dataclass(frozen=True, slots=True)
class Turn:
    """The base turns where it stands."""


@dataclass(frozen=True, slots=True)
class Walk:
    """The base moves.

    Attributes:
        to_target: whether it then stands at the target.
    """

    to_target: bool = False


@dataclass(frozen=True, slots=True)
class Rise:
    """The pelvis moves up, by the action's amount times the sign."""

    sign: Literal[-1, 1]


Effect = Become | Grasp | HoldOpen | PutDown | LetGo | Walk | Turn | Rise
