"""Goal predicates over object states: what a task asks for, and how much of it holds.

A goal is a small tree in plain JSON (`Predicate`). It is evaluated on the simulator's metadata only (`World.metadata()`:
AI2-THOR state names), so a goal never depends on how it was reached. Paper: tasks and success of the DualTHOR benchmark;
goal-condition success follows the usual definition (satisfied conditions over all conditions).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, Literal

__all__ = ["KINDS", "Predicate", "PredicateError", "goal_fraction", "goals_hold"]

Kind = Literal["on", "in", "held", "lifted", "open", "closed", "toggled_on", "toggled_off", "and", "or", "not", "count"]

#: Arguments of every predicate kind.
KINDS: Final[Mapping[str, tuple[str, ...]]] = {
    "on": ("object_id", "receptacle_id"),
    "in": ("object_id", "receptacle_id"),
    "held": ("object_id",),
    "lifted": ("object_id",),
    "open": ("object_id",),
    "closed": ("object_id",),
    "toggled_on": ("object_id",),
    "toggled_off": ("object_id",),
    "and": ("of",),
    "or": ("of",),
    "not": ("of",),
    "count": ("of", "at_least"),
}


class PredicateError(ValueError):
    """A predicate that is malformed, or that names an object the scene does not hold."""


@dataclass(frozen=True, slots=True)
class Predicate:
    """One node of a goal.

    Attributes:
        kind: a key of `KINDS`. `on`: the receptacle (anything with a supporting surface) carries the object. `in`: the
            receptacle encloses it (same containment fact, for wording). `held`: some hand holds the object. `lifted`: both
            hands hold it, clear of every receptacle.
        object_id: object the predicate is about, for leaf kinds.
        receptacle_id: receptacle, for `on` and `in`.
        of: operands of `and`, `or`, `not` (one) and `count`.
        at_least: for `count`, how many operands must hold.

    Raises:
        PredicateError: when arguments are missing or superfluous.
    """

    kind: Kind
    object_id: str = ""
    receptacle_id: str = ""
    of: tuple[Predicate, ...] = ()
    at_least: int = 0

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise PredicateError(f"unknown predicate {self.kind!r}; allowed: {', '.join(KINDS)}")
        needed = KINDS[self.kind]
        for name in ("object_id", "receptacle_id", "of", "at_least"):
            if bool(getattr(self, name)) != (name in needed):
                need = "needs" if name in needed else "takes no"
                raise PredicateError(f"{self.kind} {need} {name}, got {getattr(self, name)!r}; takes: {', '.join(needed)}")
        if self.kind == "not" and len(self.of) != 1:
            raise PredicateError(f"not takes one operand, got {len(self.of)}")
        if self.kind == "count" and not 0 < self.at_least <= len(self.of):
            raise PredicateError(f"count: at_least {self.at_least} outside 1..{len(self.of)}")

    def object_ids(self) -> tuple[str, ...]:
        """Every object and receptacle that the predicate names, in order, without repeats."""
        names = [name for name in (self.object_id, self.receptacle_id) if name]
        for operand in self.of:
            names.extend(operand.object_ids())
        return tuple(dict.fromkeys(names))

    def holds(self, metadata: Mapping[str, Any]) -> bool:
        """Whether the predicate is true in `World.metadata()`.

        Raises:
            PredicateError: when it names an object that the metadata does not list.
        """
        return self._holds({entry["objectId"]: entry for entry in metadata["objects"]})

    def _holds(self, objects: Mapping[str, Mapping[str, Any]]) -> bool:
        if self.kind in ("and", "or", "not", "count"):
            values = [operand._holds(objects) for operand in self.of]
            if self.kind == "and":
                return all(values)
            if self.kind == "or":
                return any(values)
            if self.kind == "not":
                return not values[0]
            return sum(values) >= self.at_least
        entry = objects.get(self.object_id)
        if entry is None:
            raise PredicateError(f"{self.kind}: no object {self.object_id!r} in the scene; it has {', '.join(sorted(objects))}")
        if self.kind in ("on", "in"):
            if self.receptacle_id not in objects:
                raise PredicateError(f"{self.kind}: no receptacle {self.receptacle_id!r} in the scene")
            return not entry["isPickedUp"] and self.receptacle_id in (entry["parentReceptacles"] or ())
        if self.kind == "held":
            return bool(entry["isPickedUp"])
        if self.kind == "lifted":
            return len(entry["heldBy"]) == 2 and not entry["parentReceptacles"]
        if self.kind == "open":
            return bool(entry["isOpen"])
        if self.kind == "closed":
            return not entry["isOpen"]
        return bool(entry["isToggled"]) == (self.kind == "toggled_on")

    def to_json(self) -> dict[str, Any]:
        """Plain form with only the arguments that the kind takes, in a fixed order."""
        record: dict[str, Any] = {"kind": self.kind}
        for name in KINDS[self.kind]:
            value = getattr(self, name)
            record[name] = [operand.to_json() for operand in value] if name == "of" else value
        return record


def goals_hold(goals: Sequence[Predicate], metadata: Mapping[str, Any]) -> bool:
    """Whether every goal holds."""
    return all(_evaluate(goals, metadata))


def goal_fraction(goals: Sequence[Predicate], metadata: Mapping[str, Any]) -> float:
    """Goal-condition success: satisfied goals over all goals, in [0, 1]."""
    values = _evaluate(goals, metadata)
    return sum(values) / len(values)


def _evaluate(goals: Iterable[Predicate], metadata: Mapping[str, Any]) -> list[bool]:
    objects = {entry["objectId"]: entry for entry in metadata["objects"]}
    return [goal._holds(objects) for goal in goals]
