"""The action grammar and the failure codes in words, as every prompt tells them; made from the tables themselves.

Paper: prompt contents (action space). The paper gives its prompts in part; the wording is ours.
"""

from __future__ import annotations

from typing import Final

from interface.actions import ACTIONS, ActionKind, ActionSpec
from interface.failures import FAILURES, INVALID_OUTPUT

_UNITS: Final = {"m": "metres", "deg": "degrees"}


def action_manual() -> str:
    """The action grammar, one line per action."""
    lines = [
        "A step is one action, or two arm actions joined by ' & ', one for each arm, which then work at the same time, for "
        "example: Pick(left, Mug_1) & Open(right, Fridge_1)",
        "Actions:",
        *(f"- {_signature(spec)}: {spec.meaning}" for spec in ACTIONS.values()),
        "arm is left or right; object is an id as listed in the message, such as Mug_1.",
    ]
    return "\n".join(lines)


def code_manual() -> str:
    """What the failure codes of the log mean."""
    lines = [f"- {code.value}: {spec.advice}" for code, spec in FAILURES.items()]
    lines.append(f"- {INVALID_OUTPUT}: the reply was not an action of the grammar")
    return "\n".join(["Each action of the log ends with ok or a failure code:", *lines])


def _signature(spec: ActionSpec) -> str:
    arguments = ["arm"] if spec.kind is ActionKind.ARM else []
    arguments += ["object"] if spec.takes_object else []
    for amount in spec.amounts:
        unit = _UNITS[amount.unit]
        if amount.name == "bearing":
            arguments.append(f"[bearing {amount.low:g} to {amount.high:g} {unit}, left positive]")
        else:
            arguments.append(f"[{unit} {amount.low:g} to {amount.high:g}]")
    return f"{spec.name}({', '.join(arguments)})"
