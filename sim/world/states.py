"""States of objects beyond their poses: on, broken, filled, dirty, cooked, sliced, used up, and what follows from each."""

from __future__ import annotations

from typing import Any, Final

from sim.scene.objects import STATE_NAMES, ObjectInstance, ObjectState, copy_state
from sim.world.appearance import Appearance
from sim.world.liquids import LIQUIDS, LiquidLedger
from sim.world.masses import Masses
from sim.world.scene_state import SceneState, WorldError

#: The property of an object's type that a state takes.
_NEEDS: Final = {
    "isToggled": "toggleable", "isBroken": "breakable", "isFilledWithLiquid": "fillable", "fillLiquid": "fillable",
    "fillLitres": "fillable", "isDirty": "dirtyable", "isCooked": "cookable", "isSliced": "sliceable", "isUsedUp": "used_up",
}  # fmt: skip


class ObjectStates:
    """Sets states of objects by AI2-THOR's names.

    Args:
        scene: the running scene.
        liquids: what vessels hold.
        masses, appearance: what follows from a state.
    """

    def __init__(self, scene: SceneState, liquids: LiquidLedger, masses: Masses, appearance: Appearance) -> None:
        self._scene, self._liquids, self._masses, self._appearance = scene, liquids, masses, appearance

    def set_state(self, object_id: str, name: str, value: bool | float | str) -> None:
        """Sets a state and what follows from it: colours, mass of a liquid, the burner behind a knob.

        Raises:
            WorldError: on a name outside `STATE_NAMES`, or a state the type does not have.
        """
        item = self._scene.object(object_id)
        if name not in STATE_NAMES:
            raise WorldError(f"unknown state {name!r}; allowed: {', '.join(STATE_NAMES)}")
        links = self._scene.room.links
        linked = object_id in links.values()
        if name in _NEEDS and not item.type.has(_NEEDS[name]) and not (linked and name == "isToggled"):
            raise WorldError(f"{item.type.name} is not {_NEEDS[name]}, {name}={value!r} is not possible")
        if name in ("isFilledWithLiquid", "fillLiquid", "fillLitres"):
            self._set_filling(item, name, value)
            return
        if name == "isBroken" and value and item.state.fillLitres > 0.0:
            self._liquids.spill(item)
        setattr(item.state, name, value)
        target = links.get(object_id)
        if name == "isToggled" and target is not None and self._scene.object(target).type.has("heat_source"):
            self.set_state(target, name, value)
        self._appearance.update(item)

    def set_mass(self, object_id: str, mass_kg: float) -> None:
        """Sets the mass of an object without its contents."""
        item = self._scene.object(object_id)
        item.mass_kg = mass_kg
        self._masses.update(item)

    def save(self) -> dict[str, dict[str, Any]]:
        """States, holders, openness and mass by object id."""
        return {
            name: {
                "state": copy_state(item.state),
                "held_by": list(item.held_by),
                "openness": item.openness,
                "mass_kg": item.mass_kg,
            }
            for name, item in self._scene.objects.items()
        }

    def restore(self, saved: dict[str, dict[str, Any]]) -> None:
        """Returns to states of `save`."""
        for name, values in saved.items():
            item = self._scene.objects[name]
            item.state = ObjectState(**values["state"])
            item.held_by = list(values["held_by"])
            item.openness, item.mass_kg = values["openness"], values["mass_kg"]

    def _set_filling(self, item: ObjectInstance, name: str, value: bool | float | str) -> None:
        """Fills or empties a vessel by hand; the ledger takes it as given."""
        before, full = item.state.fillLitres, item.type.volume_l
        liquid = item.state.fillLiquid or "water"
        if name == "fillLiquid":
            if value not in ("", *LIQUIDS):
                raise WorldError(f"unknown liquid {value!r}; allowed: {', '.join(LIQUIDS)}")
            level, liquid = (before or full) if value else 0.0, str(value)
        elif name == "fillLitres":
            level = float(value)
            if not 0.0 <= level <= full + 1e-9:
                raise WorldError(f"{item.object_id} holds 0 to {full:g} litres, got {value!r}")
        else:
            level = full if value else 0.0
        self._liquids.set_level(item, level, liquid)
        self._liquids.given += item.state.fillLitres - before
