"""The state of a world as values: what objects there are, what can be done with them, and what state each is in.

The simulator takes them from physics (`sim.world.facts`), the text world keeps them (`sim.collection.text_facts`), and what a
planner believes is a part of them (`interface.belief`). Preconditions of actions, goals and the job planner read nothing else,
so what counts as open, filled or too heavy is decided here, for all of them.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass
from typing import Final, Protocol

from interface.bodies import Arm

#: Shares of a door's travel: beyond which it counts as open, beyond which Open, and below which Close, has nothing left to do.
OPEN_SHARE: Final = 1.0 / 3.0
_OPENED, _CLOSED = 0.6, 0.06
#: Shares of a vessel's volume from which on it counts as filled, and as full.
FILLED_SHARE: Final = 0.1
FULL_SHARE: Final = 0.999


class Call(Protocol):
    """An action with its arguments; `interface.steps.Action` is one."""

    @property
    def name(self) -> str:
        """A name of the table of actions."""
        ...

    @property
    def arm(self) -> Arm | None:
        """The acting arm, None for all but arm actions."""
        ...

    @property
    def object_id(self) -> str | None:
        """The target, None for actions without one."""
        ...

    @property
    def amount(self) -> float | None:
        """Metres or degrees, None for the default."""
        ...


@dataclass(frozen=True, slots=True)
class Affordances:
    """What can be done with an object, whatever state it is in.

    Attributes:
        movable: it can be carried, by one hand or two; furniture cannot.
        pickupable: it is made for one hand.
        liftable: two hands find room on it.
        receptacle: things can rest on or in it.
        openable: it has a door, a drawer or a lid.
        encloses: what it carries is out of reach while that is closed.
        lidded: its switch lies under its lid, as the keys of a laptop do.
        toggleable: it has a switch.
        sliceable: a knife cuts it.
        consumable: there is something in it to use up.
        fillable: it holds a liquid.
        cutter, wiper: it is a knife; a sponge or towel.
        unsteady: it rolls or slides away under a tool.
        heat_source: it cooks, while it is on, what it carries.
    """

    movable: bool = True
    pickupable: bool = True
    liftable: bool = True
    receptacle: bool = True
    openable: bool = True
    encloses: bool = True
    lidded: bool = False
    toggleable: bool = True
    sliceable: bool = True
    consumable: bool = True
    fillable: bool = True
    cutter: bool = True
    wiper: bool = True
    unsteady: bool = False
    heat_source: bool = False


@dataclass(frozen=True, slots=True)
class ObjectFacts:
    """One object and the state that it is in; what is not known counts as half open, half full, or None.

    Attributes:
        object_id: `Type_1`.
        can: what can be done with it.
        holders: the arms that hold it, at furniture its door or drawer.
        carriers: the receptacles on or in which it is, the direct one first.
        two_handed: its shape or its present weight takes both hands.
        mass_kg: with what it holds and carries.
        openness: of its door, drawer or lid, 0 closed to 1 open.
        self_closing: its door or drawer shuts as soon as nothing holds it open.
        on: it is switched on; at a burner, what heats it is.
        switch: what switches it, None when nothing does.
        fill: share of its volume that is filled.
        dirty, wet: it is dirty; something is spilled on it.
        sliced, cooked, used_up, broken: as they say.
        outlet: what a liquid comes out of there: itself, or the tap of a basin; None without one.
    """

    object_id: str
    can: Affordances
    holders: Collection[str] = ()
    carriers: tuple[str, ...] = ()
    two_handed: bool = False
    mass_kg: float = 0.0
    openness: float = 0.0
    self_closing: bool = False
    on: bool | None = False
    switch: str | None = None
    fill: float = 0.0
    dirty: bool = False
    wet: bool = False
    sliced: bool = False
    cooked: bool = False
    used_up: bool = False
    broken: bool = False
    outlet: str | None = None

    @property
    def open(self) -> bool:
        """Whether it is open, as goals mean it."""
        return self.can.openable and self.openness > OPEN_SHARE

    @property
    def opened(self) -> bool:
        """Whether Open has nothing left to do."""
        return self.openness > _OPENED

    @property
    def closed(self) -> bool:
        """Whether Close has nothing left to do."""
        return self.openness < _CLOSED

    @property
    def shut(self) -> bool:
        """Whether what it carries is out of reach behind its door."""
        return self.can.encloses and not self.open

    @property
    def covered(self) -> bool:
        """Whether its switch lies under a lid that is down."""
        return self.can.lidded and not self.open

    @property
    def filled(self) -> bool:
        """Whether there is liquid worth the name in it, as goals mean it."""
        return self.fill >= FILLED_SHARE

    @property
    def full(self) -> bool:
        """Whether no more liquid goes in."""
        return self.fill >= FULL_SHARE

    @property
    def soiled(self) -> bool:
        """Whether there is something to wipe."""
        return self.dirty or self.wet

    @property
    def picked_up(self) -> bool:
        """Whether a hand holds it, and not its door."""
        return self.can.movable and bool(self.holders)


class Objects(Mapping[str, ObjectFacts]):
    """Facts that are made when they are asked for, and kept.

    Args:
        ids: the objects that there are; one may be asked for that nobody has listed.
        make: the facts of one.
    """

    def __init__(self, ids: Collection[str], make: Callable[[str], ObjectFacts]) -> None:
        self._ids, self._make = ids, make
        self._made: dict[str, ObjectFacts] = {}

    def __getitem__(self, object_id: str) -> ObjectFacts:
        found = self._made.get(object_id)
        if found is None:
            found = self._made[object_id] = self._make(object_id)
        return found

    def __contains__(self, object_id: object) -> bool:
        return object_id in self._ids

    def __iter__(self) -> Iterator[str]:
        return iter(self._ids)

    def __len__(self) -> int:
        return len(self._ids)


@dataclass(frozen=True, slots=True)
class Facts:
    """A world at one moment.

    Attributes:
        objects: its objects by id.
        held: what each hand holds by itself; furniture where it holds a door or drawer.
        lifted: what both hands hold together.
        loads_kg: what one arm, and what two arms carry.
    """

    objects: Mapping[str, ObjectFacts]
    held: Mapping[Arm, str | None]
    lifted: str | None = None
    loads_kg: tuple[float, float] = (float("inf"), float("inf"))

    def overload_kg(self, object_id: str, arms: int) -> float:
        """By how much an object's weight exceeds what one or two arms carry; negative when they do carry it."""
        return self.objects[object_id].mass_kg - self.loads_kg[arms - 1]

    def arm_with(self, object_id: str) -> Arm | None:
        """The arm that holds an object by itself."""
        return next((arm for arm, item in self.held.items() if item == object_id), None)

    def shut_around(self, object_id: str) -> str | None:
        """The closed receptacle in which an object is, None when it can be reached."""
        return next((name for name in self.objects[object_id].carriers if self.objects[name].shut), None)


@dataclass(frozen=True, slots=True)
class Situation:
    """An action that is about to be carried out in a world; what its requirements look at.

    Attributes:
        facts: the world.
        call: the action.
    """

    facts: Facts
    call: Call

    @property
    def arm(self) -> Arm:
        """The acting arm."""
        assert self.call.arm is not None, self.call.name
        return self.call.arm

    @property
    def target(self) -> ObjectFacts:
        """The object that the action names."""
        assert self.call.object_id is not None, self.call.name
        return self.facts.objects[self.call.object_id]

    @property
    def tool(self) -> ObjectFacts:
        """What the acting arm holds, or both together where both act."""
        name = self.facts.lifted if self.call.arm is None else self.facts.held[self.call.arm]
        assert name is not None, self.call.name
        return self.facts.objects[name]
