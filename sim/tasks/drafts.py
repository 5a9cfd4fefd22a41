"""Task families: what each one puts into a room and asks for, before positions are settled.

A draft says which objects stand on what and which predicates must hold; positions, start poses and step budgets come later (see
`sim.tasks.sample`). Benchmark and training tasks are drawn by the same functions, so they differ in draws only, never in kind.

Categories follow the paper. `single`: one arm is enough. `optional`: one arm can, two are faster. `essential`: one arm cannot,
here because an object needs two hands (`lift`, `carry` and their combinations) or because two objects have to be in the hands
at once (`hold_two`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from sim.tasks.instructions import phrase, preposition, shuffled, wordings
from sim.tasks.predicates import Predicate

__all__ = ["FAMILIES", "Draft", "NoDraft", "Scene", "category_of", "draw"]

#: Families of each category.
FAMILIES: Final[Mapping[str, tuple[str, ...]]] = {
    "single": ("pick", "place", "open", "close", "toggle_on", "toggle_off"),
    "optional": (
        "transport_two",
        "transport_each",
        "pick_and_toggle_on",
        "pick_and_toggle_off",
        "pick_and_open",
        "fetch",
        "fetch_hold",
        "stow",
        "stow_close",
    ),
    "essential": ("lift", "carry", "hold_two", "carry_and_toggle", "carry_and_place"),
}


#: Start states that make a type a load for two hands: a full pot, a packed box.
_LOADS: Final[Mapping[str, Mapping[str, bool | float | str]]] = {"Pot": {"isFilledWithLiquid": True}, "Box": {"mass": 3.0}}


class NoDraft(ValueError):  # noqa: N818 - it reports a draw that a room cannot offer
    """The room does not hold what a family needs; the message names both."""


@dataclass(frozen=True, slots=True)
class Scene:
    """What a room offers to tasks.

    Attributes:
        room: name of the layout.
        furniture: ids of the room's own objects.
        surfaces: furniture on which small objects can stand at the start.
        targets: surfaces with room for hands, onto which tasks move things.
        containers: furniture with a door or drawer that holds small objects.
        switches: furniture that can be turned on and off.
        small: types that one hand picks up, with the furniture of `surfaces` and `containers` that fits them.
        big: types that take two hands, with the furniture that carries them.
    """

    room: str
    furniture: tuple[str, ...]
    surfaces: tuple[str, ...]
    targets: tuple[str, ...]
    containers: tuple[str, ...]
    switches: tuple[str, ...]
    small: Mapping[str, tuple[str, ...]]
    big: Mapping[str, tuple[str, ...]]


@dataclass(slots=True)
class Draft:
    """A task without positions.

    Attributes:
        family: a name of `FAMILIES`.
        room: name of the layout.
        objects: carrier by object id, in the order of placing.
        object_states: start state by object id.
        states: start state of furniture by id.
        goals: what must hold.
        focus: the ids that the instruction names, by slot (`a`, `b`, `r`, `s`).
    """

    family: str
    room: str
    objects: dict[str, str] = field(default_factory=dict)
    object_states: dict[str, dict[str, bool | float | str]] = field(default_factory=dict)
    states: dict[str, dict[str, bool | float | str]] = field(default_factory=dict)
    goals: list[Predicate] = field(default_factory=list)
    focus: dict[str, str] = field(default_factory=dict)

    def sentences(self, furniture: Sequence[str], rng: np.random.Generator, hidden: Sequence[str] = ()) -> tuple[str, ...]:
        """The family's wordings for this draft, in random order.

        Args:
            furniture: ids of the room's own objects.
            rng: order of the sentences.
            hidden: objects that the robot does not see at the start, so that the instruction has to say where they are.
        """
        own = frozenset(furniture)
        scene: dict[str, str | None] = dict.fromkeys(furniture) | dict(self.objects)
        named = set(self.focus.values())
        slots = {
            slot: phrase(object_id, scene, own, located=object_id in hidden and scene[object_id] not in named)
            for slot, object_id in self.focus.items()
        }
        for slot, word in (("r", "pr"), ("s", "ps")):
            if slot in self.focus:
                slots[word] = preposition(self.focus[slot])
        return shuffled(wordings(self.family, slots), rng)


def category_of(family: str) -> str:
    """The category a family belongs to.

    Raises:
        KeyError: on an unknown family.
    """
    for category, families in FAMILIES.items():
        if family in families:
            return category
    raise KeyError(f"unknown family {family!r}; allowed: {', '.join(name for names in FAMILIES.values() for name in names)}")


def draw(family: str, scene: Scene, rng: np.random.Generator, distractors: tuple[int, int] = (1, 4)) -> Draft:
    """Draws a task of a family in a room.

    Args:
        family: a name of `FAMILIES`.
        scene: the room.
        rng: source of randomness.
        distractors: least and greatest number of objects that the task does not need.

    Raises:
        NoDraft: when the room lacks what the family needs.
    """
    category_of(family)
    builder = _Builder(Draft(family, scene.room), scene, rng)
    _FAMILY_BUILDERS[family](builder)
    builder.add_distractors(int(rng.integers(distractors[0], distractors[1] + 1)))
    return builder.draft


@dataclass(slots=True)
class _Builder:
    draft: Draft
    scene: Scene
    rng: np.random.Generator

    def choose(self, options: Sequence[str], what: str) -> str:
        if not options:
            raise NoDraft(f"{self.scene.room} has no {what} for {self.draft.family}")
        return options[int(self.rng.integers(len(options)))]

    def add(self, object_type: str, carrier: str) -> str:
        number = 1 + sum(
            object_id.rsplit("_", 1)[0] == object_type for object_id in (*self.draft.objects, *self.scene.furniture)
        )
        object_id = f"{object_type}_{number}"
        self.draft.objects[object_id] = carrier
        return object_id

    def unused(self, table: Mapping[str, tuple[str, ...]], *needed: str) -> list[str]:
        """Types not yet in the room that fit all of the needed furniture and at least one surface."""
        present = {object_id.rsplit("_", 1)[0] for object_id in (*self.draft.objects, *self.scene.furniture)}
        return [
            object_type
            for object_type, fits in table.items()
            if object_type not in present and all(place in fits for place in needed) and set(fits) & set(self.scene.surfaces)
        ]

    def small(self, *needed: str, at: str = "", avoid: Sequence[str] = ()) -> str:
        """Adds a new small object that fits `needed`, at `at` or on a random surface other than `avoid`."""
        object_type = self.choose(self.unused(self.scene.small, *needed, *((at,) if at else ())), "fitting small object")
        fits = self.scene.small[object_type]
        place = at or self.choose([s for s in self.scene.surfaces if s in fits and s not in avoid], "free surface")
        return self.add(object_type, place)

    def big(self, target: str = "") -> str:
        """Adds a new two-handed object that can be carried to `target`, on other furniture."""
        object_type = self.choose(self.unused(self.scene.big, *((target,) if target else ())), "two-handed object")
        place = self.choose([s for s in self.scene.big[object_type] if s != target], "furniture for a two-handed object")
        object_id = self.add(object_type, place)
        if object_type in _LOADS:
            self.draft.object_states[object_id] = dict(_LOADS[object_type])
        return object_id

    def big_target(self) -> str:
        """Furniture that a two-handed object can be carried to from elsewhere."""
        options = sorted({place for fits in self.scene.big.values() if len(fits) > 1 for place in fits})
        return self.choose(options, "furniture for a two-handed object")

    def switch(self, on: bool, avoid: Sequence[str] = ()) -> str:
        switch = self.choose([s for s in self.scene.switches if s not in avoid], "switch")
        self.draft.states.setdefault(switch, {})["isToggled"] = on
        return switch

    def container(self, is_open: bool) -> str:
        container = self.choose(self.scene.containers, "container")
        self.draft.states.setdefault(container, {})["isOpen"] = is_open
        return container

    def ask(self, *goals: Predicate, **focus: str) -> None:
        self.draft.goals.extend(goals)
        self.draft.focus.update(focus)

    def add_distractors(self, count: int) -> None:
        for _ in range(count):
            options = self.unused(self.scene.small)
            if not options:
                return
            object_type = self.choose(options, "distractor")
            crowd = list(self.draft.objects.values())
            places = [s for s in self.scene.surfaces if s in self.scene.small[object_type] and crowd.count(s) < 3]
            if places:
                self.add(object_type, self.choose(places, "free surface"))


def _located(object_id: str, receptacle: str) -> Predicate:
    return Predicate(preposition(receptacle), object_id, receptacle)  # type: ignore[arg-type]


def _pick(b: _Builder) -> None:
    a = b.small()
    b.ask(Predicate("held", a), a=a)


def _place(b: _Builder) -> None:
    r = b.choose(b.scene.targets, "surface")
    a = b.small(r, avoid=(r,))
    b.ask(_located(a, r), a=a, r=r)


def _open(b: _Builder) -> None:
    a = b.container(is_open=False)
    b.small()
    b.ask(Predicate("open", a), a=a)


def _close(b: _Builder) -> None:
    a = b.container(is_open=True)
    b.small()
    b.ask(Predicate("closed", a), a=a)


def _toggle_on(b: _Builder) -> None:
    a = b.switch(on=False)
    b.small()
    b.ask(Predicate("toggled_on", a), a=a)


def _toggle_off(b: _Builder) -> None:
    a = b.switch(on=True)
    b.small()
    b.ask(Predicate("toggled_off", a), a=a)


def _transport_two(b: _Builder) -> None:
    r = b.choose(b.scene.targets, "surface")
    a = b.small(r, avoid=(r,))
    # Half of the time both stand together, so that both hands can reach at once.
    source = b.draft.objects[a]
    c = b.small(r, at=source) if b.rng.random() < 0.5 else b.small(r, avoid=(r,))
    b.ask(_located(a, r), _located(c, r), a=a, b=c, r=r)


def _transport_each(b: _Builder) -> None:
    r = b.choose(b.scene.targets, "surface")
    s = b.choose([place for place in b.scene.targets if place != r], "second surface")
    a = b.small(r, avoid=(r, s))
    c = b.small(s, avoid=(r, s))
    b.ask(_located(a, r), _located(c, s), a=a, b=c, r=r, s=s)


def _pick_and_toggle(on: bool) -> Callable[[_Builder], None]:
    def build(b: _Builder) -> None:
        a = b.small()
        switch = b.switch(on=not on)
        b.ask(Predicate("held", a), Predicate("toggled_on" if on else "toggled_off", switch), a=a, b=switch)

    return build


def _pick_and_open(b: _Builder) -> None:
    a = b.small()
    c = b.container(is_open=False)
    b.ask(Predicate("held", a), Predicate("open", c), a=a, b=c)


def _fetch(b: _Builder) -> None:
    s = b.container(is_open=False)
    r = b.choose(b.scene.targets, "surface")
    a = b.small(r, at=s)
    b.ask(_located(a, r), a=a, r=r, s=s)


def _fetch_hold(b: _Builder) -> None:
    s = b.container(is_open=False)
    a = b.small(at=s)
    b.ask(Predicate("held", a), a=a, s=s)


def _stow(b: _Builder) -> None:
    r = b.container(is_open=False)
    a = b.small(r)
    b.ask(_located(a, r), a=a, r=r)


def _stow_close(b: _Builder) -> None:
    _stow(b)
    b.ask(Predicate("closed", b.draft.focus["r"]))


def _lift(b: _Builder) -> None:
    a = b.big()
    b.small()
    b.ask(Predicate("lifted", a), a=a)


def _carry(b: _Builder) -> None:
    r = b.big_target()
    a = b.big(r)
    b.ask(_located(a, r), a=a, r=r)


def _hold_two(b: _Builder) -> None:
    a = b.small()
    c = b.small(at=b.draft.objects[a]) if b.rng.random() < 0.5 else b.small()
    b.ask(Predicate("held", a), Predicate("held", c), a=a, b=c)


def _carry_and_toggle(b: _Builder) -> None:
    _carry(b)
    switch = b.switch(on=False)
    b.ask(Predicate("toggled_on", switch), b=switch)


def _carry_and_place(b: _Builder) -> None:
    _carry(b)
    r = b.draft.focus["r"]
    s = b.choose([place for place in b.scene.targets if place != r], "second surface")
    c = b.small(s, avoid=(s,))
    b.ask(_located(c, s), b=c, s=s)


_FAMILY_BUILDERS: Final[Mapping[str, Callable[[_Builder], None]]] = {
    "pick": _pick,
    "place": _place,
    "open": _open,
    "close": _close,
    "toggle_on": _toggle_on,
    "toggle_off": _toggle_off,
    "transport_two": _transport_two,
    "transport_each": _transport_each,
    "pick_and_toggle_on": _pick_and_toggle(on=True),
    "pick_and_toggle_off": _pick_and_toggle(on=False),
    "pick_and_open": _pick_and_open,
    "fetch": _fetch,
    "fetch_hold": _fetch_hold,
    "stow": _stow,
    "stow_close": _stow_close,
    "lift": _lift,
    "carry": _carry,
    "hold_two": _hold_two,
    "carry_and_toggle": _carry_and_toggle,
    "carry_and_place": _carry_and_place,
}
