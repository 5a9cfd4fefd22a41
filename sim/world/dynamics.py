"""What changes by itself besides rigid bodies: heat, liquids (`sim.world.liquids`), breakage by impact, and how states look.

Simple laws on purpose: a temperature approaches that of its surroundings exponentially, a breakable object that stops from more
than 2.6 m/s (a fall of 0.35 m) within one recorder frame breaks. What is cooked, broken, sliced or used up stays so. Paper:
state changes of DualTHOR.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from sim.scene.objects import ROOM_TEMPERATURE_C
from sim.world import liquids

if TYPE_CHECKING:
    from sim.scene.objects import ObjectInstance
    from sim.world.world import World

__all__ = ["BREAK_SPEED_M_S", "TICK_S", "break_by_impact", "look", "tick"]

TICK_S: Final = 1.0
BREAK_SPEED_M_S: Final = 2.6
_COOKED_C: Final = 65.0
_SECONDS: Final = {"heat": 8.0, "cold": 20.0, "room": 90.0}


def tick(world: World) -> None:
    """One second of liquids, heat and cooking."""
    liquids.flow(world, TICK_S)
    active = [thing for thing in world.objects.values() if thing.state.isToggled]
    cold = [thing for thing in world.objects.values() if thing.type.has("cold_source")]
    if not active and all(abs(t.state.temperature - ROOM_TEMPERATURE_C) < 0.5 for t in world.objects.values()) and not cold:
        return
    parents = world.all_parents()
    for name, above in parents.items():
        thing = world.objects[name]
        target, seconds = ROOM_TEMPERATURE_C, _SECONDS["room"]
        for parent in (world.objects[p] for p in above):
            if parent.type.has("heat_source") and parent.state.isToggled:
                target, seconds = 95.0, _SECONDS["heat"]
            elif parent.type.has("cold_source") and not parent.is_open:
                target, seconds = 4.0, _SECONDS["cold"]
        state = thing.state
        state.temperature += (target - state.temperature) * (1.0 - float(np.exp(-TICK_S / seconds)))
        if thing.type.has("cookable") and state.temperature > _COOKED_C and not state.isCooked:
            world.set_state(name, "isCooked", True)


def break_by_impact(world: World, before: dict[str, float]) -> None:
    """Breaks breakable objects that lost their speed at once; `before` maps ids to the speed (m/s) one frame ago."""
    for name, thing in world.objects.items():
        if not thing.movable or not thing.type.has("breakable") or thing.state.isBroken or thing.held_by:
            continue
        if before.get(name, 0.0) > BREAK_SPEED_M_S and world.speed_of(name) < 0.5 * before[name]:
            world.set_state(name, "isBroken", True)


def look(world: World, thing: ObjectInstance) -> None:
    """Sets the colours that show an object's state: lit lamps and screens, liquid, dirt, browning, breakage."""
    model, state, colors = world.model, thing.state, world.catalogue.colors
    for geom, part in world.part_of_geom[thing.object_id]:
        rgba = np.array(colors[part.color], dtype=float)
        if "liquid" in part.options:
            rgba = liquids.color_of(world, state.fillLiquid)
            if state.fillLitres <= 0.0:
                rgba[3] = 0.0
            world.show_level(thing, geom, part)
        elif part.options & {"whole", "slice"} and state.isSliced != ("slice" in part.options):
            rgba[3] = 0.0
        elif "glow" in part.options:
            if state.isToggled:
                rgba = np.array(colors.get(f"{part.color}_on", colors[part.color]), dtype=float)
            elif "hidden" in part.options:
                rgba[3] = 0.0
            material = int(model.geom_matid[geom])
            if material >= 0:
                model.mat_emission[material] = 0.7 if state.isToggled else 0.0
        elif state.isBroken:
            rgba[:3] = 0.35 * rgba[:3]
        else:
            if state.isCooked:
                rgba[:3] *= (0.55, 0.42, 0.30)
            if state.isDirty:
                rgba[:3] = 0.55 * rgba[:3] + 0.45 * np.array([0.30, 0.22, 0.12])
        model.geom_rgba[geom] = rgba
