"""What the preconditions of actions ask about a world; the simulator and the text world answer."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from dataclasses import dataclass
from typing import Protocol

from interface.bodies import Arm

__all__ = ["Call", "Facts", "ObjectFacts", "Situation"]


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


class ObjectFacts(Protocol):
    """One object: what can be done with it, and the state that it is in."""

    # what it is good for

    @property
    def object_id(self) -> str:
        """`Type_1`."""
        ...

    @property
    def movable(self) -> bool:
        """Whether it can be carried, by one hand or two; furniture cannot."""
        ...

    @property
    def pickupable(self) -> bool:
        """Whether it is made for one hand."""
        ...

    @property
    def two_handed(self) -> bool:
        """Whether its shape or its present weight takes both hands."""
        ...

    @property
    def liftable(self) -> bool:
        """Whether two hands find room on it."""
        ...

    @property
    def receptacle(self) -> bool:
        """Whether things can rest on or in it."""
        ...

    @property
    def openable(self) -> bool:
        """Whether it has a door, a drawer or a lid."""
        ...

    @property
    def toggleable(self) -> bool:
        """Whether it has a switch."""
        ...

    @property
    def sliceable(self) -> bool:
        """Whether a knife cuts it."""
        ...

    @property
    def consumable(self) -> bool:
        """Whether there is something in it to use up."""
        ...

    @property
    def fillable(self) -> bool:
        """Whether it holds a liquid."""
        ...

    @property
    def cutter(self) -> bool:
        """Whether it is a knife."""
        ...

    @property
    def wiper(self) -> bool:
        """Whether it is a sponge or towel."""
        ...

    @property
    def unsteady(self) -> bool:
        """Whether it rolls or slides away under a tool."""
        ...

    # the state that it is in

    @property
    def holders(self) -> Collection[str]:
        """The arms that hold it; at furniture, those that hold its door or drawer."""
        ...

    @property
    def opened(self) -> bool:
        """Whether Open has nothing left to do."""
        ...

    @property
    def closed(self) -> bool:
        """Whether Close has nothing left to do."""
        ...

    @property
    def shut(self) -> bool:
        """Whether what it carries is out of reach behind its door."""
        ...

    @property
    def covered(self) -> bool:
        """Whether its switch lies under a lid that is down, as the keys of a laptop do."""
        ...

    @property
    def on(self) -> bool | None:
        """Whether it is switched on, None where that is not known."""
        ...

    @property
    def sliced(self) -> bool:
        """Whether it has been sliced."""
        ...

    @property
    def soiled(self) -> bool:
        """Whether it is dirty, or something is spilled on it."""
        ...

    @property
    def used_up(self) -> bool:
        """Whether nothing is left in it."""
        ...

    @property
    def broken(self) -> bool:
        """Whether it is broken."""
        ...

    @property
    def filled(self) -> bool:
        """Whether there is a liquid in it."""
        ...

    @property
    def full(self) -> bool:
        """Whether no more liquid goes in."""
        ...


class Facts(Protocol):
    """A world: who holds what, what carries what, and its objects."""

    def held(self, arm: Arm) -> str | None:
        """What a hand holds; furniture where it holds a door or drawer."""
        ...

    @property
    def lifted(self) -> str | None:
        """What both hands hold together."""
        ...

    def object(self, object_id: str) -> ObjectFacts:
        """One object."""
        ...

    def carriers(self, object_id: str) -> Iterable[str]:
        """The receptacles on or in which it is, the direct one first."""
        ...

    def overload_kg(self, object_id: str, arms: int) -> float:
        """By how much its weight, with contents, exceeds what one or two arms carry; negative when they do carry it."""
        ...

    def outlet(self, object_id: str) -> str | None:
        """What a liquid comes out of there: itself, or the tap of a basin; None without one."""
        ...


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
        return self.facts.object(self.call.object_id)

    @property
    def tool(self) -> ObjectFacts:
        """What the acting arm holds, or both together where both act."""
        name = self.facts.lifted if self.call.arm is None else self.facts.held(self.call.arm)
        assert name is not None, self.call.name
        return self.facts.object(name)
