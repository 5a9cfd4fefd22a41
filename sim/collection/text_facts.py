"""Facts of the text world: objects with the abilities of their types, in states that the table of actions changes.

Nothing here has a position. Heat is the one thing that happens by itself: food is cooked when it has been on a running heat
source for a while. The expert's job planner reads these facts under AI2-THOR's names, as it reads those of the simulator.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from typing import Any, Final

from interface.bodies import Arm
from interface.effects import Condition
from interface.facts import Call
from interface.symbolic import SymbolicState
from robots.spec import RobotSpec
from sim.expert.jobs import Facts as JobFacts
from sim.scene.catalogue import ObjectType, load_catalogue
from sim.tasks.drafts import Draft, Scene

__all__ = ["TextFacts", "TextObject"]

#: Actions after which food on a running heat source is cooked. Chosen by hand.
_COOKING_ACTIONS: Final = 2
#: Start states under AI2-THOR's names, as conditions.
_STARTS: Final = {
    "isOpen": Condition.OPEN,
    "isToggled": Condition.ON,
    "isDirty": Condition.DIRTY,
    "isFilledWithLiquid": Condition.FILLED,
    "fillLiquid": Condition.FILLED,
}


class TextObject:
    """One object as `interface.facts.ObjectFacts`."""

    def __init__(self, object_id: str, kind: ObjectType, facts: TextFacts) -> None:
        self.object_id, self.kind, self._facts = object_id, kind, facts
        self.movable = object_id in facts.objs
        self.pickupable = self.movable and kind.pickupable
        self.liftable = kind.broad
        self.receptacle, self.openable, self.toggleable = kind.receptacle, kind.openable, kind.toggleable
        self.sliceable, self.consumable, self.fillable = kind.has("sliceable"), kind.has("used_up"), kind.fillable
        self.cutter, self.wiper, self.unsteady = kind.has("cutter"), kind.has("wiper"), kind.has("unsteady")

    def _is(self, condition: Condition) -> bool:
        return self._facts.state.conditions[condition].get(self.object_id, False)

    @property
    def two_handed(self) -> bool:
        """Whether its type or its weight takes both hands."""
        return self.kind.two_handed or self._facts.overload_kg(self.object_id, 1) > 0.0

    @property
    def holders(self) -> Collection[str]:
        """The arms that hold it."""
        return self._facts.state.holders(self.object_id)

    @property
    def opened(self) -> bool:
        """Whether it is open."""
        return self._is(Condition.OPEN)

    @property
    def closed(self) -> bool:
        """Whether it is closed."""
        return not self.opened

    @property
    def shut(self) -> bool:
        """Whether what it carries is out of reach."""
        return self.openable and self.kind.encloses and not self.opened

    @property
    def covered(self) -> bool:
        """Whether its switch lies under a lid that is down."""
        return self.kind.lidded and not self.opened

    @property
    def on(self) -> bool:
        """Whether it is switched on."""
        return self._is(Condition.ON)

    @property
    def sliced(self) -> bool:
        """Whether it has been sliced."""
        return self._is(Condition.SLICED)

    @property
    def soiled(self) -> bool:
        """Whether it is dirty."""
        return self._is(Condition.DIRTY)

    @property
    def used_up(self) -> bool:
        """Whether nothing is left in it."""
        return self._is(Condition.USED_UP)

    @property
    def broken(self) -> bool:
        """Nothing breaks here."""
        return False

    @property
    def filled(self) -> bool:
        """Whether there is a liquid in it; a vessel is full or empty here."""
        return self._is(Condition.FILLED)

    @property
    def full(self) -> bool:
        """Whether no more liquid goes in."""
        return self.filled


class TextFacts:
    """The world of one task as `interface.facts.Facts`.

    Attributes:
        state: who holds what, what stands on what, states of objects.
        objs: the task's movable objects, in its order.
        objects: all objects by id, furniture first.
    """

    def __init__(self, draft: Draft, scene: Scene, robot: RobotSpec) -> None:
        self._robot, self._scene = robot, scene
        self.objs = tuple(draft.objects)
        self.homes = dict(draft.objects)
        starts = {name: dict(state) for name, state in (*draft.states.items(), *draft.object_states.items())}
        self._mass_kg = {name: float(state["mass"]) for name, state in starts.items() if "mass" in state}
        shutting = {name for name, state in starts.items() if state.get("selfClosing")}
        self.state = SymbolicState(at=dict(draft.objects), self_closing=shutting)
        catalogue = load_catalogue()
        self.objects = {
            name: TextObject(name, catalogue.get(name.rsplit("_", 1)[0]), self) for name in (*scene.furniture, *draft.objects)
        }
        for name, item in self.objects.items():
            self.state.conditions[Condition.OPEN][name] = item.openable and item.kind.starts_open > 1.0 / 3.0
            for key, value in starts.get(name, {}).items():
                if key in _STARTS:
                    self.state.conditions[_STARTS[key]][name] = bool(value)
        self._taps = {basin: tap for tap, basin in scene.basins.items()}
        self._heated: dict[str, int] = {}

    # ---- interface.facts.Facts

    def held(self, arm: Arm) -> str | None:
        """What a hand holds by itself."""
        return self.state.held[arm]

    @property
    def lifted(self) -> str | None:
        """What both hands hold together."""
        return self.state.lifted

    def object(self, object_id: str) -> TextObject:
        """One object."""
        return self.objects[object_id]

    def carriers(self, object_id: str) -> Iterable[str]:
        """The receptacles on or in which it is, the direct one first."""
        place = self.state.at.get(object_id)
        while place is not None:
            yield place
            place = self.state.at.get(place)

    def overload_kg(self, object_id: str, arms: int) -> float:
        """By how much its weight, with its liquid, exceeds what one or two arms carry."""
        item = self.objects[object_id]
        mass = self._mass_kg.get(object_id, item.kind.mass or 0.0) + (item.kind.volume_l if item.filled else 0.0)
        return mass - self._robot.max_load_kg(arms)

    def outlet(self, object_id: str) -> str | None:
        """What a liquid comes out of there."""
        name = self._taps.get(object_id, object_id)
        return name if any("spout" in part.options for part in self.objects[name].kind.parts) else None

    # ---- what else is asked

    def hidden(self, object_id: str) -> bool:
        """Whether an object is shut away."""
        return any(self.objects[name].shut for name in self.carriers(object_id))

    def succeed(self, call: Call, in_front: str) -> None:
        """Carries an action out.

        Args:
            call: the action.
            in_front: furniture in front of the robot, where things that are let go come to rest.
        """
        before = {*self.state.held.values(), self.state.lifted}
        self.state.succeed(call)
        for name in before - {*self.state.held.values(), self.state.lifted, None}:
            if name in self.objs and name not in self.state.at:
                self.state.at[name] = in_front
        self._heat()

    def _heat(self) -> None:
        for name in self.objs:
            place = self.objects[self.state.at[name]] if name in self.state.at else None
            if place is not None and self._heats(place):
                self._heated[name] = self._heated.get(name, 0) + 1

    def _heats(self, place: TextObject) -> bool:
        switch = self.objects.get(self._scene.heaters.get(place.object_id, place.object_id))
        return place.kind.has("heat_source") and switch is not None and switch.on and not (place.openable and place.opened)

    def for_jobs(self) -> JobFacts:
        """What the expert's job planner reads."""
        items = self.objects.values()
        return JobFacts(
            {item.object_id: self._entry(item) for item in items},
            dict(self.state.held),
            self.state.lifted,
            frozenset(item.object_id for item in items if item.movable and item.two_handed),
            self.homes,
            uncovered=frozenset(item.object_id for item in items if not item.kind.encloses),
            tools={
                "cutter": tuple(item.object_id for item in items if item.cutter),
                "wiper": tuple(item.object_id for item in items if item.wiper),
            },
            unsteady=frozenset(item.object_id for item in items if item.unsteady),
            outlets=tuple(item.object_id for item in items if item.toggleable and self.outlet(item.object_id)),
            switches=self._scene.heaters,
        )

    def _entry(self, item: TextObject) -> Mapping[str, Any]:
        name = item.object_id
        switch = self._scene.heaters.get(name, name)
        return {
            "objectId": name,
            "parentReceptacles": list(self.carriers(name)),
            "isPickedUp": bool(item.holders) and item.movable,
            "heldBy": list(item.holders),
            "openable": item.openable,
            "isOpen": item.opened,
            "selfClosing": name in self.state.self_closing,
            "isToggled": self.objects[switch].on if switch in self.objects else item.on,
            "isHeatSource": item.kind.has("heat_source"),
            "isFilledWithLiquid": item.filled,
            "isSliced": item.sliced,
            "isDirty": item.soiled,
            "isUsedUp": item.used_up,
            "isCooked": self._heated.get(name, 0) >= _COOKING_ACTIONS,
            "pickupable": item.pickupable and not item.two_handed,
            "moveable": item.movable and item.two_handed,
            "receptacle": name in self._scene.targets or name in self._scene.containers,
        }
