"""Facts of the text world: objects with the abilities of their types, in states that the table of actions changes.

Nothing here has a position. Heat is the one thing that happens by itself: food is cooked when it has been on a running heat
source for a while.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Final

from interface.effects import Condition
from interface.facts import OPEN_SHARE, Call, Facts, ObjectFacts, Objects
from interface.symbolic import SymbolicState
from robots.spec import RobotSpec
from sim.scene.catalogue import load_catalogue
from sim.tasks.drafts import Draft, Scene

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


class TextFacts:
    """The world of one task.

    Attributes:
        state: who holds what, what stands on what, states of objects.
        objs: the task's movable objects, in its order.
        homes: what each of them stood on at the start.
        broken: objects that chance has broken.
    """

    def __init__(self, draft: Draft, scene: Scene, robot: RobotSpec) -> None:
        self._scene = scene
        self._loads_kg = robot.max_load_kg(1), robot.max_load_kg(2)
        self.objs = tuple(draft.objects)
        self.homes = dict(draft.objects)
        self.broken = set[str]()
        starts = {name: dict(state) for name, state in (*draft.states.items(), *draft.object_states.items())}
        self._mass_kg = {name: float(state["mass"]) for name, state in starts.items() if "mass" in state}
        shutting = {name for name, state in starts.items() if state.get("selfClosing")}
        self.state = SymbolicState(at=dict(draft.objects), self_closing=shutting)
        catalogue = load_catalogue()
        names = (*scene.furniture, *draft.objects)
        self._types = {name: catalogue.get(name.rsplit("_", 1)[0]) for name in names}
        self._can = {name: kind.affordances(name in draft.objects) for name, kind in self._types.items()}
        for name, kind in self._types.items():
            self.state.conditions[Condition.OPEN][name] = kind.openable and kind.starts_open > OPEN_SHARE
            for key, value in starts.get(name, {}).items():
                if key in _STARTS:
                    self.state.conditions[_STARTS[key]][name] = bool(value)
        self._taps = {basin: tap for tap, basin in scene.basins.items()}
        self._heated: dict[str, int] = {}

    def now(self) -> Facts:
        """What is the case now."""
        return Facts(Objects(self._types, self.object), dict(self.state.held), self.state.lifted, self._loads_kg)

    def object(self, name: str) -> ObjectFacts:
        """One object now."""
        kind, can, switch = self._types[name], self._can[name], self._switch(name)
        full = self._is(Condition.FILLED, name)  # a vessel is full or empty here
        mass_kg = self._mass_kg.get(name, kind.mass or 0.0) + (kind.volume_l if full else 0.0)
        source = self._taps.get(name, name)
        return ObjectFacts(
            object_id=name,
            can=can,
            holders=self.state.holders(name),
            carriers=tuple(self.carriers(name)),
            two_handed=can.movable and (kind.two_handed or mass_kg > self._loads_kg[0]),
            mass_kg=mass_kg,
            openness=float(self._is(Condition.OPEN, name)),
            self_closing=name in self.state.self_closing,
            on=self._is(Condition.ON, switch if can.heat_source and switch is not None else name),
            switch=switch,
            fill=float(full),
            dirty=self._is(Condition.DIRTY, name),
            sliced=self._is(Condition.SLICED, name),
            cooked=self._heated.get(name, 0) >= _COOKING_ACTIONS,
            used_up=self._is(Condition.USED_UP, name),
            broken=name in self.broken,
            outlet=source if self._types[source].spouts else None,
        )

    def carriers(self, name: str) -> Iterable[str]:
        """The receptacles on or in which an object is, the direct one first."""
        place = self.state.at.get(name)
        while place is not None:
            yield place
            place = self.state.at.get(place)

    def hidden(self, name: str) -> bool:
        """Whether an object is shut away."""
        return any(self.object(carrier).shut for carrier in self.carriers(name))

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
        for name in self.objs:
            below = (self.object(carrier) for carrier in self.carriers(name) if self._can[carrier].heat_source)
            if any(item.on and not item.open for item in below):
                self._heated[name] = self._heated.get(name, 0) + 1

    def harm(self, name: str, breaks: bool) -> None:
        """What an object holds is spilled; it breaks, too, where that is asked for and it can."""
        self.state.conditions[Condition.FILLED][name] = False
        if breaks and self._types[name].has("breakable"):
            self.broken.add(name)

    def _is(self, condition: Condition, name: str) -> bool:
        return self.state.conditions[condition].get(name, False)

    def _switch(self, name: str) -> str | None:
        """What switches it: itself, the knob of a burner, the tap of a basin."""
        switch = name if self._can[name].toggleable else self._scene.heaters.get(name, self._taps.get(name))
        return switch if switch in self._types else None
