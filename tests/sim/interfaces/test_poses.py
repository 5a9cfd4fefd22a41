"""Poses asked for and set by hand: privileged, checked, and undone exactly."""

from __future__ import annotations

import numpy as np
import pytest

from interface.bodies import Arm
from interface.steps import Action
from sim.interfaces.controller import Controller
from sim.interfaces.poses import random_placements
from sim.world.world import World, WorldError


@pytest.fixture(scope="module")
def controller():
    made = Controller("x1", "kitchen_1", width=48, height=48, privileged=True)
    yield made
    made.stop()


def test_from_an_interactable_pose_the_arm_reaches(controller: Controller) -> None:
    controller.reset()
    poses = controller.step("GetInteractablePoses", objectId="Bottle_1").metadata["actionReturn"]
    assert 1 <= len(poses) <= 100
    session = controller.session
    session.observation()
    reached = 0
    for pose in poses:
        session.teleport(pose["x"], pose["y"], np.radians(pose["rotation"]), pose["z"])
        session.observation()
        failure = session.assess(Action("Pick", arm=Arm(pose["arms"][0]), object_id="Bottle_1"))
        reached += failure is None
    assert reached >= len(poses) / 2
    assert controller.step("GetInteractablePoses", objectId="Faucet_1").metadata["actionReturn"] == []  # too far for X1


def test_objects_are_put_where_asked(controller: Controller) -> None:
    controller.reset()
    world = controller.session.world
    before = world.poses.pose("Mug_1")[:3, 3].copy()
    spot = world.containment.free_spot("DiningTable_1", 0.08, height_m=0.1)
    assert spot is not None
    target = {"x": float(spot[0]), "y": float(spot[1]), "z": float(spot[2]) + 0.002}
    pose = {"objectName": "Mug_1", "position": target, "rotation": {"x": 0, "y": 0, "z": 90}}
    event = controller.step("SetObjectPoses", objectPoses=[pose])
    assert event.metadata["lastActionSuccess"]
    assert world.poses.pose("Mug_1")[:2, 3] == pytest.approx(spot[:2], abs=0.01)
    assert world.poses.pose("Mug_1")[:3, 0] == pytest.approx([0.0, 1.0, 0.0], abs=0.02)
    assert world.containment.parents("Mug_1")[0] == "DiningTable_1"
    controller.step("Undo")
    assert np.array_equal(world.poses.pose("Mug_1")[:3, 3], before)


@pytest.mark.parametrize(
    ("pose", "message"),
    [
        ({"objectName": "Mug_9", "position": {"x": 0, "y": 0, "z": 0}}, "unknown object 'Mug_9'"),
        ({"objectName": "Fridge_1", "position": {"x": 0, "y": 0, "z": 0}}, "Fridge_1 is furniture"),
        ({"objectName": "Mug_1", "position": {"x": 0, "y": 0}}, "position must be a mapping of three numbers"),
        ({"objectName": "Mug_1", "position": {"x": 0, "y": float("nan"), "z": 0}}, "position must be finite"),
        ({"objectName": "Mug_1", "position": {"x": 9, "y": 0, "z": 0}}, "outside the room"),
        ({"objectName": "Mug_1", "position": {"x": -1.15, "y": 2.44, "z": 0.4}}, "would overlap with CounterTop_1"),
        ({"objectName": "Mug_1", "where": 1}, "unknown key 'where'"),
        ("Mug_1", "an object pose is a mapping"),
    ],
)
def test_impossible_poses_change_nothing(controller: Controller, pose: object, message: str) -> None:
    controller.reset()
    before = controller.session.world.data.qpos.copy()
    with pytest.raises(WorldError, match=message):
        controller.step("SetObjectPoses", objectPoses=[pose])
    assert np.array_equal(controller.session.world.data.qpos, before)


def test_random_spawn_is_seeded_and_everything_rests(controller: Controller) -> None:
    first = controller.step("InitialRandomSpawn", randomSeed=3).metadata["actionReturn"]
    world = controller.session.world
    assert {entry["objectId"] for entry in first} == {item.id for item in world.room.objects}
    for entry in first:
        assert world.containment.parents(entry["objectId"])[0] == entry["receptacle"]
    poses = world.data.qpos.copy()
    again = controller.step("InitialRandomSpawn", randomSeed=3).metadata["actionReturn"]
    assert again == first and np.array_equal(controller.session.world.data.qpos, poses)
    assert controller.step("InitialRandomSpawn", randomSeed=4).metadata["actionReturn"] != first


def test_random_spawn_leaves_out_what_is_excluded() -> None:
    rng = np.random.default_rng(0)
    placed = {
        p.object_id: p.receptacle
        for p in random_placements("kitchen_1", rng, excluded_receptacles=["CounterTop", "Shelf_1"], excluded_objects=["Pot"])
    }
    assert placed["Pot_1"] == "StoveBurner_2"
    assert not set(placed.values()) & {"CounterTop_1", "CounterTop_2", "Shelf_1"}
    with pytest.raises(WorldError, match="unknown 'Bath' in kitchen_1"):
        random_placements("kitchen_1", rng, excluded_receptacles=["Bath"])


def test_teleport_takes_along_what_is_held() -> None:
    from robots.spec import load_robot

    world = World(load_robot("h1"), "kitchen_1")
    hand = world.servos.grasp_pose("left")
    mug = world.objects["Mug_1"]
    world.data.qpos[mug.qpos_adr : mug.qpos_adr + 3] = hand[:3, 3] - (0, 0, 0.05)
    world.grasps.put_base(*world.servos.base_pose[[0, 1, 3]])
    world.grasps.attach("left", "Mug_1")
    world.advance(0.1)
    offset = np.linalg.inv(world.servos.grasp_pose("left")) @ world.poses.pose("Mug_1")
    world.grasps.put_base(0.6, -0.4, 1.0, 0.8)
    assert np.linalg.inv(world.servos.grasp_pose("left")) @ world.poses.pose("Mug_1") == pytest.approx(offset, abs=1e-9)
    world.advance(0.2)
    assert world.servos.base_pose == pytest.approx([0.6, -0.4, 0.8, 1.0], abs=5e-3)
    assert np.linalg.norm((np.linalg.inv(world.servos.grasp_pose("left")) @ world.poses.pose("Mug_1") - offset)[:3, 3]) < 0.01


@pytest.mark.parametrize(
    ("call", "message"),
    [
        ({"action": "GetInteractablePoses", "objectId": "Mug_7"}, "unknown object 'Mug_7'"),
        ({"action": "GetInteractablePoses", "objectId": "Mug_1", "maxPoses": 0}, "maxPoses 0 outside"),
        ({"action": "InitialRandomSpawn", "randomSeed": -1}, "randomSeed must be an integer from 0"),
        ({"action": "InitialRandomSpawn", "excludedObjectIds": "Mug"}, "must be a list"),
        ({"action": "SetObjectPoses", "objectPoses": "Mug"}, "objectPoses must be a list"),
        ({"action": "TP", "x": "left"}, "TP: x must be a number"),
        ({"action": "TP", "position": [1, 2]}, "position must be a mapping"),
        ({"action": "MoveAhead", "amount": float("inf")}, "amount must be a finite number"),
        ({"action": "MoveAhead", "magnitude": [1]}, "magnitude must be a number"),
        ({"actions": [1, 2]}, "an action is a mapping"),
        ({"actions": []}, "actions must be a list of one or two"),
        ({"action": "Reset", "scene": "attic"}, "unknown room 'attic'"),
        ({"action": "Reset", "seed": 0.5}, "seed must be an integer"),
    ],
)
def test_bad_calls_are_named(controller: Controller, call: dict[str, object], message: str) -> None:
    controller.reset()
    with pytest.raises(ValueError, match=message):
        controller.step(call)
    assert controller.step("Pass").metadata["lastActionSuccess"]
