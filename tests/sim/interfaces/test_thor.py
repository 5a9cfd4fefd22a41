"""AI2-THOR's front end: its frame, its conventions, and scripts in its style."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

from interface.bodies import Arm
from sim.interfaces.thor import REFUSED, Controller, from_thor, rotation_to_thor, to_thor, yaw_from_thor, yaw_to_thor


@pytest.fixture(scope="module", params=["h1", "x1"])
def shared(request: pytest.FixtureRequest) -> Iterator[Controller]:
    made = Controller(scene="FloorPlan1", robot_type=request.param, width=96, height=64)
    yield made
    made.stop()


@pytest.fixture
def controller(shared: Controller) -> Controller:
    shared.reset()
    return shared


def obj(controller: Controller, name: str) -> dict:
    (entry,) = [entry for entry in controller.last_event.metadata["objects"] if entry["objectId"] == name]
    return entry


def test_points_and_headings_go_there_and_back() -> None:
    assert to_thor((1.0, 2.0, 3.0)) == {"x": 1.0, "y": 3.0, "z": 2.0}
    assert from_thor(to_thor((1.0, 2.0, 3.0))).tolist() == [1.0, 2.0, 3.0]
    assert yaw_to_thor(0.0) == 90.0 and yaw_to_thor(np.pi / 2) == 0.0  # our x is their right, our y their ahead
    for degrees in (0.0, 45.0, 180.0, 270.0):
        assert yaw_to_thor(yaw_from_thor(degrees)) == pytest.approx(degrees)
    assert yaw_from_thor({"x": 0, "y": 90, "z": 0}) == pytest.approx(0.0)


def test_a_turned_object_has_unitys_angles() -> None:
    yaw = np.radians(30.0)
    turned = np.array([[np.cos(yaw), -np.sin(yaw), 0.0], [np.sin(yaw), np.cos(yaw), 0.0], [0.0, 0.0, 1.0]])
    angles = rotation_to_thor(turned)
    assert angles["y"] == pytest.approx(330.0) and angles["x"] == pytest.approx(0.0) and angles["z"] == pytest.approx(0.0)


def test_an_unmodified_navigation_script(controller: Controller) -> None:
    event = controller.step("GetReachablePositions")
    positions = event.metadata["actionReturn"]
    assert len(positions) > 20
    steps = {round(abs(a["x"] - positions[0]["x"]) / 0.25, 6) % 1 for a in positions}
    assert steps <= {0.0}
    event = controller.step(action="Teleport", position=positions[3], rotation={"x": 0, "y": 270, "z": 0})
    assert event.metadata["lastActionSuccess"], event.metadata["errorMessage"]
    agent = event.metadata["agent"]
    assert agent["position"]["x"] == pytest.approx(positions[3]["x"], abs=1e-6)
    assert agent["position"]["z"] == pytest.approx(positions[3]["z"], abs=1e-6)
    assert agent["rotation"]["y"] == pytest.approx(270.0, abs=0.1)
    before = controller.session.world.servos.base_pose.copy()
    event = controller.step("RotateRight")
    assert np.cos(np.radians(event.metadata["agent"]["rotation"]["y"])) > 0.999
    assert controller.session.world.servos.base_pose[3] < before[3] + 0.1
    assert event.frame.shape == (64, 96, 3)


def test_move_ahead_goes_where_the_agent_looks(controller: Controller) -> None:
    for degrees, axis, sign in ((0, "z", 1.0), (90, "x", 1.0), (180, "z", -1.0)):
        controller.reset()
        start = controller.last_event.metadata["agent"]["position"]
        assert controller.step("Teleport", position=start, rotation=degrees).metadata["lastActionSuccess"]
        event = controller.step("MoveAhead", moveMagnitude=0.2)
        if event.metadata["lastActionSuccess"]:
            assert event.metadata["agent"]["position"][axis] - start[axis] == pytest.approx(sign * 0.2, abs=0.03)


def test_a_script_that_fetches(controller: Controller) -> None:
    mug = next(e for e in controller.last_event.metadata["objects"] if e["objectType"] == "Mug")
    event = controller.step("PickupObject", objectId=mug["objectId"])
    assert event.metadata["lastActionSuccess"], event.metadata["errorMessage"]
    assert obj(controller, mug["objectId"])["isPickedUp"]
    table = next(e for e in controller.last_event.metadata["objects"] if e["objectType"] == "DiningTable")
    event = controller.step("PutObject", objectId=table["objectId"])
    assert event.metadata["lastActionSuccess"], event.metadata["errorMessage"]
    assert table["objectId"] in obj(controller, mug["objectId"])["parentReceptacles"]
    assert obj(controller, mug["objectId"])["position"]["y"] > 0.4  # y is up


def test_doors_by_hand_and_by_force(controller: Controller) -> None:
    assert controller.step("OpenObject", objectId="Microwave_1").metadata["lastActionSuccess"]
    assert obj(controller, "Microwave_1")["isOpen"]
    refused = controller.step("OpenObject", objectId="Cabinet_1", openness=0.3)
    assert not refused.metadata["lastActionSuccess"] and "forceAction" in refused.metadata["errorMessage"]
    assert controller.step("OpenObject", objectId="Cabinet_1", openness=0.3, forceAction=True).metadata["lastActionSuccess"]
    assert obj(controller, "Cabinet_1")["openness"] == pytest.approx(0.3, abs=0.05)


def test_crouch_and_stand(controller: Controller) -> None:
    low, high = controller.session.robot.pelvis_height_range_m
    assert controller.step("Crouch").metadata["agent"]["position"]["y"] == pytest.approx(low, abs=0.02)
    assert not controller.last_event.metadata["agent"]["isStanding"]
    assert controller.step("Stand").metadata["agent"]["position"]["y"] == pytest.approx(high, abs=0.02)
    assert controller.step("Stand").metadata["lastActionSuccess"]


def test_a_horizon_is_told_of_and_done_ends_nothing(controller: Controller) -> None:
    place = controller.last_event.metadata["agent"]
    event = controller.step("TeleportFull", **place["position"], rotation=place["rotation"], horizon=-30, standing=True)
    assert event.metadata["lastActionSuccess"] and "horizon -30 has no effect" in event.metadata["errorMessage"]
    assert controller.step("Done").metadata["lastActionSuccess"]
    assert controller.step("RotateLeft", degrees=30).metadata["lastActionSuccess"]


def test_an_object_that_is_not_there_is_a_failure(controller: Controller) -> None:
    event = controller.step("PickupObject", objectId="Mug_99")
    assert not event.metadata["lastActionSuccess"] and event.metadata["errorCode"] == "ObjectNotVisible"


def test_a_hand_goes_to_a_point(controller: Controller) -> None:
    hand, _ = controller.session.body.arms.hand_pose(Arm.RIGHT)
    there = to_thor(hand + (0.0, 0.0, 0.06))
    event = controller.step("MoveArm", position=there, coordinateSpace="world", arm="right")
    assert event.metadata["lastActionSuccess"], event.metadata["errorMessage"]
    now, _ = controller.session.body.arms.hand_pose(Arm.RIGHT)
    assert np.linalg.norm(now - from_thor(there)) < 0.04
    far = controller.step("MoveArm", position={"x": 9.0, "y": 1.0, "z": 9.0}, coordinateSpace="world")
    assert not far.metadata["lastActionSuccess"] and "out of the right arm's reach" in far.metadata["errorMessage"]
    assert far.metadata["lastAction"] == "MoveArm"


def test_cameras_stand_where_they_are_put(controller: Controller) -> None:
    agent = controller.last_event.metadata["agent"]["position"]
    event = controller.step(
        "AddThirdPartyCamera",
        position={"x": agent["x"], "y": 2.3, "z": agent["z"]},
        rotation={"x": 90, "y": 0, "z": 0},
        fieldOfView=80,
    )
    assert event.metadata["actionReturn"] == 0
    above = event.third_party_camera_frames[0]
    assert above.shape == (64, 96, 3) and above.std() > 5.0
    moved = controller.step("UpdateThirdPartyCamera", thirdPartyCameraId=0, rotation={"x": -90, "y": 0, "z": 0})
    assert np.abs(moved.third_party_camera_frames[0].astype(int) - above.astype(int)).mean() > 5.0
    with pytest.raises(ValueError, match="there is no camera 3; there are 1"):
        controller.step("UpdateThirdPartyCamera", thirdPartyCameraId=3)


@pytest.mark.parametrize("name", sorted(REFUSED))
def test_what_makes_no_sense_is_refused_with_a_reason(controller: Controller, name: str) -> None:
    event = controller.step(name)
    assert not event.metadata["lastActionSuccess"] and event.metadata["errorMessage"] == f"{name}: {REFUSED[name]}"
    assert event.metadata["lastAction"] == name


@pytest.mark.parametrize(
    ("action", "arguments", "message"),
    [
        ("Fly", {}, "unknown action 'Fly'"),
        ("PickupObject", {"objectId": "Mug_1", "colour": "red"}, "unknown arguments"),
        ("Teleport", {"position": {"x": 0, "y": 0}}, "mapping with x, y and z"),
        ("Teleport", {"position": {"x": 0, "y": 0, "z": float("nan")}}, "must be a finite number"),
        ("Teleport", {"rotation": {"x": 20, "y": 0, "z": 0}}, "must be about y only"),
        ("GetReachablePositions", {"gridSize": 0}, "gridSize 0 outside"),
        ("PickupObject", {"objectId": "Mug_1", "arm": "third"}, "arm 'third' is not left or right"),
        ("MoveArm", {"position": {"x": 0, "y": 0, "z": 0}, "coordinateSpace": "elbow"}, "allowed: world, armBase, wrist"),
        ("AddThirdPartyCamera", {"fieldOfView": 400}, "fieldOfView 400 outside"),
    ],
)
def test_bad_calls_are_refused_and_change_nothing(controller: Controller, action: str, arguments: dict, message: str) -> None:
    before = controller.session.world.data.qpos.copy()
    with pytest.raises(ValueError, match=message):
        controller.step(action, **arguments)
    assert np.array_equal(controller.session.world.data.qpos, before)


def test_scenes_and_options() -> None:
    with pytest.raises(ValueError, match="unknown scene 'FloorPlan99'"):
        Controller(scene="FloorPlan99")
    with pytest.raises(ValueError, match="unknown option 'gravity'"):
        Controller(gravity=3)
    with pytest.raises(ValueError, match="field_of_view 175 outside"):
        Controller(scene="FloorPlan401", fieldOfView=175, width=32, height=32)


def test_field_of_view_and_heading() -> None:
    with (
        Controller(scene="FloorPlan401", fieldOfView=90, width=64, height=64) as wide,
        Controller(scene="FloorPlan401", width=64, height=64) as own,
    ):
        for one in (wide, own):
            for _ in range(2):
                heading = one.step("Rotate", rotation={"x": 0, "y": 120, "z": 0}).metadata["agent"]["rotation"]["y"]
                assert heading == pytest.approx(120.0, abs=0.5)
        assert wide.last_event.metadata["fov"] == 90.0 and own.last_event.metadata["fov"] < 80.0
        # the middle of the wide picture shows what the narrow one does
        share = np.tan(np.radians(own.last_event.metadata["fov"] / 2)) / np.tan(np.radians(45.0))
        cut = round(32 * (1 - share))
        middle = wide.last_event.depth_frame[cut:-cut, cut:-cut]
        assert np.median(middle) == pytest.approx(np.median(own.last_event.depth_frame), rel=0.05)
        assert wide.reset().metadata["fov"] == 90.0
