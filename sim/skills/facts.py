"""The facts that preconditions ask for, answered from the simulated world; and the refusal of what cannot be done.

The preconditions themselves stand in the table of actions (`interface.actions`). What counts as open, full or too heavy is
decided here, where physics knows it.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable
from typing import Final

from interface.actions import first_refusal
from interface.bodies import Arm
from interface.steps import Action
from sim.scene.objects import ObjectInstance
from sim.skills.body.body import Body
from sim.skills.failures import SkillFailure

__all__ = ["FULL_SHARE", "WorldFacts", "WorldObject", "require"]

#: Share of a door's travel beyond which Open, and below which Close, has nothing left to do. Chosen by hand.
_OPENED: Final = 0.6
_CLOSED: Final = 0.06
#: Share of a vessel's volume from which on it is full. Chosen by hand.
FULL_SHARE: Final = 0.999


class WorldObject:
    """An object of the simulator as `interface.facts.ObjectFacts`."""

    def __init__(self, obj: ObjectInstance, body: Body) -> None:
        self._obj, self._body = obj, body

    @property
    def object_id(self) -> str:
        """`Type_1`."""
        return self._obj.object_id

    @property
    def movable(self) -> bool:
        """Whether it has a free joint."""
        return self._obj.movable

    @property
    def pickupable(self) -> bool:
        """Whether its type is made for one hand."""
        return self._obj.type.pickupable

    @property
    def two_handed(self) -> bool:
        """Whether its type or its weight with contents takes both hands."""
        return self._body.world.containment.needs_two_hands(self.object_id)

    @property
    def liftable(self) -> bool:
        """Whether it is broad enough for two hands."""
        return self._obj.type.broad

    @property
    def receptacle(self) -> bool:
        """Whether it has a supporting surface."""
        return self._obj.type.receptacle

    @property
    def openable(self) -> bool:
        """Whether it has a door, a drawer or a lid."""
        return bool(self._obj.moving)

    @property
    def toggleable(self) -> bool:
        """Whether it has a switch."""
        return self._obj.toggle_site >= 0

    @property
    def sliceable(self) -> bool:
        """Whether a knife cuts it."""
        return self._obj.type.has("sliceable")

    @property
    def consumable(self) -> bool:
        """Whether there is something in it to use up."""
        return self._obj.type.has("used_up")

    @property
    def fillable(self) -> bool:
        """Whether it holds a liquid."""
        return self._obj.type.fillable

    @property
    def cutter(self) -> bool:
        """Whether it is a knife."""
        return self._obj.type.has("cutter")

    @property
    def wiper(self) -> bool:
        """Whether it is a sponge or towel."""
        return self._obj.type.has("wiper")

    @property
    def unsteady(self) -> bool:
        """Whether it rolls or slides away under a tool."""
        return self._obj.type.has("unsteady")

    @property
    def holders(self) -> Collection[str]:
        """The arms that hold it, in the order of grasping."""
        return self._obj.held_by

    @property
    def opened(self) -> bool:
        """Whether it is open as far as Open opens it."""
        return self._obj.openness > _OPENED

    @property
    def closed(self) -> bool:
        """Whether it is closed as far as Close closes it."""
        return self._obj.openness < _CLOSED

    @property
    def shut(self) -> bool:
        """Whether what it carries is out of reach."""
        return self._obj.is_shut

    @property
    def covered(self) -> bool:
        """Whether its switch lies under a lid that is down."""
        return self._obj.type.lidded and not self._obj.is_open

    @property
    def on(self) -> bool:
        """Whether it is switched on."""
        return self._obj.is_toggled

    @property
    def sliced(self) -> bool:
        """Whether it has been sliced."""
        return self._obj.state.isSliced

    @property
    def soiled(self) -> bool:
        """Whether it is dirty, or a puddle is on it."""
        return self._obj.state.isDirty or any(puddle.surface == self.object_id for puddle in self._body.world.liquids.puddles)

    @property
    def used_up(self) -> bool:
        """Whether nothing is left in it."""
        return self._obj.state.isUsedUp

    @property
    def broken(self) -> bool:
        """Whether it is broken."""
        return self._obj.is_broken

    @property
    def filled(self) -> bool:
        """Whether there is a liquid in it."""
        return self._obj.state.fillLitres > 0.0

    @property
    def full(self) -> bool:
        """Whether no more liquid goes in."""
        return self._obj.state.fillLitres >= FULL_SHARE * self._obj.type.volume_l


class WorldFacts:
    """The simulated world as `interface.facts.Facts`."""

    def __init__(self, body: Body) -> None:
        self._body = body
        self._held: dict[Arm, str | None] | None = None

    def held(self, arm: Arm) -> str | None:
        """What a hand holds; furniture where it holds a door or drawer."""
        if self._held is None:
            self._held = self._body.hands.held
        return self._held[arm]

    @property
    def lifted(self) -> str | None:
        """What both hands hold together."""
        return self._body.hands.lifted

    def object(self, object_id: str) -> WorldObject:
        """One object."""
        return WorldObject(self._body.obj(object_id), self._body)

    def carriers(self, object_id: str) -> Iterable[str]:
        """The receptacles on or in which it is, the direct one first."""
        return self._body.world.containment.parents(object_id)

    def overload_kg(self, object_id: str, arms: int) -> float:
        """By how much its weight with contents exceeds what two arms, or the weaker of the arms alone, carry."""
        return self._body.world.containment.total_mass_kg(object_id) - self._body.spec.max_load_kg(arms)

    def outlet(self, object_id: str) -> str | None:
        """What a liquid comes out of there: itself, or the tap of a basin."""
        world = self._body.world
        taps = [name for name, basin in world.room.links.items() if basin == object_id]
        source = self._body.obj(object_id)
        outlet = self._body.obj(taps[0]) if taps and world.liquids.spout(source) is None else source
        return None if world.liquids.spout(outlet) is None else outlet.object_id


def require(body: Body, action: Action) -> None:
    """Refuses an action whose preconditions do not hold.

    Raises:
        SkillFailure: the code of the first one that does not, with its margin.
    """
    refusal = first_refusal(action, WorldFacts(body))
    if refusal is not None:
        raise SkillFailure(refusal.code, dict(refusal.margins))
