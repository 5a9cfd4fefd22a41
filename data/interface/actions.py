"""The table of actions: what each one occupies, takes, needs, does and can meet.

Paper: the dual-arm action space of DualTHOR.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Final

__all__ = ["ACTIONS", "ActionKind", "ActionSpec"]


class ActionKind(StrEnum):
    """What an action occupies: the whole body, one arm, both arms, or nothing (episode control)."""

    BODY = "body"
    ARM = "arm"
    TWO_ARM = "two_arm"
    EPISODE = "episode"


@dataclass(frozen=True, slots=True)
class ActionSpec:
    """Signature of one action of the grammar.

    Attributes:
        name: AI2-THOR-style verb.
        kind: what the action occupies while it runs.
        takes_object: whether an object id is required.
        amount_unit: unit of the optional amount (`m` or `deg`), or None when there is no amount.
        amount_range: closed range of the amount in that unit.
        amount_default: amount used when the text gives none.
    """

    name: str
    kind: ActionKind
    takes_object: bool
    amount_unit: str | None = None
    amount_range: tuple[float, float] = (0.0, 0.0)
    amount_default: float | None = None


def _spec(
    name: str,
    kind: ActionKind,
    takes_object: bool,
    unit: str | None = None,
    low: float = 0.0,
    high: float = 0.0,
    default: float | None = None,
) -> ActionSpec:
    return ActionSpec(name, kind, takes_object, unit, (low, high), default)


#: Every action that a planner may use, by name. GoTo's amount is the distance between pelvis and object, its second amount
#: (`bearing_deg`, optional) the object's bearing in the heading frame, positive to the left.
ACTIONS: Final[Mapping[str, ActionSpec]] = {
    spec.name: spec
    for spec in (
        _spec("GoTo", ActionKind.BODY, True, "m", 0.2, 2.0),
        _spec("MoveAhead", ActionKind.BODY, False, "m", 0.05, 5.0, 0.25),
        _spec("MoveBack", ActionKind.BODY, False, "m", 0.05, 5.0, 0.25),
        _spec("MoveLeft", ActionKind.BODY, False, "m", 0.05, 5.0, 0.25),
        _spec("MoveRight", ActionKind.BODY, False, "m", 0.05, 5.0, 0.25),
        _spec("RotateLeft", ActionKind.BODY, False, "deg", 5.0, 180.0, 90.0),
        _spec("RotateRight", ActionKind.BODY, False, "deg", 5.0, 180.0, 90.0),
        _spec("MoveUp", ActionKind.BODY, False, "m", 0.01, 1.0, 0.1),
        _spec("MoveDown", ActionKind.BODY, False, "m", 0.01, 1.0, 0.1),
        _spec("Pick", ActionKind.ARM, True),
        _spec("Place", ActionKind.ARM, True),
        _spec("Open", ActionKind.ARM, True),
        _spec("Close", ActionKind.ARM, True),
        _spec("ToggleOn", ActionKind.ARM, True),
        _spec("ToggleOff", ActionKind.ARM, True),
        _spec("Hold", ActionKind.ARM, True),
        _spec("Release", ActionKind.ARM, False),
        _spec("Slice", ActionKind.ARM, True),
        _spec("Clean", ActionKind.ARM, True),
        _spec("UseUp", ActionKind.ARM, True),
        _spec("Pour", ActionKind.ARM, True),
        _spec("Fill", ActionKind.ARM, True),
        _spec("ResetArm", ActionKind.ARM, False),
        _spec("Lift", ActionKind.TWO_ARM, True),
        _spec("PlaceBoth", ActionKind.TWO_ARM, True),
        _spec("Done", ActionKind.EPISODE, False),
    )
}
