"""Why an action failed: one code per reason, the paper's failure type it rolls up to, and the margins that explain it.

A failed action returns exactly one code. Every code belongs to one of the paper's three failure types (Table IV: navigation,
body adjustment, logical). Codes of a contingency (chance, as the seed decides) take the type of what the action was about:
a body movement is navigation, a change of body height is body adjustment, everything else is logical, because what remains for
the planner is to notice and recover.

Margins are signed: `reach_m` is how far the target lies beyond the arm (positive: too far), `height_m` the change of pelvis
height that would bring it into reach (negative: move down), `mass_kg` the mass above the limit, `travel_m` the distance that
was covered before a path was blocked, `gap_m` the distance between the fingers and what they should have touched (for
`HandleSlipped` the share of the joint's range that is missing), `tilt_deg` how far what was put down is from standing or lying.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Final

#: What a log says of a reply that is no step of the grammar; no action failed, so it is no failure code.
INVALID_OUTPUT: Final = "InvalidOutput"
#: What a log says of every failed action where failures are told as one bit.
FAILED: Final = "Failed"


class FailureCategory(StrEnum):
    """The paper's three failure types (Table IV)."""

    NAVIGATION = "navigation"
    BODY_ADJUSTMENT = "body_adjustment"
    LOGICAL = "logical"


class FailureCode(StrEnum):
    """Machine-readable reason of a failed action; see `FAILURES` for what each one means."""

    TOO_FAR = "TooFar"
    BLOCKED_PATH = "BlockedPath"
    NO_FREE_POSE = "NoFreePose"
    BODY_TOO_HIGH = "BodyTooHigh"
    BODY_TOO_LOW = "BodyTooLow"
    HEIGHT_LIMIT = "HeightLimit"
    OBJECT_NOT_KNOWN = "ObjectNotKnown"
    HAND_OCCUPIED = "HandOccupied"
    HAND_EMPTY = "HandEmpty"
    NOT_PICKUPABLE = "NotPickupable"
    NEEDS_TWO_HANDS = "NeedsTwoHands"
    NOT_LIFTABLE = "NotLiftable"
    TOO_HEAVY = "TooHeavy"
    NOT_OPENABLE = "NotOpenable"
    NOT_TOGGLEABLE = "NotToggleable"
    NOT_RECEPTACLE = "NotReceptacle"
    RECEPTACLE_CLOSED = "ReceptacleClosed"
    RECEPTACLE_FULL = "ReceptacleFull"
    NOT_SLICEABLE = "NotSliceable"
    NOT_DIRTY = "NotDirty"
    NOT_USABLE = "NotUsable"
    NOT_FILLABLE = "NotFillable"
    NEEDS_STEADYING = "NeedsSteadying"
    NEEDS_TOOL = "NeedsTool"
    EMPTY = "Empty"
    SOURCE_OFF = "SourceOff"
    ALREADY_IN_STATE = "AlreadyInState"
    ALREADY_HELD = "AlreadyHeld"
    IN_USE = "InUse"
    ARM_CONFLICT = "ArmConflict"
    BOTH_HANDS_BUSY = "BothHandsBusy"
    OBSTRUCTED = "Obstructed"
    GRASP_MISSED = "GraspMissed"
    TOOL_MISSED = "ToolMissed"
    POUR_MISSED = "PourMissed"
    DROPPED = "Dropped"
    PLACE_MISSED = "PlaceMissed"
    HANDLE_SLIPPED = "HandleSlipped"
    OBJECT_BROKEN = "ObjectBroken"
    SLIPPED = "Slipped"
    BROKE = "Broke"
    SPILLED = "Spilled"
    NOTHING_HAPPENED = "NothingHappened"
    LOCKED = "Locked"


@dataclass(frozen=True, slots=True)
class FailureSpec:
    """What a failure code means.

    Attributes:
        category: the paper's failure type, None for contingency codes, whose type follows from the action.
        meaning: why the action failed, for people.
        advice: what a planner is told of it: what is in the way, and what to do.
        margins: names of the margins that may accompany the code.
    """

    category: FailureCategory | None
    meaning: str
    advice: str
    margins: tuple[str, ...] = ()


_NAV, _BODY, _LOGIC = FailureCategory.NAVIGATION, FailureCategory.BODY_ADJUSTMENT, FailureCategory.LOGICAL

#: Every code with its meaning. A test asserts that the table is complete.
FAILURES: Final[Mapping[FailureCode, FailureSpec]] = {
    FailureCode.TOO_FAR: FailureSpec(
        _NAV,
        "no pelvis height at this stance brings the target into reach",
        "out of reach from here at any body height: go nearer or to another side",
        ("reach_m",),
    ),
    FailureCode.BLOCKED_PATH: FailureSpec(
        _NAV, "furniture or a wall stands in the way", "furniture or a wall is in the way", ("travel_m",)
    ),
    FailureCode.NO_FREE_POSE: FailureSpec(
        _NAV, "the robot can stand nowhere as asked, or there is no way to get there", "the robot cannot stand there as asked"
    ),
    FailureCode.BODY_TOO_HIGH: FailureSpec(
        _BODY, "a lower pelvis at the same stance would reach", "lower the body", ("height_m", "reach_m")
    ),
    FailureCode.BODY_TOO_LOW: FailureSpec(
        _BODY, "a higher pelvis at the same stance would reach", "raise the body", ("height_m", "reach_m")
    ),
    FailureCode.HEIGHT_LIMIT: FailureSpec(
        _BODY,
        "the legs are at the end of their range, or an arm runs into something",
        "the legs are at the end of their range, or an arm touches something",
        ("height_m",),
    ),
    FailureCode.OBJECT_NOT_KNOWN: FailureSpec(
        _LOGIC, "no object of that name has been seen in this episode", "nothing of that name has been seen yet"
    ),
    FailureCode.HAND_OCCUPIED: FailureSpec(_LOGIC, "the hand already holds something", "the hand already holds something"),
    FailureCode.HAND_EMPTY: FailureSpec(_LOGIC, "the hand holds nothing", "the hand holds nothing"),
    FailureCode.NOT_PICKUPABLE: FailureSpec(_LOGIC, "the object cannot be picked up", "it cannot be picked up"),
    FailureCode.NEEDS_TWO_HANDS: FailureSpec(
        _LOGIC, "the object is too big for one hand, Lift it", "too big for one hand: Lift it", ("mass_kg",)
    ),
    FailureCode.NOT_LIFTABLE: FailureSpec(
        _LOGIC, "the object cannot be lifted with two hands", "it cannot be lifted with two hands"
    ),
    FailureCode.TOO_HEAVY: FailureSpec(
        _LOGIC, "the object exceeds what the arms carry", "more than the arms carry", ("mass_kg",)
    ),
    FailureCode.NOT_OPENABLE: FailureSpec(_LOGIC, "the object has nothing that opens", "it has nothing that opens"),
    FailureCode.NOT_TOGGLEABLE: FailureSpec(_LOGIC, "the object has no switch", "it has no switch"),
    FailureCode.NOT_RECEPTACLE: FailureSpec(_LOGIC, "nothing can be put on or in the object", "nothing can be put on or in it"),
    FailureCode.RECEPTACLE_CLOSED: FailureSpec(_LOGIC, "the receptacle is closed", "it is closed: open it first"),
    FailureCode.RECEPTACLE_FULL: FailureSpec(
        _LOGIC, "no free spot on or in the receptacle fits the object", "there is no free spot on or in it"
    ),
    FailureCode.NOT_SLICEABLE: FailureSpec(_LOGIC, "the object cannot be sliced", "it cannot be sliced"),
    FailureCode.NOT_DIRTY: FailureSpec(_LOGIC, "the object is clean, and nothing is spilled on it", "it is clean"),
    FailureCode.NOT_USABLE: FailureSpec(_LOGIC, "there is nothing in the object to use up", "there is nothing to use up"),
    FailureCode.NOT_FILLABLE: FailureSpec(
        _LOGIC, "the object holds no liquid, or gives none", "it holds no liquid, or gives none"
    ),
    FailureCode.NEEDS_TOOL: FailureSpec(
        _LOGIC,
        "the hand does not hold what the action takes: a knife, a sponge or towel, a vessel",
        "the hand does not hold the knife, sponge, towel or vessel that this takes",
    ),
    FailureCode.NEEDS_STEADYING: FailureSpec(
        _LOGIC,
        "the object would roll or slide away, Hold it with the other hand",
        "it would slide away: Hold it with the other hand in the same step or before",
    ),
    FailureCode.EMPTY: FailureSpec(_LOGIC, "there is nothing to pour in the vessel that the hand holds", "the vessel is empty"),
    FailureCode.SOURCE_OFF: FailureSpec(
        _LOGIC, "nothing comes out of the source, switch it on", "nothing comes out of the source: switch it on"
    ),
    FailureCode.ALREADY_IN_STATE: FailureSpec(
        _LOGIC, "the object already is in the state that the action makes", "it already is as the action makes it"
    ),
    FailureCode.ALREADY_HELD: FailureSpec(_LOGIC, "the object is already in a hand", "it is already in a hand"),
    FailureCode.IN_USE: FailureSpec(
        _LOGIC,
        "the object or receptacle is in use by the other arm, or a hand at a door or drawer keeps the robot there",
        "the other arm uses it, or a hand at a door keeps the robot there",
    ),
    FailureCode.ARM_CONFLICT: FailureSpec(
        _LOGIC, "the two actions of the step exclude each other", "the two actions of the step exclude each other"
    ),
    FailureCode.BOTH_HANDS_BUSY: FailureSpec(_LOGIC, "both hands hold one object", "both hands hold one object"),
    FailureCode.OBSTRUCTED: FailureSpec(
        _LOGIC,
        "in reach, but no pose of the arm gets there without a collision",
        "in reach, but something is in the way of the arm: another stance, height or arm may help",
        ("gap_m",),
    ),
    FailureCode.GRASP_MISSED: FailureSpec(
        _LOGIC, "the fingers closed without touching the object from two sides", "the fingers missed the object", ("gap_m",)
    ),
    FailureCode.TOOL_MISSED: FailureSpec(
        _LOGIC, "the tool or the hand came to rest beside the object", "the tool missed the object", ("gap_m",)
    ),
    FailureCode.POUR_MISSED: FailureSpec(
        _LOGIC, "the liquid went beside the target", "the liquid went beside the target", ("missed_l",)
    ),
    FailureCode.DROPPED: FailureSpec(_LOGIC, "the object was lost on the way", "the object was lost on the way"),
    FailureCode.PLACE_MISSED: FailureSpec(
        _LOGIC,
        "the object did not come to rest on or in the receptacle",
        "the object did not come to rest on or in the receptacle",
        ("gap_m", "tilt_deg"),
    ),
    FailureCode.HANDLE_SLIPPED: FailureSpec(
        _LOGIC, "the hand moved but the door or drawer did not follow", "the door or drawer did not follow the hand", ("gap_m",)
    ),
    FailureCode.OBJECT_BROKEN: FailureSpec(_LOGIC, "the object is broken", "the object is broken"),
    FailureCode.SLIPPED: FailureSpec(
        None, "contingency: the object slipped out of the hand", "by chance: the object slipped out of the hand, try again"
    ),
    FailureCode.BROKE: FailureSpec(None, "contingency: the object fell and broke", "by chance: the object fell and broke"),
    FailureCode.SPILLED: FailureSpec(None, "contingency: the liquid was spilled", "by chance: the liquid was spilled"),
    FailureCode.NOTHING_HAPPENED: FailureSpec(None, "contingency: the action had no effect", "by chance: no effect, try again"),
    FailureCode.LOCKED: FailureSpec(
        None, "contingency: the door or drawer is stuck for the moment", "by chance: stuck for the moment, try again"
    ),
}
