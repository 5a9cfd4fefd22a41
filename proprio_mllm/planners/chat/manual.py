"""What every prompt tells of robot, actions and failure codes; the grammar's part is made from the grammar's own table.

Paper: baselines, prompt contents (robot type, action space). The paper gives its prompts in part; the wording here is ours.
"""

from __future__ import annotations

from typing import Final

from data.interface.actions import ACTIONS, ActionKind, ActionSpec
from data.robot_facts import robot_facts

__all__ = ["CODES", "DESCRIPTIONS", "action_manual", "code_manual", "role"]

#: What each action does; a test holds this against the grammar.
DESCRIPTIONS: Final = {
    "GoTo": "walk to a known object or piece of furniture; the distance to it and its bearing on arrival may be left out",
    "MoveAhead": "walk forward",
    "MoveBack": "walk backward",
    "MoveLeft": "step to the left",
    "MoveRight": "step to the right",
    "RotateLeft": "turn to the left, the view turns too",
    "RotateRight": "turn to the right, the view turns too",
    "MoveUp": "raise the pelvis by stretching the legs",
    "MoveDown": "lower the pelvis by bending the legs",
    "Pick": "take an object into the empty hand",
    "Place": "put what the hand holds on or in a receptacle",
    "Open": "open a door, drawer, lid or the like",
    "Close": "close it",
    "ToggleOn": "switch a thing on",
    "ToggleOff": "switch it off",
    "Hold": "steady an object with the empty hand while the other one works on it",
    "Release": "let go of what the hand steadies or holds",
    "Slice": "cut an object with the knife in the hand; what would roll away needs the other hand to Hold it",
    "Clean": "wipe a dirty object with the sponge or towel in the hand",
    "UseUp": "use an object up",
    "Pour": "pour what the vessel in the hand holds into the target",
    "Fill": "hold the vessel in the hand under a running source, the target, and fill it",
    "ResetArm": "bring the arm back to rest",
    "Lift": "lift an object that is too big for one hand with both; both have to be empty",
    "PlaceBoth": "put what both hands hold on a receptacle",
    "Done": "end the task; only when it is done",
}
#: What each failure code means; a test holds this against the simulator's own table.
CODES: Final = {
    "TooFar": "out of reach from here at any body height: go nearer or to another side",
    "BlockedPath": "furniture or a wall is in the way",
    "NoFreePose": "the robot cannot stand there as asked",
    "BodyTooHigh": "lower the body",
    "BodyTooLow": "raise the body",
    "HeightLimit": "the legs are at the end of their range, or an arm touches something",
    "ObjectNotKnown": "nothing of that name has been seen yet",
    "HandOccupied": "the hand already holds something",
    "HandEmpty": "the hand holds nothing",
    "NotPickupable": "it cannot be picked up",
    "NeedsTwoHands": "too big for one hand: Lift it",
    "NotLiftable": "it cannot be lifted with two hands",
    "TooHeavy": "more than the arms carry",
    "NotOpenable": "it has nothing that opens",
    "NotToggleable": "it has no switch",
    "NotReceptacle": "nothing can be put on or in it",
    "ReceptacleClosed": "it is closed: open it first",
    "ReceptacleFull": "there is no free spot on or in it",
    "NotSliceable": "it cannot be sliced",
    "NotDirty": "it is clean",
    "NotUsable": "there is nothing to use up",
    "NotFillable": "it holds no liquid, or gives none",
    "NeedsTool": "the hand does not hold the knife, sponge, towel or vessel that this takes",
    "NeedsSteadying": "it would slide away: Hold it with the other hand in the same step or before",
    "Empty": "the vessel is empty",
    "SourceOff": "nothing comes out of the source: switch it on",
    "AlreadyInState": "it already is as the action makes it",
    "AlreadyHeld": "it is already in a hand",
    "InUse": "the other arm uses it, or a hand at a door keeps the robot there",
    "ArmConflict": "the two actions of the step exclude each other",
    "BothHandsBusy": "both hands hold one object",
    "Obstructed": "in reach, but something is in the way of the arm: another stance, height or arm may help",
    "GraspMissed": "the fingers missed the object",
    "ToolMissed": "the tool missed the object",
    "PourMissed": "the liquid went beside the target",
    "Dropped": "the object was lost on the way",
    "PlaceMissed": "the object did not come to rest on or in the receptacle",
    "HandleSlipped": "the door or drawer did not follow the hand",
    "ObjectBroken": "the object is broken",
    "Slipped": "bad luck: the object slipped out of the hand, try again",
    "Broke": "bad luck: the object fell and broke",
    "Spilled": "bad luck: the liquid was spilled",
    "NothingHappened": "bad luck: no effect, try again",
    "Locked": "bad luck: stuck for the moment, try again",
    "InvalidOutput": "the reply was not an action of the grammar",
}
_UNITS: Final = {"m": "metres", "deg": "degrees"}


def role(robot: str) -> str:
    """Who the model is: the robot's body in numbers."""
    facts = robot_facts(robot)
    low, high = facts.pelvis_height_m
    down, up = facts.reach_height_m
    return (
        f"You plan the steps of a household robot, the dual-arm humanoid {facts.name.upper()}. It has a left and a right arm "
        f"of {facts.arm_joints} joints and {facts.arm_length_m:g} m each, with a {facts.hand} at the end, and a camera in its "
        f"head. By bending its legs it moves its pelvis between {low:g} and {high:g} m above the floor; its hands then reach "
        f"from {down:.2g} to {up:.2g} m up. An arm carries {facts.arm_load_kg:g} kg, both {facts.two_arm_load_kg:g} kg."
    )


def action_manual() -> str:
    """The action grammar, one line per action."""
    lines = [
        "A step is one action, or two arm actions joined by ' & ', one for each arm, which then work at the same time, for "
        "example: Pick(left, Mug_1) & Open(right, Fridge_1)",
        "Actions:",
        *(f"- {_signature(spec)}: {DESCRIPTIONS[name]}" for name, spec in ACTIONS.items()),
        "arm is left or right; object is an id as listed in the message, such as Mug_1.",
    ]
    return "\n".join(lines)


def _signature(spec: ActionSpec) -> str:
    arguments = ["arm"] if spec.kind is ActionKind.ARM else []
    arguments += ["object"] if spec.takes_object else []
    if spec.amount_unit is not None:
        low, high = spec.amount_range
        arguments.append(f"[{_UNITS[spec.amount_unit]} {low:g} to {high:g}]")
    if spec.name == "GoTo":
        arguments.append("[bearing -180 to 180 degrees, left positive]")
    return f"{spec.name}({', '.join(arguments)})"


def code_manual() -> str:
    """What the failure codes of the log mean."""
    return "Each action of the log ends with ok or a failure code:\n" + "\n".join(f"- {c}: {t}" for c, t in CODES.items())
