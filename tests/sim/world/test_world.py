"""The running world: time, targets, grasps, states, containment, free spots."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from interface.bodies import SIDES
from robots.spec import load_robot
from sim.interfaces.metadata import world_metadata
from sim.scene.objects import STATE_NAMES, ObjectPlacement
from sim.scene.rooms import room_names
from sim.world.world import World, WorldError


@pytest.fixture(params=["h1", "x1"])
def world(request: pytest.FixtureRequest) -> World:
    return World(load_robot(request.param), "kitchen_1")


def _furnished(*placements: ObjectPlacement, **kwargs: object) -> World:
    return World(None, "kitchen_1", placements, **kwargs)  # type: ignore[arg-type]


@pytest.mark.parametrize("room", room_names())
def test_default_objects_rest_on_their_receptacles(room: str) -> None:
    for seed in (0, 1, 2):
        world = World(None, room, seed=seed)
        for item in world.room.objects:
            assert world.containment.parents(item.id)[0] == item.receptacle
        before = {item.id: world.poses.center(item.id) for item in world.room.objects}
        world.advance(1.0)
        for name, center in before.items():
            assert np.linalg.norm(world.poses.center(name) - center) < 0.004, name


def test_same_seed_same_world() -> None:
    a, b, c = (World(None, "kitchen_1", seed=seed) for seed in (3, 3, 4))
    assert np.array_equal(a.data.qpos, b.data.qpos)
    assert not np.array_equal(a.data.qpos, c.data.qpos)


def test_objects_leave_room_for_a_hand() -> None:
    world = World(None, "kitchen_1")
    names = [item.id for item in world.room.objects]
    for i, a in enumerate(names):
        for b in names[i + 1 :]:
            assert np.linalg.norm(world.poses.center(a) - world.poses.center(b)) > 0.2, (a, b)


def test_base_and_joints_follow_their_targets(world: World) -> None:
    x, y, _, yaw = world.servos.base_pose
    arm = world.robot.arms["left"]  # type: ignore[union-attr]
    goal = {name: value + 0.15 for name, value in zip(arm.joints, arm.rest, strict=True)}
    low = world.robot.pelvis_height_range_m[0]  # type: ignore[union-attr]
    world.servos.command_height(low + 0.05)
    for k in range(1, 41):
        world.servos.set_base_target(x=x + 0.01 * k, yaw=yaw + 0.01 * k)
        world.servos.set_joint_targets({name: goal[name] - 0.15 * (1 - k / 40) for name in goal})
        world.advance(0.05)
    world.advance(0.5)
    assert world.servos.base_pose == pytest.approx([x + 0.4, y, low + 0.05, yaw + 0.4], abs=4e-3)
    reached = world.servos.joint_positions()
    limits = {name: world.model.joint(name).range for name in goal}
    for name, value in goal.items():
        assert reached[name] == pytest.approx(np.clip(value, *limits[name]), abs=0.03), name


def test_hands_open_and_close(world: World) -> None:
    for arm in SIDES:
        assert world.servos.hand_opening(arm) > 0.9
        world.servos.set_hand(arm, 0.0)
    world.advance(1.0)
    for arm in SIDES:
        assert world.servos.hand_opening(arm) < 0.15


def test_recorder_runs_at_20_hz(world: World) -> None:
    window = world.motion()
    assert window.root_pose.shape == (64, 7)
    assert window.key_bodies.shape == (64, 14, 3)
    assert window.hands.shape == (64, 2)
    first = window.root_pose[-1].copy()
    world.servos.set_base_target(x=first[0] + 0.02)
    world.advance(0.5)
    moved = np.abs(world.motion().root_pose[:, 0] - first[0]) > 1e-6
    assert moved.sum() == 10
    with pytest.raises(ValueError, match="frames 65"):
        world.motion(65)


def test_steps_of_any_multiple_give_the_same_future() -> None:
    a, b = World(load_robot("x1"), "kitchen_1"), World(load_robot("x1"), "kitchen_1")
    for w, dt in ((a, 0.02), (b, 0.1)):
        w.servos.set_base_target(x=0.0)
        for _ in range(round(1.0 / dt)):
            w.advance(dt)
    assert np.array_equal(a.data.qpos, b.data.qpos)
    with pytest.raises(WorldError, match="positive multiple"):
        a.advance(0.007)


def test_attached_object_follows_the_hand_and_is_released(world: World) -> None:
    """Here the mug is put into the hand by the test itself; skills need contact first."""
    world.advance(3.0)  # long enough for the mug to fall asleep
    mug = world.object("Mug_1")
    hand = world.servos.grasp_pose("right")[:3, 3]
    world.data.qpos[mug.qpos_adr : mug.qpos_adr + 3] = hand - (0.0, 0.0, 0.05)
    mujoco.mj_forward(world.model, world.data)
    world.grasps.attach("right", "Mug_1")
    assert world.grasps.held("right") == "Mug_1"
    world.advance(0.1)
    site = int(world.model.site(world.robot.arms["right"].grasp_site).id)  # type: ignore[union-attr]
    offset = world.poses.center("Mug_1") - world.data.site_xpos[site]
    x = world.servos.base_pose[0]
    for k in range(20):
        world.servos.set_base_target(x=x - 0.02 * k)
        world.advance(0.05)
    world.advance(0.4)
    assert world.servos.base_pose[0] < x - 0.3
    assert world.poses.center("Mug_1") - world.data.site_xpos[site] == pytest.approx(offset, abs=0.01)
    assert not world.containment.parents("Mug_1")
    entry = next(e for e in world_metadata(world)["objects"] if e["objectId"] == "Mug_1")
    assert entry["isPickedUp"] and entry["heldBy"] == ["right"]
    with pytest.raises(WorldError, match="already holds Mug_1"):
        world.grasps.attach("right", "Plate_1")
    with pytest.raises(WorldError, match="furniture"):
        world.grasps.attach("left", "DiningTable_1")
    world.servos.set_hand("right", 1.0)
    assert world.grasps.detach("right") == "Mug_1"
    assert world.grasps.detach("right") is None
    world.advance(2.0)
    assert world.poses.center("Mug_1")[2] < 0.2  # it fell
    assert not world.grasps.constraints.released  # type: ignore[union-attr]


def test_door_follows_the_hand_about_its_hinge() -> None:
    world = World(load_robot("x1"), "kitchen_1", [], start=(-2.2, -0.15, np.pi))
    world.advance(3.0)
    handle, hand = world.poses.handle("Drawer_1"), world.servos.grasp_pose("right")[:3, 3]
    world.data.ctrl[[world.model.actuator(n).id for n in ("base_x", "base_y", "base_z")]] += handle - hand
    for name, delta in zip(("base_x", "base_y", "base_z"), handle - hand, strict=True):
        world.data.qpos[world.model.joint(name).qposadr[0]] += delta
    mujoco.mj_forward(world.model, world.data)
    world.grasps.attach("right", "Drawer_1")
    x = float(world.servos.base_target[0])
    for k in range(30):
        world.servos.set_base_target(x=x + 0.2 * k / 30)
        world.advance(0.05)
    assert world.object("Drawer_1").openness == pytest.approx(0.2 / 0.26, abs=0.15)
    assert world.object("Drawer_1").is_open
    assert world.grasps.detach("right") == "Drawer_1"


def test_contents_of_open_and_closed_receptacles() -> None:
    world = _furnished(
        ObjectPlacement("Apple_1", "Fridge_1"), ObjectPlacement("Bowl_1", "DiningTable_1"), ObjectPlacement("Egg_1", "Bowl_1")
    )
    assert world.containment.parents("Apple_1") == ("Fridge_1",)
    assert world.containment.parents("Egg_1") == ("Bowl_1", "DiningTable_1")
    assert set(world.containment.contents("DiningTable_1")) == {"Bowl_1", "Egg_1"}
    assert not world.object("Fridge_1").is_open
    assert world.containment.free_spot("Fridge_1", 0.05) is None  # the door is closed
    assert world.containment.total_mass_kg("Bowl_1") == pytest.approx(0.47 + 0.05)
    table_kg = world.object("DiningTable_1").mass_kg
    assert world.containment.total_mass_kg("DiningTable_1") == pytest.approx(table_kg + 0.47 + 0.05)


@pytest.mark.parametrize("receptacle", ["Fridge_1", "Cabinet_1", "Drawer_1", "Microwave_1"])
def test_free_spot_inside_open_furniture(receptacle: str) -> None:
    world = _furnished(states={receptacle: {"isOpen": True}})
    spot = world.containment.free_spot(receptacle, 0.05)
    assert spot is not None
    low, high = world.poses.bounds(receptacle)
    slack = 0.3 if receptacle == "Drawer_1" else 0.0  # the tray is pulled out
    assert np.all(spot > low - slack) and np.all(spot < high + slack)


def test_free_spot_keeps_clear_and_near() -> None:
    world = World(None, "kitchen_1")
    near = world.poses.center("Apple_1")
    spot = world.containment.free_spot("DiningTable_1", 0.06, near=near)
    assert spot is not None
    assert 0.05 < np.linalg.norm(spot[:2] - near[:2]) < 0.3
    drawn = world.containment.free_spot("DiningTable_1", 0.06, rng=np.random.default_rng(0))
    assert drawn is not None and drawn[2] == pytest.approx(0.79)
    assert world.containment.free_spot("Plate_1", 0.3) is None or world.objects["Plate_1"].surfaces
    assert world.containment.free_spot("GarbageCan_1", 0.5) is None


def test_explicit_places_are_respected_or_refused() -> None:
    world = _furnished(ObjectPlacement("Mug_1", "DiningTable_1", (1.5, -1.0), 30.0))
    assert world.poses.pose("Mug_1")[:2, 3] == pytest.approx([1.5, -1.0], abs=0.005)
    with pytest.raises(WorldError, match="does not fit at"):
        _furnished(ObjectPlacement("Mug_1", "DiningTable_1", (-2.0, 2.0)))
    with pytest.raises(WorldError, match="no room for Box_1 on Shelf_1"):
        _furnished(ObjectPlacement("Box_1", "Shelf_1"))
    with pytest.raises(WorldError, match="exists twice"):
        _furnished(ObjectPlacement("Mug_1", "Shelf_1"), ObjectPlacement("Mug_1", "Shelf_1"))
    with pytest.raises(WorldError, match="before that has its own place"):
        _furnished(ObjectPlacement("Egg_1", "Bowl_1"), ObjectPlacement("Bowl_1", "DiningTable_1"))


def test_states_are_checked_and_seen() -> None:
    world = World(None, "kitchen_1")
    assert set(STATE_NAMES) >= {"isToggled", "isBroken", "isDirty"}
    with pytest.raises(WorldError, match="unknown state 'isHappy'"):
        world.states.set_state("Mug_1", "isHappy", True)
    with pytest.raises(WorldError, match="not toggleable"):
        world.states.set_state("Mug_1", "isToggled", True)
    with pytest.raises(WorldError, match="unknown object 'Mug_7'"):
        world.states.set_state("Mug_7", "isDirty", True)
    with pytest.raises(WorldError, match="no door"):
        _furnished(states={"DiningTable_1": {"isOpen": True}})
    geoms = world.object("Mug_1").geom_ids
    before = world.model.geom_rgba[geoms].copy()
    world.states.set_state("Mug_1", "isDirty", True)
    assert not np.array_equal(before, world.model.geom_rgba[geoms])


def test_liquid_adds_mass() -> None:
    world = World(load_robot("h1"), "kitchen_1")
    assert not world.containment.needs_two_hands("Pot_1")
    world.states.set_state("Pot_1", "fillLiquid", "water")
    assert world.containment.total_mass_kg("Pot_1") == pytest.approx(0.57 + 2.4)
    assert world.containment.needs_two_hands("Pot_1")
    world.advance(0.1)
    assert world.model.body_mass[world.object("Pot_1").body_id] == pytest.approx(0.57 + 2.4)
    world.states.set_state("Pot_1", "isFilledWithLiquid", False)
    assert world.containment.total_mass_kg("Pot_1") == pytest.approx(0.57)


def test_knob_heats_and_tap_fills_and_fridge_cools() -> None:
    world = _furnished(
        ObjectPlacement("Pot_1", "StoveBurner_1"), ObjectPlacement("Potato_1", "Pot_1"),
        ObjectPlacement("Mug_1", "SinkBasin_1", (0.12, 2.40)), ObjectPlacement("Apple_1", "Fridge_1"),
    )  # fmt: skip
    world.states.set_state("StoveKnob_1", "isToggled", True)
    world.states.set_state("Faucet_1", "isToggled", True)
    assert world.object("StoveBurner_1").state.isToggled
    world.advance(15.0)
    state = {entry["objectId"]: entry for entry in world_metadata(world)["objects"]}
    assert state["Potato_1"]["isCooked"] and state["Potato_1"]["temperature"] == "Hot"
    assert state["Mug_1"]["fillLiquid"] == "water" and state["SinkBasin_1"]["isFilledWithLiquid"]
    assert state["Apple_1"]["temperature"] == "Cold"


def test_a_microwave_cooks_behind_its_door() -> None:
    food = ObjectPlacement("Potato_1", "Microwave_1")
    for openness in (True, False):
        world = _furnished(food, states={"Microwave_1": {"isOpen": openness}})
        world.states.set_state("Microwave_1", "isToggled", True)
        world.advance(15.0)
        assert world.object("Potato_1").state.isCooked is not openness


def test_fall_breaks_what_is_breakable() -> None:
    world = _furnished(ObjectPlacement("Plate_1", "DiningTable_1"), ObjectPlacement("Apple_1", "DiningTable_1"))
    for name, x in (("Plate_1", -1.0), ("Apple_1", 1.0)):
        adr = world.object(name).qpos_adr
        world.data.qpos[adr : adr + 3] = (x, 0.0, 1.2)
    world.advance(1.5)
    assert world.object("Plate_1").state.isBroken
    assert not world.object("Apple_1").state.isBroken


def test_metadata_has_ai2thor_names() -> None:
    record = world_metadata(World(load_robot("x1"), "living_room_1"))
    entry = record["objects"][0]
    names = """objectId objectType position rotation isOpen openness isToggled isPickedUp parentReceptacles receptacleObjectIds
        mass axisAlignedBoundingBox temperature isBroken isFilledWithLiquid isDirty"""
    for name in names.split():
        assert name in entry
    assert record["sceneName"] == "living_room_1"
    assert record["agent"]["name"] == "x1"


def test_unknown_joints_and_parts_are_refused() -> None:
    world = World(load_robot("x1"), "kitchen_1", [])
    with pytest.raises(WorldError, match="'tail' has no actuator"):
        world.servos.set_joint_targets({"tail": 0.0})
    with pytest.raises(WorldError, match="unknown joint 'tail'"):
        World(load_robot("x1"), "kitchen_1", [], joint_positions={"tail": 0.0})
    with pytest.raises(WorldError, match="no handle"):
        world.poses.handle("DiningTable_1")
    with pytest.raises(WorldError, match="no switch"):
        world.poses.toggle_point("DiningTable_1")
    with pytest.raises(WorldError, match="no robot"):
        World(None, "kitchen_1", []).motion()


def test_diverged_physics_is_an_error() -> None:
    world = World(None, "kitchen_1")
    world.data.qvel[:] = 1e9
    with pytest.raises(WorldError, match="diverged"):
        world.advance(0.05)


def test_pushing_a_carrier_wakes_what_it_carries() -> None:
    """Objects at rest sleep; one that loses its support falls."""
    world = World(
        load_robot("x1"), "living_room_1", [ObjectPlacement("Apple_1", "Drawer_1")], states={"Drawer_1": {"isOpen": True}}
    )
    world.advance(3.0)
    drawer, before = world.object("Drawer_1").moving[0], world.poses.center("Apple_1")
    world.data.qfrc_applied[drawer.dof_adr] = -12.0
    world.advance(0.7)
    world.data.qfrc_applied[drawer.dof_adr] = 0.0
    assert world.object("Drawer_1").openness < 0.5
    assert np.linalg.norm(world.poses.center("Apple_1") - before) > 0.05
