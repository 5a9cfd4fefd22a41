"""Feet step along with the base, and a walk ends where a hand is pressed against something."""

from __future__ import annotations

import numpy as np
import pytest

from interface.bodies import Arm
from interface.failures import FailureCategory
from interface.steps import PlanStep
from robots.build_solver import robot_kit
from robots.kinematics import root_quaternion
from sim.session.session import FreePlay, Session
from sim.skills.footsteps import footsteps
from sim.skills.gait import leg_motion
from sim.skills.runner import CONTROL_DT_S

ROBOTS = ("h1", "x1")


def soles_on(robot: str, height_m: float, way: np.ndarray) -> np.ndarray:
    """(T, 2, 3) places of the soles, world frame, when base and legs are where they are commanded to be."""
    kit = robot_kit(robot)
    base, index = kit.crouches.posture(height_m), kit.model.indices(kit.spec.leg_joints)

    def soles(pose: np.ndarray, q: np.ndarray) -> np.ndarray:
        c, s = np.cos(pose[2]), np.sin(pose[2])
        root = np.array([0.0, 0.0, height_m, *root_quaternion(0.0, kit.crouches.pitch(height_m))])
        local = kit.model.frames(root, q, ("left_sole", "right_sole"))[:, :3, 3]
        return local @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]]) + (pose[0], pose[1], 0.0)

    neutral = soles(np.zeros(3), base)[:, :2]
    legs = leg_motion(footsteps(kit), height_m, neutral, way, np.zeros(len(way)))
    found = []
    for pose, joints in zip(way, legs, strict=True):
        q = base.copy()
        q[index] = joints
        found.append(soles(pose, q))
    return np.array(found)


@pytest.mark.parametrize("robot", ROBOTS)
def test_soles_are_where_the_gait_puts_them(robot: str) -> None:
    kit = robot_kit(robot)
    low, high = kit.spec.pelvis_height_range_m
    height_m = 0.4 * low + 0.6 * high
    steps, rng = footsteps(kit), np.random.default_rng(0)
    ahead_m, aside_m = steps.reach_m(height_m)
    feet = np.cumsum(rng.normal(0.0, 1.0, (60, 2, 4)), axis=0)
    feet = np.sin(0.3 * feet) * (ahead_m, 0.5 * aside_m, 0.0, 0.1)
    legs, base = steps.joints(height_m, feet), kit.crouches.posture(height_m)
    index, names = kit.model.indices(kit.spec.leg_joints), ("left_sole", "right_sole")
    root = np.array([0.0, 0.0, height_m, *root_quaternion(0.0, kit.crouches.pitch(height_m))])
    neutral = kit.model.frames(root, base, names)[:, :3, 3]
    for wanted, joints in zip(feet, legs, strict=True):
        q = base.copy()
        q[index] = joints
        assert np.all((joints >= kit.model.lower[index]) & (joints <= kit.model.upper[index]))
        missed = kit.model.frames(root, q, names)[:, :3, 3] - neutral - wanted[:, :3]
        assert np.linalg.norm(missed, axis=1).max() < 0.012


@pytest.mark.parametrize("robot", ROBOTS)
@pytest.mark.parametrize("share", [0.15, 0.5, 0.9])
def test_both_soles_come_as_far_as_the_reach_says_and_feet_stay_apart(robot: str, share: float) -> None:
    kit = robot_kit(robot)
    low, high = kit.spec.pelvis_height_range_m
    height_m = low + share * (high - low)
    steps, names = footsteps(kit), ("left_sole", "right_sole")
    reach_m = steps.reach_m(height_m)
    feet = np.zeros((4, 2, 4))
    for number, (axis, sign) in enumerate(((0, 1.0), (0, -1.0), (1, 1.0), (1, -1.0))):
        feet[number, :, axis] = sign * reach_m[axis]
    base, index = kit.crouches.posture(height_m), kit.model.indices(kit.spec.leg_joints)
    root = np.array([0.0, 0.0, height_m, *root_quaternion(0.0, kit.crouches.pitch(height_m))])
    neutral = kit.model.frames(root, base, names)[:, :3, 3]
    for wanted in feet:
        q = base.copy()
        q[index] = steps.joints(height_m, wanted[None])[0]
        missed = kit.model.frames(root, q, names)[:, :3, 3] - neutral - wanted[:, :3]
        assert np.linalg.norm(missed, axis=1).max() < 0.006
    assert neutral[0, 1] - neutral[1, 1] - 2.0 * reach_m[1] > 2.0 * kit.spec.foot.half_width_m


def ways() -> dict[str, np.ndarray]:
    steps = 0.5 - 0.5 * np.cos(np.linspace(0.0, np.pi, 120))
    zero = np.zeros(120)
    return {
        "ahead": np.column_stack([1.2 * steps, zero, zero]),
        "back": np.column_stack([-0.5 * steps, zero, zero]),
        "aside": np.column_stack([zero, 0.4 * steps, zero]),
        "turn": np.column_stack([zero, zero, 1.5 * steps]),
    }


@pytest.mark.parametrize("robot", ROBOTS)
@pytest.mark.parametrize("name", list(ways()))
def test_one_foot_stands_while_the_other_swings(robot: str, name: str) -> None:
    low, high = robot_kit(robot).spec.pelvis_height_range_m
    way = ways()[name]
    soles = soles_on(robot, 0.4 * low + 0.6 * high, way)
    assert np.abs(soles[[0, -1], :, 2]).max() < 0.004
    assert soles[:, :, 2].max() > 0.015, "a foot is lifted"
    assert soles[:, :, 2].min(axis=1).max() < 0.02, "one foot is always near the floor"
    speed = np.linalg.norm(np.diff(soles[:, :, :2], axis=0), axis=2) / CONTROL_DT_S
    assert np.median(speed.min(axis=1)) < 0.15 * np.median(speed.max(axis=1)), "and does not slide"
    moved = soles[-1, :, :2] - soles[0, :, :2]
    if name != "turn":
        np.testing.assert_allclose(moved, np.repeat(way[-1:, :2], 2, axis=0), atol=0.004)


@pytest.mark.parametrize("robot", ROBOTS)
def test_walking_moves_the_legs_and_leaves_them_as_they_were(robot: str) -> None:
    session = Session(robot, image_size=0, all_known=True)
    session.reset(FreePlay("living_room_1"), 0)
    world = session.world
    names = session.robot.leg_joints
    before = np.array([world.servos.joint_targets()[name] for name in names])
    sites = [int(world.model.site(f"{side}_sole").id) for side in ("left", "right")]
    knees, heights = [], []

    def watch(seen, _text) -> None:
        knees.append([seen.servos.joint_positions()[name] for name in names if "knee" in name])
        heights.append(seen.data.site_xpos[sites, 2].copy())

    session.watchers.append(watch)
    _, feedback = session.step(PlanStep.parse("GoTo(Desk_1)"))
    assert feedback.success
    assert np.ptp(np.array(knees), axis=0).min() > 0.2, "both knees bend"
    assert np.array(heights).min() > -0.02 and np.array(heights).min(axis=1).max() < 0.05
    after = np.array([world.servos.joint_targets()[name] for name in names])
    np.testing.assert_allclose(after, before, atol=1e-3)


@pytest.mark.parametrize(("robot", "down_m"), [("h1", 0.1), ("h1", 0.33), ("x1", 0.05), ("x1", 0.18)])
def test_the_standing_foot_stays_where_it_is(robot: str, down_m: float) -> None:
    session = Session(robot, image_size=0, all_known=True)
    session.reset(FreePlay("living_room_1", placements=()), 0)
    world, foot = session.world, session.robot.foot
    sites = [int(world.model.site(f"{side}_sole").id) for side in ("left", "right")]
    corners = np.array([(a * foot.half_length_m, b * foot.half_width_m, 0.0) for a in (-1, 1) for b in (-1, 1)])
    seen: list[tuple[np.ndarray, np.ndarray]] = []

    def watch(*_: object) -> None:
        turns = world.data.site_xmat[sites].reshape(2, 3, 3)
        soles = world.data.site_xpos[sites][:, None] + corners @ turns.transpose(0, 2, 1)  # (2, 4, 3)
        seen.append((soles, world.servos.base_pose[:2].copy()))

    assert session.step(PlanStep.parse(f"MoveDown({down_m})"))[1].success
    session.watchers.append(watch)
    for text in ("MoveAhead(0.5)", "MoveBack(0.5)", "MoveLeft(0.4)", "MoveRight(0.4)"):
        seen.clear()
        assert session.step(PlanStep.parse(text))[1].success
        slip, way = 0.0, 0.0
        for (before, start), (after, end) in zip(seen, seen[1:], strict=False):
            lower = int(np.argmin(after[:, :, 2].min(axis=1)))
            slip += float(np.linalg.norm((after[lower] - before[lower]).mean(axis=0)[:2]))
            way += float(np.linalg.norm(end - start))
        assert way > 0.35
        assert slip < 0.1 * way, text
        assert min(float(soles[:, :, 2].min()) for soles, _ in seen) > -0.01, text
    session.close()


@pytest.mark.parametrize("robot", ROBOTS)
@pytest.mark.parametrize("low", [False, True])
def test_a_hand_that_runs_into_a_wall_ends_the_walk(robot: str, low: bool) -> None:
    session = Session(robot, image_size=0, all_known=True)
    session.reset(FreePlay("living_room_1", placements=()), 0)
    body, world = session.body, session.world
    navigation, ahead = body.workspace.navigation(), np.array([0.0, -1.0])
    to_wall = world.room.bounds[1] + 1.3
    spots = [spot for spot in navigation.free_positions() if abs(spot[1] - to_wall) < 0.03]
    spot = max(spots, key=lambda spot: (navigation.free_travel(spot, spot + ahead) > 0.9, navigation.clearance(spot[None])[0]))
    session.teleport(float(spot[0]), float(spot[1]), -np.pi / 2.0)
    for arm in Arm:
        body.arms.command(arm, body.ik.vias(arm)[1])  # hands forward
    if low:
        body.base.command_height(session.robot.pelvis_height_range_m[0])
    world.advance(1.5)
    height_m = body.posture.pelvis_height_m
    free_m = navigation.free_travel(spot, spot + ahead)
    assert free_m > 0.9, "the disc would fit"
    _, feedback = session.step(PlanStep.parse("MoveAhead(1.0)"))
    outcome = feedback.outcomes[0]
    assert outcome.code == "BlockedPath"
    assert outcome.margins["travel_m"] < free_m - 0.03
    assert np.all(body.contacts.pushed() < (0.03, 0.05, 0.35))
    assert body.posture.pelvis_height_m == pytest.approx(height_m, abs=1e-6), "and has come down from what it rose to walk"
    _, back = session.step(PlanStep.parse("MoveBack(0.3)"))
    assert back.success, "and the robot can walk away"


def test_an_arm_that_runs_into_a_worktop_ends_the_way_down() -> None:
    session = Session("h1", "easy", image_size=0)
    session.reset(FreePlay("kitchen_1"), seed=0)
    body, model, data = session.body, session.world.model, session.world.data
    session.teleport(2.0, 1.83, np.deg2rad(135.0))
    start = body.posture.pelvis_height_m
    _, feedback = session.step(PlanStep.parse("MoveDown(0.3)"))
    outcome = feedback.outcomes[0]
    assert outcome.code == "HeightLimit" and outcome.category is FailureCategory.BODY_ADJUSTMENT
    assert outcome.margins["height_m"] == pytest.approx(-0.3 - (body.posture.pelvis_height_m - start), abs=1e-4)
    assert -0.3 < body.posture.pelvis_height_m - start < -0.02, "part of the way"
    joints = [int(model.joint(name).id) for arm in Arm for name in body.spec.arms[arm.value].joints]
    low, high = model.jnt_range[joints].T
    at = data.qpos[model.jnt_qposadr[joints]]
    assert np.all((low - 0.02 < at) & (at < high + 0.02)) and body.contacts.pushed()[2] < 0.3
    _, feedback = session.step(PlanStep.parse("MoveUp(0.05)"))
    assert feedback.outcomes[0].success, "and the robot can rise again"
    session.close()
