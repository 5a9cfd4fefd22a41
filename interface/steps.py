"""Plan steps and their textual grammar: `Pick(left, Mug_1) & Open(right, Fridge_1)`.

Paper: section on problem formulation (dual-arm action). The textual grammar is left open there and fixed here.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

from interface.actions import ACTIONS, ActionKind, ActionSpec, given_amount
from interface.bodies import Arm

_CALL = re.compile(r"^([A-Za-z]{1,32})\(([^()]{0,160})\)$")
_OBJECT_ID = re.compile(r"^[A-Za-z][A-Za-z0-9_]{0,47}$")


class ActionError(ValueError):
    """A plan step that does not follow the action grammar; the message names the text and what is allowed."""


def _format_amount(value: float) -> str:
    return f"{round(value, 3):g}"


@dataclass(frozen=True, slots=True)
class Action:
    """One action of a plan step.

    Attributes:
        name: a key of `ACTIONS`.
        arm: the arm that acts; required for arm actions, None for all others.
        object_id: target object, or the receptacle for Place and PlaceBoth.
        amount: metres or degrees, see `ActionSpec.amount`; None takes the action's default. GoTo's is the distance between
            pelvis and object.
        bearing_deg: GoTo only, the object's bearing in the heading frame after arrival, positive to the left.

    Raises:
        ActionError: on an unknown name, a missing or superfluous argument, or an amount out of range.
    """

    name: str
    arm: Arm | None = None
    object_id: str | None = None
    amount: float | None = None
    bearing_deg: float | None = None

    def __post_init__(self) -> None:
        spec = ACTIONS.get(self.name)
        if spec is None:
            raise ActionError(f"unknown action {self.name!r}; allowed: {', '.join(ACTIONS)}")
        if (self.arm is not None) != (spec.kind is ActionKind.ARM):
            need = "needs an arm (left or right)" if spec.kind is ActionKind.ARM else "takes no arm"
            raise ActionError(f"{self.name} {need}, got {self.arm!r}")
        if (self.object_id is not None) != spec.takes_object:
            need = "needs an object id" if spec.takes_object else "takes no object"
            raise ActionError(f"{self.name} {need}, got {self.object_id!r}")
        if self.object_id is not None and not _OBJECT_ID.match(self.object_id):
            raise ActionError(f"{self.name}: object id {self.object_id!r} is not of the form Type_1")
        if self.amount is not None:
            if spec.amount is None:
                raise ActionError(f"{self.name} takes no amount, got {self.amount!r}")
            low, high = spec.amount.low, spec.amount.high
            if not low <= self.amount <= high:  # also refuses NaN
                raise ActionError(f"{self.name}: amount {self.amount!r} outside [{low:g}, {high:g}] {spec.amount.unit}")
        if self.bearing_deg is not None and (len(spec.amounts) < 2 or not -180.0 <= self.bearing_deg <= 180.0):
            raise ActionError(f"{self.name}: bearing {self.bearing_deg!r} is for GoTo only, within [-180, 180] deg")

    @property
    def spec(self) -> ActionSpec:
        """Its row of the table of actions."""
        return ACTIONS[self.name]

    @property
    def given_amount(self) -> float:
        """Its amount or the default, metres or degrees; 0 for actions without one."""
        return given_amount(self)

    def to_text(self) -> str:
        """The action in the grammar, for example `Pick(left, Mug_1)`, `MoveDown(0.2)`, `GoTo(Fridge_1, 0.6, 15)`."""
        parts: list[str] = []
        if self.arm is not None:
            parts.append(self.arm.value)
        if self.object_id is not None:
            parts.append(self.object_id)
        if self.amount is not None:
            parts.append(_format_amount(self.amount))
        if self.bearing_deg is not None:
            if self.amount is None:
                parts.append("auto")
            parts.append(_format_amount(self.bearing_deg))
        return f"{self.name}({', '.join(parts)})"

    @staticmethod
    def parse(text: str) -> Action:
        """Reads one action, the inverse of `to_text`.

        Raises:
            ActionError: when the text is not of the grammar; the message quotes it.
        """
        match = _CALL.match(text.strip())
        if match is None:
            raise ActionError(f"not an action: {text[:80]!r}; expected Name(arguments), for example Pick(left, Mug_1)")
        name = match.group(1)
        spec = ACTIONS.get(name)
        if spec is None:
            raise ActionError(f"unknown action {name!r}; allowed: {', '.join(ACTIONS)}")
        parts = [part.strip() for part in match.group(2).split(",")] if match.group(2).strip() else []
        arm: Arm | None = None
        object_id: str | None = None
        if spec.kind is ActionKind.ARM:
            word = parts.pop(0).lower() if parts else ""
            if word not in ("left", "right"):
                raise ActionError(f"{name} needs an arm first (left or right), got {word!r}")
            arm = Arm(word)
        if spec.takes_object:
            if not parts:
                raise ActionError(f"{name} needs an object id, got {text[:80]!r}")
            object_id = parts.pop(0)
        limit = len(spec.amounts)
        if len(parts) > limit:
            raise ActionError(f"{name}: superfluous arguments {parts[limit:]} in {text[:80]!r}")
        numbers: list[float | None] = []
        for part in parts:
            if part == "auto" and limit == 2:
                numbers.append(None)
                continue
            try:
                numbers.append(float(part))
            except ValueError:
                raise ActionError(f"{name}: {part[:40]!r} is not a number in {text[:80]!r}") from None
        amount = numbers[0] if numbers else None
        bearing = numbers[1] if len(numbers) > 1 else None
        return Action(name, arm=arm, object_id=object_id, amount=amount, bearing_deg=bearing)


@dataclass(frozen=True, slots=True)
class PlanStep:
    """One environment step: a body action, a two-arm action, an episode action, or one arm action per arm in parallel.

    Raises:
        ActionError: on no action, more than two, two for the same arm, or a parallel pair that is not two arm actions.
    """

    actions: tuple[Action, ...]

    def __post_init__(self) -> None:
        if len(self.actions) not in (1, 2):
            raise ActionError(f"a plan step has one or two actions, got {len(self.actions)}")
        if len(self.actions) == 2:
            if any(action.spec.kind is not ActionKind.ARM for action in self.actions):
                raise ActionError(f"only arm actions run in parallel, got {self.to_text()!r}")
            if self.actions[0].arm is self.actions[1].arm:
                raise ActionError(f"both actions use the {self.actions[0].arm} arm: {self.to_text()!r}")

    def to_text(self) -> str:
        """The step in the grammar; parallel actions are joined by ` & `."""
        return " & ".join(action.to_text() for action in self.actions)

    @staticmethod
    def parse(text: str) -> PlanStep:
        """Reads a step from text, the inverse of `to_text`.

        Raises:
            ActionError: when the text is not of the grammar.
        """
        return PlanStep(tuple(Action.parse(part) for part in text.strip().split("&")))
