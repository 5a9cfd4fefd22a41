"""Other simulators' action names: AI2-THOR's and DualTHOR's, mapped onto the action grammar of `interface.steps`.

Units follow the names' origin. DualTHOR: `moveahead` with magnitude 1 is 1 m, `moveup` 0.1 m, `rotateright` 90 degrees.
AI2-THOR: `moveMagnitude` in metres, `degrees` for rotations. Episode control (undo, save, teleport ...) is not part of the
grammar and is handled by `sim.interfaces.controller`.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

import numpy as np

from configs.validate import allowed_values
from interface.actions import ACTIONS, ActionKind
from interface.bodies import Arm
from interface.steps import Action

#: Foreign names (lower case) of actions of the grammar.
ALIASES: Final[Mapping[str, str]] = {
    "pickupobject": "Pick",
    "putobject": "Place",
    "openobject": "Open",
    "closeobject": "Close",
    "toggleobjecton": "ToggleOn",
    "toggleobjectoff": "ToggleOff",
    "liftobject": "Lift",
    "sliceobject": "Slice",
    "cleanobject": "Clean",
    "useupobject": "UseUp",
    "pourliquid": "Pour",
    "emptyliquidfromobject": "Pour",
    "fillobjectwithliquid": "Fill",
    "holdobject": "Hold",
    "dropheldobject": "Release",
    "releaseobject": "Release",
    "resetjoint": "ResetArm",
    "resetpose": "ResetArm",
} | {name.lower(): name for name in ACTIONS}

#: Arguments that an action call may carry, with their meaning.
ARGUMENTS: Final[Mapping[str, str]] = {
    "objectId": "target object; the receptacle for Place and PlaceBoth",
    "objectID": "DualTHOR's spelling of objectId",
    "container": "DualTHOR: the receptacle of place",
    "receptacleObjectId": "AI2-THOR: the receptacle of PutObject",
    "arm": "left or right",
    "magnitude": "DualTHOR: multiples of 1 m, 0.1 m or 90 degrees",
    "moveMagnitude": "AI2-THOR: metres",
    "degrees": "AI2-THOR: degrees of a rotation",
    "amount": "metres or degrees, whichever the action takes",
    "bearing": "GoTo: degrees of the object's bearing after arrival, positive to the left",
}

_MAGNITUDE_UNIT: Final[Mapping[str, float]] = {
    "MoveAhead": 1.0,
    "MoveBack": 1.0,
    "MoveLeft": 1.0,
    "MoveRight": 1.0,
    "MoveUp": 0.1,
    "MoveDown": 0.1,
    "RotateLeft": 90.0,
    "RotateRight": 90.0,
}


def number(action: str, key: str, value: Any) -> float:
    """A finite number of a call.

    Raises:
        ValueError: on anything else, naming the action, the argument and the value.
    """
    if isinstance(value, bool) or not isinstance(value, int | float | np.integer | np.floating):
        raise ValueError(f"{action}: {key} must be a number, got {str(value)[:80]!r}")
    try:
        found = float(value)
    except OverflowError:
        found = float("inf")
    if not np.isfinite(found):
        raise ValueError(f"{action}: {key} must be a finite number, got {str(value)[:80]}")
    return found


def to_action(name: str, arguments: Mapping[str, Any]) -> Action:
    """Translates one call into an action of the grammar.

    Args:
        name: any name of `ALIASES`, in any case.
        arguments: arguments by the names of `ARGUMENTS`.

    Raises:
        ValueError: on an unknown action or argument, or an argument that the action does not take (as `ActionError`).
    """
    target = ALIASES.get(name.lower())
    if target is None:
        raise ValueError(f"unknown action {name!r}; {allowed_values(name.lower(), sorted(set(ALIASES)))}")
    unknown = sorted(map(str, set(arguments) - set(ARGUMENTS)))
    if unknown:
        raise ValueError(f"{name}: unknown arguments {unknown}; allowed: {', '.join(ARGUMENTS)}")
    spec = ACTIONS[target]
    arm: Arm | None = None
    if spec.kind is ActionKind.ARM:
        word = str(arguments.get("arm", "right")).lower()
        if word not in ("left", "right"):
            raise ValueError(f"{name}: arm {arguments.get('arm')!r} is not left or right")
        arm = Arm(word)
    object_id: str | None = None
    if spec.takes_object:
        keys = ("container", "receptacleObjectId", "objectId", "objectID") if target.startswith("Place") else ()
        keys = keys or ("objectId", "objectID")
        object_id = next((str(arguments[key]) for key in keys if arguments.get(key)), None)
    amount: float | None = None
    if spec.amount is not None:
        if "magnitude" in arguments:
            amount = number(name, "magnitude", arguments["magnitude"]) * _MAGNITUDE_UNIT.get(target, 1.0)
        for key in ("moveMagnitude", "degrees", "amount"):
            if key in arguments:
                amount = number(name, key, arguments[key])
    bearing = number(name, "bearing", arguments["bearing"]) if target == "GoTo" and "bearing" in arguments else None
    return Action(target, arm=arm, object_id=object_id, amount=amount, bearing_deg=bearing)
