"""Goal predicates over object states: what a task asks for.

A goal is a small tree in plain JSON (`Predicate`). It is evaluated on the facts of a world alone, so it never depends on how it
was reached. Paper: tasks and success of the DualTHOR benchmark.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any, Final, Literal

from interface.facts import ObjectFacts

Kind = Literal[
    "on", "in", "held", "lifted", "open", "closed", "toggled_on", "toggled_off", "filled", "sliced", "cooked", "clean",
    "used_up", "and", "or", "not", "count", "exists",
]  # fmt: skip

#: Stands for the object in the operand of `exists`.
ANY: Final = "$"

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
    "filled": ("object_id",),
    "sliced": ("object_id",),
    "cooked": ("object_id",),
    "clean": ("object_id",),
    "used_up": ("object_id",),
    "and": ("of",),
    "or": ("of",),
    "not": ("of",),
    "count": ("of", "at_least"),
    "exists": ("object_type", "of", "at_least"),
}

#: What a leaf about one object asks for, by kind.
_STATES: Final[Mapping[str, Callable[[ObjectFacts], bool]]] = {
    "held": lambda item: item.picked_up,
    "lifted": lambda item: len(item.holders) == 2 and not item.carriers,
    "open": lambda item: item.open,
    "closed": lambda item: not item.open,
    "toggled_on": lambda item: item.on is True,
    "toggled_off": lambda item: item.on is False,
    "filled": lambda item: item.filled,
    "sliced": lambda item: item.sliced,
    "cooked": lambda item: item.cooked,
    "clean": lambda item: not item.dirty,
    "used_up": lambda item: item.used_up,
}


class PredicateError(ValueError):
    """A predicate that is malformed, or that names an object the scene does not hold."""


@dataclass(frozen=True, slots=True)
class Predicate:
    """One node of a goal.

    Attributes:
        kind: a key of `KINDS`. `on`: the receptacle (anything with a supporting surface) carries the object. `in`: the
            receptacle encloses it (same containment fact, for wording). `held`: some hand holds the object. `lifted`: both
            hands hold it, clear of every receptacle. `exists`: the operand, with `$` in place of an object, is true of
            `at_least` many objects of the type.
        object_id: object the predicate is about, for leaf kinds.
        receptacle_id: receptacle, for `on` and `in`.
        object_type: for `exists`, the objects that count.
        of: operands of `and`, `or`, `not` (one), `count` and `exists` (one).
        at_least: for `count`, how many operands must hold; for `exists`, how many objects.

    Raises:
        PredicateError: when arguments are missing or superfluous.
    """

    kind: Kind
    object_id: str = ""
    receptacle_id: str = ""
    object_type: str = ""
    of: tuple[Predicate, ...] = ()
    at_least: int = 0

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise PredicateError(f"unknown predicate {self.kind!r}; allowed: {', '.join(KINDS)}")
        needed = KINDS[self.kind]
        for name in ("object_id", "receptacle_id", "object_type", "of", "at_least"):
            if bool(getattr(self, name)) != (name in needed):
                need = "needs" if name in needed else "takes no"
                raise PredicateError(f"{self.kind} {need} {name}, got {getattr(self, name)!r}; takes: {', '.join(needed)}")
        if self.kind in ("not", "exists") and len(self.of) != 1:
            raise PredicateError(f"{self.kind} takes one operand, got {len(self.of)}")
        if self.kind == "exists" and (self.at_least < 1 or not self.of[0]._is_open()):
            raise PredicateError(f"exists needs at_least of 1 or more and {ANY!r} in its operand, got {self.to_json()}")
        if self.kind == "count" and not 0 < self.at_least <= len(self.of):
            raise PredicateError(f"count: at_least {self.at_least} outside 1..{len(self.of)}")

    def object_ids(self) -> tuple[str, ...]:
        """Every object and receptacle that the predicate names, in order, without repeats; `$` is none."""
        names = [name for name in (self.object_id, self.receptacle_id) if name not in ("", ANY)]
        for operand in self.of:
            names.extend(operand.object_ids())
        return tuple(dict.fromkeys(names))

    def involved(self, object_ids: Iterable[str]) -> tuple[str, ...]:
        """As `object_ids`, with all objects that an `exists` may mean."""
        known = tuple(object_ids)
        operands = self.candidates(known) if self.kind == "exists" else self.of
        return tuple(dict.fromkeys((*self.object_ids(), *(name for one in operands for name in one.involved(known)))))

    def _is_open(self) -> bool:
        """Whether `$` occurs in it."""
        return ANY in (self.object_id, self.receptacle_id) or any(operand._is_open() for operand in self.of)

    def about(self, object_id: str) -> Predicate:
        """The predicate with an object in the place of `$`."""
        names = {key: object_id if getattr(self, key) == ANY else getattr(self, key) for key in ("object_id", "receptacle_id")}
        return replace(self, **names, of=tuple(operand.about(object_id) for operand in self.of))

    def candidates(self, object_ids: Iterable[str]) -> tuple[Predicate, ...]:
        """For `exists`, its operand about every object of the type, in the order of the ids."""
        names = sorted(
            (name for name in object_ids if name.rsplit("_", 1)[0] == self.object_type),
            key=lambda name: int(name.rsplit("_", 1)[1]),
        )
        return tuple(self.of[0].about(name) for name in names)

    def holds(self, objects: Mapping[str, ObjectFacts]) -> bool:
        """Whether the predicate is true of a world's objects.

        Raises:
            PredicateError: when it names an object that is not among them.
        """
        if self.kind in ("and", "or", "not", "count"):
            values = [operand.holds(objects) for operand in self.of]
            if self.kind == "and":
                return all(values)
            if self.kind == "or":
                return any(values)
            if self.kind == "not":
                return not values[0]
            return sum(values) >= self.at_least
        if self.kind == "exists":
            return sum(operand.holds(objects) for operand in self.candidates(objects)) >= self.at_least
        if self.object_id not in objects:
            raise PredicateError(f"{self.kind}: no object {self.object_id!r} in the scene; it has {', '.join(sorted(objects))}")
        item = objects[self.object_id]
        if self.kind not in ("on", "in"):
            return _STATES[self.kind](item)
        if self.receptacle_id not in objects:
            raise PredicateError(f"{self.kind}: no receptacle {self.receptacle_id!r} in the scene")
        return not item.picked_up and self.receptacle_id in item.carriers

    def to_text(self) -> str:
        """For people: `on(Mug_1, Table_1)`, `and(open(Fridge_1), held(Mug_1))`, `count(…, at_least=2)`."""
        parts: list[str] = []
        for name in KINDS[self.kind]:
            value = getattr(self, name)
            if name == "of":
                parts += [operand.to_text() for operand in value]
            else:
                parts.append(f"at_least={value}" if name == "at_least" else value)
        return f"{self.kind}({', '.join(parts)})"

    def to_json(self) -> dict[str, Any]:
        """Plain form with only the arguments that the kind takes, in a fixed order."""
        record: dict[str, Any] = {"kind": self.kind}
        for name in KINDS[self.kind]:
            value = getattr(self, name)
            record[name] = [operand.to_json() for operand in value] if name == "of" else value
        return record
