"""The facts of a simulated world, taken from physics: what preconditions, goals and the expert read."""

from __future__ import annotations

from interface.bodies import Arm
from interface.facts import Facts, ObjectFacts
from sim.world.world import World


def world_facts(world: World) -> Facts:
    """What is the case now."""
    objects, robot = world.objects, world.robot
    parents = world.containment.all_parents()
    mass_kg = world.containment.masses_kg(parents)
    loads_kg = (float("inf"), float("inf")) if robot is None else (robot.max_load_kg(1), robot.max_load_kg(2))
    puddles = {puddle.surface for puddle in world.liquids.puddles}
    switches = {target: switch for switch, target in reversed([*world.room.links.items()])}

    def facts_of(name: str) -> ObjectFacts:
        obj = objects[name]
        kind, state = obj.type, obj.state
        source = name if kind.spouts else switches.get(name, name)
        return ObjectFacts(
            object_id=name,
            can=obj.can,
            holders=tuple(obj.held_by),
            carriers=parents.get(name, ()),
            two_handed=obj.movable and (kind.two_handed or mass_kg[name] > loads_kg[0]),
            mass_kg=mass_kg[name],
            openness=obj.openness,
            self_closing=obj.self_closing,
            on=state.isToggled,
            switch=name if kind.toggleable else switches.get(name),
            fill=state.fillLitres / kind.volume_l if kind.fillable else 0.0,
            dirty=state.isDirty,
            wet=name in puddles,
            sliced=state.isSliced,
            cooked=state.isCooked,
            used_up=state.isUsedUp,
            broken=state.isBroken,
            outlet=source if objects[source].type.spouts else None,
        )

    held: dict[Arm, str | None] = dict.fromkeys(Arm)
    lifted = None
    for name, obj in objects.items():
        if len(obj.held_by) == 2:
            lifted = name
        elif obj.held_by:
            held[Arm(obj.held_by[0])] = name
    return Facts({name: facts_of(name) for name in objects}, held, lifted, loads_kg)
