"""Restoring a snapshot gives bit-equal futures."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
import pytest

from robots.spec import load_robot
from sim.interfaces.metadata import world_metadata
from sim.scene.objects import ObjectPlacement
from sim.world.world import World, WorldError


def _trace(world: World) -> tuple[Any, ...]:
    x = float(world.servos.base_pose[0])
    for k in range(20):
        world.servos.set_base_target(x=x + 0.01 * k)
        world.servos.set_hand("left", 1.0 - k / 20)
        world.advance(0.05)
    window = world.motion()
    return world.data.qpos.copy(), world.data.qvel.copy(), window.key_bodies, world.rng.random(4), world_metadata(world)


def _same(a: Any, b: Any) -> bool:
    return all(np.array_equal(x, y) if isinstance(x, np.ndarray) else x == y for x, y in zip(a, b, strict=True))


@pytest.mark.parametrize("robot", ["h1", "x1"])
def test_future_is_bit_equal_with_a_held_object(robot: str) -> None:
    world = World(load_robot(robot), "kitchen_1", seed=5)
    mug = world.object("Mug_1")
    world.data.qpos[mug.qpos_adr : mug.qpos_adr + 3] = world.servos.grasp_pose("right")[:3, 3]
    mujoco.mj_forward(world.model, world.data)
    world.grasps.attach("right", "Mug_1")
    world.states.set_state("Mug_1", "fillLiquid", "coffee")
    world.advance(0.535)
    snapshot = world.save()
    first = _trace(world)
    world.grasps.detach("right")
    world.states.set_state("Mug_1", "isBroken", True)
    world.states.set_state("Faucet_1", "isToggled", True)
    world.advance(1.0)
    world.restore(snapshot)
    assert world.grasps.held("right") == "Mug_1"
    assert world.object("Mug_1").state.fillLiquid == "coffee"
    assert _same(first, _trace(world))


def test_snapshot_carries_over_to_an_equal_world() -> None:
    a, b = World(load_robot("x1"), "kitchen_1", seed=1), World(load_robot("x1"), "kitchen_1", seed=2)
    a.advance(0.3)
    b.restore(a.save())
    assert _same(_trace(a), _trace(b))


def test_saving_changes_nothing() -> None:
    a, b = World(load_robot("x1"), "kitchen_1"), World(load_robot("x1"), "kitchen_1")
    a.advance(0.2)
    a.save()
    b.advance(0.2)
    assert _same(_trace(a), _trace(b))


def test_sleeping_objects_stay_bit_equal() -> None:
    world = World(load_robot("x1"), "kitchen_1")
    world.advance(3.0)
    snapshot = world.save()
    first = _trace(world)
    world.data.qvel[world.object("Mug_1").dof_adr] = 0.5
    world.advance(0.5)
    world.restore(snapshot)
    assert _same(first, _trace(world))


def test_other_scenes_are_refused() -> None:
    with pytest.raises(WorldError, match="another scene"):
        World(None, "kitchen_1").restore(World(None, "kitchen_1", [ObjectPlacement("Mug_1", "Shelf_1")]).save())
