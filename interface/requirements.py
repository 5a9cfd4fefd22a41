"""Preconditions of actions: what has to hold before anything moves, each with the failure code that says it does not.

Requirements are checked in the order in which an action lists them and the first one that fails decides, so their order is part
of the contract: the hands first, then what the object allows, then weight, then access. Reach is found out by moving.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Final

from interface.facts import Situation
from interface.failures import FailureCode


@dataclass(frozen=True, slots=True)
class Requirement:
    """One condition.

    Attributes:
        code: what an action fails with when the condition does not hold.
        holds: the condition.
        margin: name of the signed quantity that explains the failure, and the quantity; None without one.
    """

    code: FailureCode
    holds: Callable[[Situation], bool]
    margin: tuple[str, Callable[[Situation], float]] | None = None


Requirements = tuple[Requirement, ...]


def need(code: FailureCode, holds: Callable[[Situation], bool]) -> Requirements:
    """A single condition."""
    return (Requirement(code, holds),)


def where(case: Callable[[Situation], bool], requirements: Iterable[Requirement]) -> Requirements:
    """Requirements that apply in some situations only."""

    def narrowed(one: Requirement) -> Requirement:
        return Requirement(one.code, lambda s: not case(s) or one.holds(s), one.margin)

    return tuple(narrowed(one) for one in requirements)


def _in_other_hand(s: Situation) -> bool:
    return s.arm.other.value in s.target.holders


#: The acting hand is empty.
FREE_HAND: Final = need(FailureCode.BOTH_HANDS_BUSY, lambda s: s.facts.lifted is None) + need(
    FailureCode.HAND_OCCUPIED, lambda s: s.facts.held[s.arm] is None
)
#: Both hands are empty.
BOTH_FREE: Final = need(FailureCode.BOTH_HANDS_BUSY, lambda s: s.facts.lifted is None) + need(
    FailureCode.HAND_OCCUPIED, lambda s: all(item is None for item in s.facts.held.values())
)
#: The acting hand holds something, by itself.
HAND_HOLDS: Final = need(FailureCode.BOTH_HANDS_BUSY, lambda s: s.facts.lifted is None) + need(
    FailureCode.HAND_EMPTY, lambda s: s.facts.held[s.arm] is not None
)
#: Both hands hold one object.
BOTH_HOLD: Final = need(FailureCode.HAND_EMPTY, lambda s: s.facts.lifted is not None)
#: The acting hand holds something, by itself or with the other one.
ANY_HOLD: Final = need(FailureCode.HAND_EMPTY, lambda s: s.facts.lifted is not None or s.facts.held[s.arm] is not None)
#: No hand is at a door or drawer, which a body on the move would tear at.
BASE_FREE: Final = need(
    FailureCode.IN_USE,
    lambda s: all(name is None or s.facts.objects[name].can.movable for name in s.facts.held.values()),
)
#: The target is not shut away.
ACCESSIBLE: Final = need(
    FailureCode.RECEPTACLE_CLOSED,
    lambda s: s.facts.shut_around(s.target.object_id) is None,
)
#: The target can take what is held; a hand at a door holds it open and does not occupy it.
FREE_RECEPTACLE: Final = (
    *need(FailureCode.NOT_RECEPTACLE, lambda s: s.target.can.receptacle and s.target.object_id != s.tool.object_id),
    *need(FailureCode.IN_USE, lambda s: not (s.target.holders and s.target.can.movable)),
    *need(FailureCode.RECEPTACLE_CLOSED, lambda s: not s.target.shut),
    *ACCESSIBLE,
)
#: The target is whole.
NOT_BROKEN: Final = need(FailureCode.OBJECT_BROKEN, lambda s: not s.target.broken)
#: What would roll or slide away under a tool is held by the other hand where it rests.
STEADY: Final = need(
    FailureCode.NEEDS_STEADYING,
    lambda s: not s.target.can.unsteady or (_in_other_hand(s) and bool(s.target.carriers)),
)
#: The hand holds a vessel.
VESSEL: Final = HAND_HOLDS + need(FailureCode.NEEDS_TOOL, lambda s: s.tool.can.movable and s.tool.can.fillable)
#: One hand can carry the target.
ONE_HAND_LOAD: Final = (
    *need(FailureCode.ALREADY_HELD, lambda s: not s.target.holders),
    *need(FailureCode.NOT_PICKUPABLE, lambda s: s.target.can.movable),
    Requirement(
        FailureCode.TOO_HEAVY,
        lambda s: not s.target.two_handed or s.facts.overload_kg(s.target.object_id, 2) <= 0.0,
        ("mass_kg", lambda s: s.facts.overload_kg(s.target.object_id, 2)),
    ),
    Requirement(
        FailureCode.NEEDS_TWO_HANDS,
        lambda s: not s.target.two_handed,
        ("mass_kg", lambda s: s.facts.overload_kg(s.target.object_id, 1)),
    ),
    *need(FailureCode.NOT_PICKUPABLE, lambda s: s.target.can.pickupable),
    *NOT_BROKEN,
    *ACCESSIBLE,
)
#: Two hands can carry the target.
TWO_HAND_LOAD: Final = (
    *need(FailureCode.NOT_LIFTABLE, lambda s: s.target.can.movable),
    Requirement(
        FailureCode.TOO_HEAVY,
        lambda s: s.facts.overload_kg(s.target.object_id, 2) <= 0.0,
        ("mass_kg", lambda s: s.facts.overload_kg(s.target.object_id, 2)),
    ),
    *need(FailureCode.NOT_LIFTABLE, lambda s: s.target.two_handed or s.target.can.liftable),
    *ACCESSIBLE,
)
