"""What hands hold stays as it was taken, is carried at walking pace, and falls when it is let go of; what is put down rests."""

from __future__ import annotations

from collections.abc import Iterator

import mujoco
import numpy as np
import pytest

from interface.steps import PlanStep
from sim.scene.objects import ObjectPlacement
from sim.session.session import FreePlay, Session
from sim.skills.manipulate import OFF_BODY_M
from sim.skills.runner import CONTROL_DT_S
from sim.world.world import World

MUG = FreePlay(
    "kitchen_1",
    placements=(
        ObjectPlacement("Mug_1", "DiningTable_1", (1.5, -0.85)),
        ObjectPlacement("Apple_1", "CounterTop_1", (-0.4, 2.2)),
    ),
)


@pytest.fixture(params=["h1", "x1"])
def carrying(request: pytest.FixtureRequest) -> Iterator[Session]:
    """A robot that has picked up the mug."""
    session = Session(request.param, image_size=0)
    session.reset(MUG, 0)
    session._seen.update(session.world.objects)
    low = ("MoveDown(0.1)",) if request.param == "h1" else ()
    for text in ("GoTo(Mug_1)", *low, "Pick(right, Mug_1)"):
        feedback = session.act(PlanStep.parse(text))
        assert feedback.success, feedback.to_text()
    yield session
    session.close()


def test_what_is_held_keeps_its_place_in_the_hand(carrying: Session) -> None:
    world, shifts, turns, speeds = carrying.world, list[float](), list[float](), list[float]()
    made = np.linalg.inv(world.servos.grasp_pose("right")) @ world.poses.pose("Mug_1")
    last = [world.poses.center("Mug_1")]

    def watch(seen: World, _: str) -> None:
        error = np.linalg.inv(made) @ np.linalg.inv(seen.servos.grasp_pose("right")) @ seen.poses.pose("Mug_1")
        shifts.append(float(np.linalg.norm(error[:3, 3])))
        turns.append(float(np.degrees(np.arccos(np.clip(0.5 * (np.trace(error[:3, :3]) - 1.0), -1.0, 1.0)))))
        speeds.append(float(np.linalg.norm(seen.poses.center("Mug_1") - last[0])) / CONTROL_DT_S)
        last[0] = seen.poses.center("Mug_1")

    carrying.watchers.append(watch)
    for text in ("RotateLeft(90)", "MoveAhead(0.3)", "ResetArm(right)"):
        carrying.act(PlanStep.parse(text))
    assert len(shifts) > 50
    assert max(turns) < 3.0 and max(shifts) < 0.005 and max(speeds) < 1.5


def test_what_a_still_hand_lets_go_of_falls(carrying: Session) -> None:
    world = carrying.world
    world.advance(3.0)  # long enough for what rests to be put to sleep
    before = float(world.poses.center("Mug_1")[2])
    world.grasps.detach("right")
    carrying.body.hands.command(next(arm for arm in carrying.body.hands.held if arm.value == "right"), 1.0)
    world.advance(1.0)
    assert float(world.poses.center("Mug_1")[2]) < before - 0.1


def test_a_grasp_that_is_torn_is_none(carrying: Session) -> None:
    world = carrying.world
    item = world.objects["Mug_1"]
    world.grasps.settle()
    assert world.grasps.held("right") == "Mug_1"
    world.data.qpos[item.qpos_adr + 2] += 0.06
    mujoco.mj_kinematics(world.model, world.data)
    world.grasps.settle()
    assert world.grasps.held("right") is None and not item.held_by


def test_a_snapshot_knows_how_firm_a_grasp_is(carrying: Session) -> None:
    world = carrying.world
    before, kept = world.model.eq_solimp.copy(), world.save()
    world.grasps.detach("right")
    world.grasps.attach("right", "Mug_1", steady=True)
    assert not np.array_equal(world.model.eq_solimp, before)
    world.restore(kept)
    assert np.array_equal(world.model.eq_solimp, before)


def test_fingers_rest_on_what_they_hold(carrying: Session) -> None:
    servos, spec = carrying.world.servos, carrying.world.scene.the_robot().arms["right"]
    told, measured = servos.joint_targets(), servos.joint_positions()
    assert max(abs(told[name] - measured[name]) for name in spec.hand_joints) < 0.02


def test_what_one_hand_holds_pushes_like_the_hand(carrying: Session) -> None:
    """An apple is put below the mug, where it meets the mug alone; what both hands hold may brush along things."""
    world, contacts = carrying.world, carrying.body.contacts
    assert contacts.pushed()[2] == 0.0
    mug, apple = world.object("Mug_1"), world.object("Apple_1")
    (low, high), (bottom, top) = (np.array(world.poses.bounds(name)) for name in ("Mug_1", "Apple_1"))
    below = 0.5 * (low + high) - 0.5 * (bottom + top)
    below[2] = low[2] - top[2]
    place = world.data.qpos[apple.qpos_adr : apple.qpos_adr + 3]
    place += below
    world.advance(CONTROL_DT_S)  # which wakes it
    while world.data.ncon == 0 and world.poses.bounds("Apple_1")[1][2] < high[2]:
        place[2] += 0.003
        mujoco.mj_forward(world.model, world.data)
    depth_m, _, off_rad = contacts.pushed()
    assert depth_m == 0.0 and off_rad > 0.0
    mug.held_by.append("left")
    assert contacts.pushed()[2] == 0.0
    mug.held_by.remove("left")


def test_what_is_held_meets_the_body_of_the_robot(carrying: Session) -> None:
    world, item = carrying.world, carrying.world.objects["Mug_1"]
    model, data = world.model, world.data
    arm = next(one for one, name in carrying.body.hands.held.items() if name is not None)
    assert carrying.body.probe.own_depth_m(item, {arm: carrying.body.arms.commanded(arm)}) <= OFF_BODY_M
    shoulder = carrying.body.posture.shoulder(arm)
    home = data.qpos[item.qpos_adr : item.qpos_adr + 3].copy()

    def meets() -> bool:
        mujoco.mj_forward(model, data)
        pairs = model.geom_bodyid[data.contact.geom[: data.ncon]]
        return any(item.body_id in pair and set(map(int, pair)) & world.scene.robot_bodies for pair in pairs)

    assert not meets()
    data.qpos[item.qpos_adr : item.qpos_adr + 3] = shoulder
    assert meets()
    data.qpos[item.qpos_adr : item.qpos_adr + 3] = home
    assert not meets()


@pytest.mark.parametrize(("turn", "tilt_deg"), [((1, 0, 0), 0.0), ((1, 0, 0), 30.0), ((0, 1, 0), 88.0), ((1, 0, 0), 90.0)])
def test_tilt_is_from_the_nearest_resting_attitude(turn: tuple[int, int, int], tilt_deg: float) -> None:
    session = Session("h1", image_size=0)
    session.reset(MUG, 0)
    world, item, half = session.world, session.world.objects["Mug_1"], np.radians(tilt_deg) / 2.0
    world.data.qpos[item.qpos_adr + 3 : item.qpos_adr + 7] = [np.cos(half), *(np.sin(half) * np.array(turn))]
    mujoco.mj_kinematics(world.model, world.data)
    assert world.poses.tilt_deg("Mug_1") == pytest.approx(min(tilt_deg, 90.0 - tilt_deg), abs=1e-6)
    session.close()
