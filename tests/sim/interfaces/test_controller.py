"""The AI2-THOR-style front end: metadata, aliases, undo, and refusals."""

import numpy as np
import pytest

from sim.interfaces.aliases import to_action
from sim.interfaces.controller import Controller


@pytest.fixture(scope="module")
def controller():
    made = Controller("h1", "kitchen_1", width=96, height=96, third_party_cameras=("behind",), privileged=True)
    yield made
    made.stop()


def test_first_event_has_what_users_expect(controller):
    event = controller.reset()
    assert event.metadata["lastActionSuccess"] and event.metadata["sceneName"] == "kitchen_1"
    assert event.frame.shape == (96, 96, 3) and event.frame.dtype == np.uint8
    assert event.depth_frame.shape == (96, 96) and 0.1 < float(np.median(event.depth_frame)) < 10.0
    assert event.third_party_camera_frames[0].shape == (96, 96, 3)
    masks = event.instance_masks
    visible = {entry["objectId"] for entry in event.metadata["objects"] if entry["visible"]}
    assert masks and visible <= set(masks)
    assert {"agent", "arm", "inventoryObjects", "objects", "sceneBounds"} <= set(event.metadata)


def test_an_event_tells_itself_in_a_few_lines(controller):
    told = repr(controller.step("Pick", objectId="Sofa_1"))
    assert len(told.splitlines()) == 4 and len(told) < 1000
    assert told.startswith("Event of Pick: Pick(right, Sofa_1): ")
    assert "in view: " in told and "hands: left empty, right empty" in told


def test_events_have_what_opencv_and_detectors_take(controller):
    event = controller.reset()
    assert np.array_equal(event.cv2img[..., 0], event.frame[..., 2])
    for name, (left, top, right, bottom) in event.instance_detections2D.items():
        inside = event.instance_masks[name][top:bottom, left:right]
        assert inside.sum() == event.instance_masks[name].sum() and inside[0].any() and inside[:, -1].any()
        assert (event.instance_segmentation_frame[event.instance_masks[name]] == event.object_id_to_color[name]).all()
    assert event.instance_detections2D


def test_failures_raise_where_that_is_asked_for(controller):
    controller.reset()
    assert controller.step("RotateLeft", degrees=5, raise_for_failure=True).metadata["lastActionSuccess"]
    with pytest.raises(RuntimeError, match="GoTo: ObjectNotKnown: "):
        controller.step("GoTo", objectId="Unicorn_1", raise_for_failure=True)


def test_a_block_stops_its_controller():
    with Controller("h1", width=16, height=16) as inside:
        stopped = inside.session.close
        closed = []
        inside.session.close = lambda: closed.append(stopped())
    assert closed == [None]


@pytest.mark.parametrize(
    ("wrong", "near"), [({"action": "gotoo"}, "goto"), ({"action": "Reset", "scene": "kitchn_1"}, "kitchen_1")]
)
def test_what_was_meant_is_suggested(controller, wrong, near):
    with pytest.raises(ValueError, match=f"did you mean '{near}'"):
        controller.step(wrong)


def test_undo_and_redo_are_exact(controller):
    controller.reset()
    session = controller.session
    before = session.world.data.qpos.copy()
    controller.step(action="moveahead", magnitude=0.3)
    after = session.world.data.qpos.copy()
    assert session.stats.path_length_m == pytest.approx(0.3, abs=0.02)
    assert controller.step(action="Undo").metadata["lastActionSuccess"]
    assert np.array_equal(session.world.data.qpos, before)
    controller.step(action="Redo")
    assert np.array_equal(session.world.data.qpos, after)


def test_failures_are_reported(controller):
    controller.reset()
    event = controller.step(action="PutObject", objectId="CounterTop_1", arm="left")
    assert not event.metadata["lastActionSuccess"]
    assert event.metadata["errorCode"] == "ObjectNotInInventory"
    assert event.metadata["failureCode"] == "HandEmpty" and event.metadata["failureCategory"] == "logical"
    event = controller.step(action="PickupObject", objectId="Unicorn_1")
    assert event.metadata["errorCode"] == "ObjectNotVisible" and event.metadata["failureCode"] == "ObjectNotKnown"


def test_parallel_pair_of_dualthor(controller):
    controller.reset()
    pair = [{"action": "resetjoint", "arm": "left"}, {"action": "place", "arm": "right", "container": "CounterTop_1"}]
    event = controller.step({"actions": pair, "executionMode": "parallel"})
    assert [result["success"] for result in event.metadata["results"]] == [True, False]
    with pytest.raises(ValueError, match="unknown executionMode 'both'"):
        controller.step({"actions": pair, "executionMode": "both"})


def test_save_load_and_teleport(controller):
    controller.reset()
    controller.step(action="SaveState", name="here")
    x, y = controller.session.body.workspace.navigation().free_positions()[0]
    assert controller.step(action="TP", x=float(x), y=float(y), rotation=90).metadata["actionReturn"] is True
    assert np.allclose(controller.session.world.servos.base_pose[:2], (x, y))
    assert not controller.step(action="TP", x=99.0, y=0.0).metadata["lastActionSuccess"]
    assert not controller.step(action="TP", x=1e308, y=0.0).metadata["lastActionSuccess"]
    for rotation in (1e308, -1e308, 36090.0):
        assert controller.step(action="TP", x=float(x), y=float(y), rotation=rotation).metadata["lastActionSuccess"]
        assert abs(controller.session.body.base.measured().yaw_rad) <= np.pi + 1e-6
    controller.step(action="TP", x=float(x), y=float(y), rotation=90)
    controller.step(action="LoadState", name="here")
    assert not np.allclose(controller.session.world.servos.base_pose[:2], (x, y))
    assert len(controller.step(action="GetReachablePositions").metadata["actionReturn"]) > 10
    with pytest.raises(ValueError, match="no saved state 'there'; saved: here"):
        controller.step(action="LoadState", name="there")


def test_a_hand_at_a_door_keeps_the_robot_from_being_teleported(controller):
    controller.reset()
    x, y = controller.session.body.workspace.navigation().free_positions()[0]
    for _ in range(4):
        controller.step(action="RotateLeft", amount=90)  # to see the cabinet
    for call in ({"action": "GoTo", "objectId": "Cabinet_1"}, {"action": "Hold", "arm": "left", "objectId": "Cabinet_1"}):
        assert controller.step(call).metadata["lastActionSuccess"]
    before = controller.session.world.servos.base_pose.copy()
    assert not controller.step(action="TP", x=float(x), y=float(y)).metadata["lastActionSuccess"]
    assert np.array_equal(controller.session.world.servos.base_pose, before)
    controller.step(action="Release", arm="left")
    assert controller.step(action="TP", x=float(x), y=float(y)).metadata["lastActionSuccess"]


@pytest.mark.parametrize(
    ("name", "arguments", "text"),
    [
        ("rotateright", {"magnitude": 0.5}, "RotateRight(45)"),
        ("moveup", {"magnitude": 2}, "MoveUp(0.2)"),
        ("MoveAhead", {"moveMagnitude": 0.4}, "MoveAhead(0.4)"),
        ("pick", {"objectID": "Mug_1", "arm": "left"}, "Pick(left, Mug_1)"),
        ("place", {"objectID": "Mug_1", "container": "SinkBasin_1", "arm": "left"}, "Place(left, SinkBasin_1)"),
        ("GoTo", {"objectId": "Mug_1", "amount": 0.5, "bearing": 10}, "GoTo(Mug_1, 0.5, 10)"),
    ],
)
def test_aliases(name, arguments, text):
    assert to_action(name, arguments).to_text() == text


def test_unknown_actions_and_arguments(controller):
    with pytest.raises(ValueError, match="unknown action 'Fly'"):
        controller.step(action="Fly")
    with pytest.raises(ValueError, match=r"unknown arguments \['speed'\]"):
        controller.step(action="MoveAhead", speed=3)
    with pytest.raises(ValueError, match=r"SaveState: unknown arguments \['nam'\]; allowed: name"):
        controller.step(action="SaveState", nam="before")
    with pytest.raises(ValueError, match=r"Undo: unknown arguments \['steps'\]; allowed: none"):
        controller.step("Undo", steps=2)
    with pytest.raises(ValueError, match="arm 'third' is not left or right"):
        to_action("pick", {"objectId": "Mug_1", "arm": "third"})
    with pytest.raises(ValueError, match=r"width 0 outside 1\.\.1280"):
        Controller("h1", "kitchen_1", width=0, height=90)
    with pytest.raises(ValueError, match="must be about z, which is up"):
        controller.step("Teleport", position={"x": 0.0, "y": 0.0, "z": 0.9}, rotation={"x": 0, "y": 90, "z": 0})


def test_teleport_needs_privilege(controller):
    controller._privileged = False
    try:
        with pytest.raises(ValueError, match="TP needs"):
            controller.step(action="TP", x=0.0, y=0.0)
    finally:
        controller._privileged = True


def test_frames_need_not_be_square():
    made = Controller("x1", "bathroom_1", width=80, height=48, third_party_cameras=("behind",))
    event = made.step("Pass")
    assert event.frame.shape == (48, 80, 3) and event.depth_frame.shape == (48, 80)
    assert event.third_party_camera_frames[0].shape == (48, 80, 3)
    assert (event.metadata["screenWidth"], event.metadata["screenHeight"]) == (80, 48)
    made.stop()
