"""Drafts: what a task puts into a room and asks for, before positions are settled.

A draft says which objects stand on what and which predicates must hold; positions, start poses and time limits come later (see
`sim.tasks.sample`). The families that fill drafts are in `sim.tasks.families`. Benchmark and training tasks are drawn by the
same functions, so they differ in draws only, never in kind. Paper: the DualTHOR task suite.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from sim.tasks.instructions import phrase, preposition, shuffled, wordings
from sim.tasks.predicates import Predicate

#: Start states that make a type a load for two hands: a full pot, a packed box.
_LOADS: Final[Mapping[str, Mapping[str, bool | float | str]]] = {
    "Pot": {"isFilledWithLiquid": True},
    "Box": {"mass": 3.0},
    "LaundryHamper": {"mass": 3.0},
}


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
        small: types that one hand picks up, with the furniture of `surfaces`, `targets` and `containers` that fits them.
        big: types that take two hands, with the furniture that carries them.
        lids: furniture with a lid.
        basins: basins with a tap, by the tap.
        heaters: furniture that heats what is on or in it, by its switch.
        near: for switches and containers, the surfaces, switches and containers that the other hand may reach meanwhile.
        roomy: targets with room for several things.
    """

    room: str
    furniture: tuple[str, ...]
    surfaces: tuple[str, ...]
    targets: tuple[str, ...]
    containers: tuple[str, ...]
    switches: tuple[str, ...]
    small: Mapping[str, tuple[str, ...]]
    big: Mapping[str, tuple[str, ...]]
    lids: tuple[str, ...] = ()
    basins: Mapping[str, str] = field(default_factory=dict)
    heaters: Mapping[str, str] = field(default_factory=dict)
    near: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    roomy: tuple[str, ...] = ()


@dataclass(slots=True)
class Draft:
    """A task without positions.

    Attributes:
        family: a name of `sim.tasks.families.FAMILIES`.
        room: name of the layout.
        objects: carrier by object id, in the order of placing.
        object_states: start state by object id.
        states: start state of furniture by id.
        goals: what must hold.
        focus: the ids that the instruction names, by slot (`a`, `b`, `c`, `r`, `s`).
        words: slots that are filled with words instead of an object.
        beside: objects that stand close to something else, furniture or an earlier object.
    """

    family: str
    room: str
    objects: dict[str, str] = field(default_factory=dict)
    object_states: dict[str, dict[str, bool | float | str]] = field(default_factory=dict)
    states: dict[str, dict[str, bool | float | str]] = field(default_factory=dict)
    goals: list[Predicate] = field(default_factory=list)
    focus: dict[str, str] = field(default_factory=dict)
    words: dict[str, str] = field(default_factory=dict)
    beside: dict[str, str] = field(default_factory=dict)

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
        return shuffled(wordings(self.family, slots | self.words), rng)


@dataclass(slots=True)
class Builder:
    """Fills a draft with draws from a scene.

    Attributes:
        draft: what has been decided so far.
        scene: what the room offers.
        rng: source of randomness.
        without: types that are left out, as subjects and as distractors.
    """

    draft: Draft
    scene: Scene
    rng: np.random.Generator
    without: Collection[str] = ()

    def choose(self, options: Sequence[str], what: str) -> str:
        """One of some options.

        Raises:
            NoDraft: when there are none.
        """
        options = [option for option in options if option.rsplit("_", 1)[0] not in self.without]
        if not options:
            raise NoDraft(f"{self.scene.room} has no {what} for {self.draft.family}")
        return options[int(self.rng.integers(len(options)))]

    def add(self, object_type: str, carrier: str) -> str:
        """Adds an object of a type and returns its id."""
        number = 1 + sum(
            object_id.rsplit("_", 1)[0] == object_type for object_id in (*self.draft.objects, *self.scene.furniture)
        )
        object_id = f"{object_type}_{number}"
        self.draft.objects[object_id] = carrier
        return object_id

    def unused(self, table: Mapping[str, tuple[str, ...]], *needed: str, among: Sequence[str] = ()) -> list[str]:
        """Types not yet in the room that fit all of the needed furniture and at least one surface, of some types or of all."""
        present = {object_id.rsplit("_", 1)[0] for object_id in (*self.draft.objects, *self.scene.furniture)}
        return [
            object_type
            for object_type, fits in table.items()
            if object_type not in present
            and (not among or object_type in among)
            and all(place in fits for place in needed)
            and set(fits) & set(self.scene.surfaces)
        ]

    def small(self, *needed: str, at: str = "", avoid: Sequence[str] = (), among: Sequence[str] = ()) -> str:
        """Adds a new small object that fits `needed`, at `at` or on a random surface other than `avoid`."""
        options = self.unused(self.scene.small, *needed, *((at,) if at else ()), among=among)
        object_type = self.choose(options, "fitting small object")
        fits = self.scene.small[object_type]
        place = at or self.choose([s for s in self.scene.surfaces if s in fits and s not in avoid], "free surface")
        return self.add(object_type, place)

    def near(self, object_id: str, *needed: str, among: Sequence[str] = ()) -> str:
        """Adds a new small object beside another one."""
        return self.small(*needed, at=self.draft.objects[object_id], among=among)

    def big(self, target: str = "", among: Sequence[str] = ()) -> str:
        """Adds a new two-handed object that can be carried to `target`, on other furniture."""
        options = self.unused(self.scene.big, *((target,) if target else ()), among=among)
        object_type = self.choose(options, "two-handed object")
        place = self.choose([s for s in self.scene.big[object_type] if s != target], "furniture for a two-handed object")
        object_id = self.add(object_type, place)
        if object_type in _LOADS:
            self.draft.object_states[object_id] = dict(_LOADS[object_type])
        return object_id

    def big_target(self, among: Sequence[str] = ()) -> str:
        """Furniture that a two-handed object can be carried to from elsewhere."""
        table = {kind: fits for kind, fits in self.scene.big.items() if not among or kind in among}
        options = sorted({place for fits in table.values() if len(fits) > 1 for place in fits})
        return self.choose(options, "furniture for a two-handed object")

    def target(self, *others: str, roomy: bool = False) -> str:
        """Furniture to put things on, different from some, with room for several when asked."""
        places = self.scene.roomy if roomy else self.scene.targets
        return self.choose([place for place in places if place not in others], "surface")

    def pair(self, first: Sequence[str], second: Sequence[str], what: str) -> tuple[str, str]:
        """Furniture of two kinds that both hands may reach from one place."""
        pairs = [f"{a} {c}" for a in first for c in self.scene.near.get(a, ()) if c in second]
        a, c = self.choose(pairs, what).split()
        return a, c

    def switch(self, on: bool, avoid: Sequence[str] = ()) -> str:
        """A switch of the room that is off, or `on`, at the start."""
        switch = self.choose([s for s in self.scene.switches if s not in avoid], "switch")
        self.draft.states.setdefault(switch, {})["isToggled"] = on
        return switch

    def container(self, is_open: bool, falls_shut: bool = False, among: Sequence[str] = ()) -> str:
        """A container of the room that is closed, or `is_open`, at the start, and may shut by itself."""
        options = [name for name in self.scene.containers if not among or name.rsplit("_", 1)[0] in among]
        container = self.choose(options, "container")
        state = self.draft.states.setdefault(container, {})
        state["isOpen"] = is_open
        if falls_shut:
            state["selfClosing"] = True
        return container

    def start(self, object_id: str, **state: bool | float | str) -> None:
        """Gives an object a start state."""
        self.draft.object_states.setdefault(object_id, {}).update(state)

    def ask(self, *goals: Predicate, **focus: str) -> None:
        """Adds goals, and the objects that the instruction names."""
        self.draft.goals.extend(goals)
        self.draft.focus.update(focus)

    def add_distractors(self, count: int) -> None:
        """Adds small objects that the task does not need."""
        for _ in range(count):
            options = [kind for kind in self.unused(self.scene.small) if kind not in self.without]
            if not options:
                return
            object_type = self.choose(options, "distractor")
            crowd = list(self.draft.objects.values())
            places = [s for s in self.scene.surfaces if s in self.scene.small[object_type] and crowd.count(s) < 3]
            if places:
                self.add(object_type, self.choose(places, "free surface"))
