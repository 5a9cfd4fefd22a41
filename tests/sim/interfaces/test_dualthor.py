"""DualTHOR's Controller on this simulator: the loop of its published task test, its ids and replies."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from sim.interfaces.dualthor import Controller

TASKS = [
    ("Kitchen_CoffeeMachine_01", "toggle", "isToggled"),
    ("Kitchen_StoveKnob_01", "toggle", "isToggled"),
    ("Kitchen_StoveKnob_04", "toggle", "isToggled"),
    ("Kitchen_Mug_01", "break", "isBroken"),
    ("Kitchen_Mug_02", "pick", "isPickedUp"),
    ("Kitchen_PaperTowelRoll_01", "pick", "isPickedUp"),
    ("Kitchen_Drawer_01", "open", "isOpen"),
    ("Kitchen_Cabinet_01", "open", "isOpen"),
]


def test_the_loop_of_the_published_task_test() -> None:
    """Teleport, act, look for the state in the reply's objects, reset: as DualTHOR's script does it."""
    controller = Controller(config_path="config.json", start_unity_exe=True, robot_type="h1", scene="kitchen")
    controller.start()
    done = []
    for object_id, action, state in TASKS:
        controller.step("tp", objectID=object_id)
        feed_back = controller.step(action, objectID=object_id)
        for item in feed_back["sceneState"]["objects"]:
            if item["objectId"] == object_id and item[state]:
                done.append(object_id)
        controller.reset_environment()
    # what the room does not have and what is no action is refused; the rest is done in physics
    assert set(done) >= {"Kitchen_StoveKnob_01", "Kitchen_PaperTowelRoll_01", "Kitchen_Drawer_01", "Kitchen_Cabinet_01"}
    assert "Kitchen_StoveKnob_04" not in done and "Kitchen_Mug_01" not in done
    controller.stop()


@pytest.fixture(scope="module")
def controller():
    made = Controller(robot_type="x1", scene="bathroom")
    yield made
    made.stop()


def test_reply_has_dualthors_fields(controller: Controller) -> None:
    reply = controller.reset_environment()
    assert set(reply) == {"success", "imgpath", "msg", "sceneState"}
    state = reply["sceneState"]
    assert set(state) == {"id", "objects", "agent", "reachablePositions"}
    assert {
        "name",
        "position",
        "rotation",
        "lastAction",
        "lastActionSuccess",
        "errorMessage",
        "jointAngles",
        "gripperAngles",
    } == set(state["agent"])
    toilet = next(item for item in state["objects"] if item["objectId"] == "Bathroom_Toilet_01")
    assert toilet["receptacleObjectIds"] == ["Bathroom_ToiletPaper_01"] and "isMoveable" in toilet


def test_two_actions_reply_per_arm(controller: Controller) -> None:
    controller.reset_environment()
    pair = [{"action": "resetjoint", "arm": "left"}, {"action": "place", "arm": "right", "container": "Bathroom_CounterTop_01"}]
    reply = controller.step({"actions": pair, "executionMode": "parallel"})
    assert "msg" not in reply and not reply["success"]
    assert [(r["arm"], r["action"], r["success"]) for r in reply["results"]] == [
        ("left", "resetarm", True),
        ("right", "place", False),
    ]


def test_states_can_be_gone_back_to(controller: Controller) -> None:
    controller.reset_environment()
    world = controller.session.world
    start = world.data.qpos.copy()
    assert controller.step("moveahead", magnitude=0.3)["sceneState"]["id"] == "1"
    moved = world.data.qpos.copy()
    assert controller.undo_last_action()["success"] and np.array_equal(world.data.qpos, start)
    assert controller.redo_last_action()["success"] and np.array_equal(world.data.qpos, moved)
    assert not controller.redo_last_action()["success"]
    assert controller.step("loadstate", stateID="0")["success"] and np.array_equal(world.data.qpos, start)
    assert "no state '7'" in controller.step("loadstate", stateID="7")["msg"]


def test_what_is_wrong_is_a_reply(controller: Controller) -> None:
    for call, message in (
        ({"action": "break", "objectID": "Bathroom_Toilet_01"}, "unknown action 'break'"),
        ({"action": "tp", "objectID": "Kitchen_Unicorn_01"}, "unknown object"),
        ({"action": "pick"}, "Pick needs an object id"),
        ({"action": "moveahead", "magnitude": "far"}, "magnitude must be a number"),
        ({"actions": "pick"}, "actions must be a list"),
    ):
        reply = controller.step(call)
        assert not reply["success"] and message in reply["msg"], reply["msg"]


def test_pictures_are_written_when_asked_for(tmp_path: Path) -> None:
    made = Controller(robot_type="x1", scene="livingroom2", image_folder=tmp_path, image_size=32)
    path = Path(made.step("getcurstate")["imgpath"])
    assert path.is_file() and path.parent == tmp_path
    made.stop()


def test_tp_says_when_nothing_can_be_reached() -> None:
    controller = Controller(robot_type="x1", scene="kitchen")
    before = controller.session.world.data.qpos.copy()
    reply = controller.step("tp", objectID="Kitchen_Mug_01")  # on a machine at the back of a worktop
    assert not reply["success"] and "nowhere near Kitchen_Mug_01" in reply["msg"]
    assert np.array_equal(controller.session.world.data.qpos, before)
    reached = next(
        entry["objectId"]
        for entry in controller.step("getcurstate")["sceneState"]["objects"]
        if entry["pickupable"] and controller.step("tp", objectID=entry["objectId"])["success"]
    )
    assert controller.step("pick", objectID=reached)["success"]
    controller.stop()
