"""Rooms and the scene builder."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from sim.scene.catalogue import load_catalogue
from sim.scene.compiler import BASE_JOINTS, SceneKey, compile_scene
from sim.scene.objects import index_object
from sim.scene.rooms import DefaultObject, Furniture, Room, load_room, room_names
from sim.skills.navigation import NavigationMap, Rectangle
from sim.world.placement import box_in_world
from sim.world.world import World

ROOMS = room_names()


def test_rooms_use_every_type() -> None:
    used = {item.id.rsplit("_", 1)[0] for name in ROOMS for item in (*load_room(name).furniture, *load_room(name).objects)}
    assert used == set(load_catalogue().types) and len(ROOMS) == 10


@pytest.mark.parametrize("room", ROOMS)
def test_furniture_stands_inside_and_apart(room: str) -> None:
    world = World(None, room, [], settle_s=0.1)
    x0, y0, x1, y1 = world.room.bounds
    boxes = {name: world.poses.bounds(name) for name in world.objects}
    for name, (low, high) in boxes.items():
        assert low[0] >= x0 - 0.02 and low[1] >= y0 - 0.02 and high[0] <= x1 + 0.02 and high[1] <= y1 + 0.02, name
        assert low[2] >= -0.001, name
    names = list(boxes)
    for i, a in enumerate(names):
        for b in names[i + 1 :]:
            overlap = np.minimum(boxes[a][1], boxes[b][1]) - np.maximum(boxes[a][0], boxes[b][0])
            assert overlap.min() < 0.045, (a, b, overlap)
    assert world.data.ncon == 0


@pytest.mark.parametrize("room", ROOMS)
def test_every_receptacle_can_be_approached(room: str) -> None:
    world = World(None, room, [], settle_s=0.1)
    rectangles = []
    for name in world.objects:
        low, high = world.poses.bounds(name)
        if low[2] < 1.9:
            rectangles.append(Rectangle(tuple((low[:2] + high[:2]) / 2), tuple((high[:2] - low[:2]) / 2)))
    free = NavigationMap(world.room.bounds, rectangles, 0.35)
    start = np.asarray(world.room.start[:2])
    assert free.is_free(start)
    for name in world.objects:
        low, high = world.poses.bounds(name)
        surfaces = world.objects[name].surfaces
        sides = [world.poses.front(name)] + ([-world.poses.front(name)] if any(s.spec.all_sides for s in surfaces) else [])
        stances = [world.poses.center(name)[:2] + side * (0.5 * float((high - low)[:2] @ np.abs(side)) + 0.4) for side in sides]
        near = [stance + np.array([dx, dy]) for stance in stances for dx in (-0.2, 0.0, 0.2) for dy in (-0.2, 0.0, 0.2)]
        if name.startswith(("Chair", "Faucet", "SinkBasin", "Stove", "Microwave", "Television", "Toaster", "CoffeeMachine")):
            continue  # on or at other furniture
        assert any(free.is_free(p) and free.path(start, p) is not None for p in near), name


def test_base_replaces_the_free_joint() -> None:
    world = World(_h1(), "kitchen_1", [], settle_s=0.05)
    names = [world.model.joint(i).name for i in range(world.model.njnt)]
    assert tuple(names[: len(BASE_JOINTS)]) == BASE_JOINTS
    assert int(mujoco.mjtJoint.mjJNT_FREE) not in set(map(int, world.model.jnt_type))


def test_equal_scenes_share_one_compilation() -> None:
    key = SceneKey("", "", "", (), ROOMS[0], ("Mug_1",))
    assert compile_scene(key) is compile_scene(key)
    assert World(None, ROOMS[0], []).model is not World(None, ROOMS[0], []).model


def test_door_swings_out_of_the_body() -> None:
    """The open door of every opening type lies in front of it."""
    world = World(
        None, "kitchen_1", [], states={name: {"isOpen": True} for name in ("Fridge_1", "Cabinet_1", "Microwave_1", "Drawer_1")}
    )
    for name in ("Fridge_1", "Cabinet_1", "Microwave_1", "Drawer_1"):
        offset = (world.poses.handle(name) - world.poses.center(name))[:2] @ world.poses.front(name)
        low, high = world.poses.bounds(name)
        assert offset > 0.15 + 0.5 * float(np.abs((high - low)[:2]) @ np.abs(world.poses.front(name))), name


def test_fixtures_cannot_be_placed() -> None:
    with pytest.raises(ValueError, match="Fridge_9 is a fixture"):
        compile_scene(SceneKey("", "", "", (), ROOMS[0], ("Fridge_9",)))


def test_bad_rooms_are_refused() -> None:
    with pytest.raises(ValueError, match="unknown room 'attic'"):
        load_room("attic")
    base = {
        "name": "x", "category": "kitchen", "bounds": (-1.0, -1.0, 1.0, 1.0), "wall_height": 2.0, "wall_colors": (),
        "floor_colors": ((0.0,) * 3, (0.0,) * 3), "start": (0.0, 0.0, 0.0),
    }  # fmt: skip
    table = Furniture("DiningTable_1", (0.0, 0.0))
    with pytest.raises(ValueError, match="'Table' is not of the form"):
        Room(**base, furniture=(Furniture("Table", (0.0, 0.0)),))
    with pytest.raises(ValueError, match="ids repeat"):
        Room(**base, furniture=(table, table))
    with pytest.raises(ValueError, match="names no furniture"):
        Room(**base, furniture=(table,), links={"DiningTable_1": "Fridge_1"})
    with pytest.raises(ValueError, match="lies on unknown 'Desk_1'"):
        Room(**base, furniture=(table,), objects=(DefaultObject("Mug_1", "Desk_1"),))


def test_box_follows_the_body() -> None:
    world = World(None, "kitchen_1", [])
    obj = index_object(world.model, "Cabinet_1", load_catalogue())
    low, high = box_in_world(world.data, obj)
    assert (high - low)[1] == pytest.approx(0.47, abs=0.02)  # turned by 90 degrees


def _h1():
    from robots.spec import load_robot

    return load_robot("h1")
