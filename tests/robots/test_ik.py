"""Arm inverse kinematics of both robots: reachable targets are reached, limits and balance hold, bad input is refused."""

import numpy as np
import pytest

from benchmarks.ik import reached
from configs.validate import ConfigError
from interface.bodies import SIDES
from robots.build_solver import SOLVERS, robot_kit
from robots.kinematics import root_quaternion
from robots.solver import ReachTarget, rotation_from_axes
from robots.spec import available_robots, load_robot


def _root(kit, height):
    """Root pose with the pelvis at the origin of its heading frame, leaning as the crouch does."""
    return np.array([0.0, 0.0, 0.0, *root_quaternion(0.0, kit.crouches.pitch(height))])


def _random_poses(kit, height, rng):
    """Poses of the hands in a posture near the carrying one in which the robot does not run into itself."""
    q = kit.crouches.at(height).q
    clear = False
    while not clear:
        for arm in kit.spec.arms.values():
            index = kit.model.indices(arm.joints)
            q[index] = np.clip(
                np.asarray(arm.carry) + rng.uniform(-0.6, 0.6, len(index)), kit.model.lower[index], kit.model.upper[index]
            )
        clear = kit.model.own_body.clearance_m(q) > 0.01
    poses = kit.model.frames(_root(kit, height), q, tuple(kit.spec.arms[side].grasp_site for side in SIDES))
    return dict(zip(SIDES, poses, strict=True))


@pytest.mark.parametrize("name", available_robots())
@pytest.mark.parametrize("arms", [("left",), ("right",), SIDES])
def test_reachable_poses_are_reached(name, arms):
    kit = robot_kit(name)
    rng = np.random.default_rng(3)
    for _ in range(12):
        height = float(rng.uniform(*kit.spec.pelvis_height_range_m))
        poses = _random_poses(kit, height, rng)
        targets = {arm: ReachTarget.from_pose(poses[arm]) for arm in arms}
        result = kit.solver.solve(targets, kit.crouches.at(height).q, pelvis_height_m=height)
        assert result.success and result.position_error_m <= 0.01
        assert np.all(result.q >= kit.model.lower - 1e-6) and np.all(result.q <= kit.model.upper + 1e-6)
        # the residual is what the forward kinematics of the returned joints say
        for arm in arms:
            reached = kit.model.frames(_root(kit, height), result.q, (kit.spec.arms[arm].grasp_site,))[0]
            assert np.linalg.norm(reached[:3, 3] - poses[arm][:3, 3]) <= result.position_error_m + 1e-6
            assert np.arccos(np.clip(reached[:3, 0] @ poses[arm][:3, 0], -1.0, 1.0)) <= result.rotation_error_rad + 1e-6


def test_x1_takes_a_full_rotation():
    """Seven joints: X1 reaches rotation and translation together, roll included."""
    kit = robot_kit("x1")
    rng = np.random.default_rng(5)
    angles = []
    for _ in range(10):
        poses = _random_poses(kit, 0.55, rng)
        result = kit.solver.solve({"left": ReachTarget.from_pose(poses["left"])}, kit.crouches.at(0.55).q, pelvis_height_m=0.55)
        reached = kit.model.frames(_root(kit, 0.55), result.q, ("left_grasp",))[0]
        cosine = (np.trace(reached[:3, :3].T @ poses["left"][:3, :3]) - 1.0) / 2.0
        angles.append(np.arccos(np.clip(cosine, -1.0, 1.0)))
    assert np.median(angles) < 0.05


def test_x1_moves_only_the_arm_asked_for():
    kit = robot_kit("x1")
    q = kit.crouches.at(0.6).q
    pose = _random_poses(kit, 0.6, np.random.default_rng(1))["left"]
    result = kit.solver.solve({"left": ReachTarget(pose[:3, 3])}, q, pelvis_height_m=0.6)
    moved = {name for name, a, b in zip(kit.spec.joints, q, result.q, strict=True) if abs(a - b) > 1e-9}
    assert moved and moved <= set(kit.spec.arms["left"].joints)


def test_h1_solves_waist_and_both_arms_and_nothing_else():
    kit = robot_kit("h1")
    q = kit.crouches.at(0.9).q
    poses = _random_poses(kit, 0.9, np.random.default_rng(1))
    result = kit.solver.solve(
        {arm: ReachTarget.from_pose(poses[arm]) for arm in SIDES}, q, np.zeros(len(q)), pelvis_height_m=0.9
    )
    moved = {name for name, a, b in zip(kit.spec.joints, q, result.q, strict=True) if abs(a - b) > 1e-9}
    assert moved <= {*kit.spec.waist_joints, *kit.spec.arms["left"].joints, *kit.spec.arms["right"].joints}
    assert result.balance_margin_m > 0.0
    assert result.balance_margin_m == pytest.approx(kit.crouches.balance_margin(result.q, 0.9))


@pytest.mark.parametrize("name", available_robots())
def test_position_goes_before_orientation(name):
    """Fingers asked to point backwards: the position is still reached, and the angle is reported."""
    kit = robot_kit(name)
    high = kit.spec.pelvis_height_range_m[1]
    pose = _random_poses(kit, high, np.random.default_rng(2))["left"]
    backwards = rotation_from_axes(np.array([-1.0, 0.0, 0.3]), np.array([0.0, 1.0, 0.0]))
    result = kit.solver.solve({"left": ReachTarget(pose[:3, 3], backwards)}, kit.crouches.at(high).q, pelvis_height_m=high)
    assert result.success and result.position_error_m <= 0.01
    assert result.rotation_error_rad > 0.3


@pytest.mark.parametrize("name", available_robots())
def test_out_of_reach_says_by_how_much(name):
    kit = robot_kit(name)
    high = kit.spec.pelvis_height_range_m[1]
    result = kit.solver.solve({"left": ReachTarget(np.array([3.0, 0.0, 0.0]))}, kit.crouches.at(high).q, pelvis_height_m=high)
    assert not result.success and 2.0 < result.position_error_m < 3.0


@pytest.mark.parametrize("name", available_robots())
def test_low_things_need_a_crouch(name):
    """The reason for MoveDown: a hand's place near the floor is reached from the lowest pelvis only."""
    kit = robot_kit(name)
    low, high = kit.spec.pelvis_height_range_m
    z_m = {"h1": 0.5, "x1": 0.42}[name]
    reached = {}
    for height in (low, high):
        target = ReachTarget(np.array([0.3, 0.2, z_m - height]))
        reached[height] = kit.solver.solve({"left": target}, kit.crouches.at(height).q, pelvis_height_m=height).success
    assert reached == {low: True, high: False}


@pytest.mark.parametrize("name", available_robots())
def test_same_question_same_answer(name):
    kit = robot_kit(name)
    height = float(np.mean(kit.spec.pelvis_height_range_m))
    target = {"right": ReachTarget(np.array([0.3, -0.25, 0.2]))}
    first, second = (kit.solver.solve(target, kit.crouches.at(height).q, pelvis_height_m=height) for _ in range(2))
    np.testing.assert_array_equal(first.q, second.q)


@pytest.mark.parametrize("name", available_robots())
def test_refusals(name):
    kit = robot_kit(name)
    q = kit.crouches.at(1.0).q
    with pytest.raises(ValueError, match="tail"):
        kit.solver.solve({"tail": ReachTarget(np.zeros(3))}, q, pelvis_height_m=1.0)
    with pytest.raises(ValueError, match="none"):
        kit.solver.solve({}, q, pelvis_height_m=1.0)


def test_bad_targets():
    with pytest.raises(ValueError, match="nan"):
        ReachTarget(np.array([0.0, np.nan, 0.0]))
    with pytest.raises(ValueError, match=r"\(2, 2\)"):
        ReachTarget(np.zeros(3), np.eye(2))
    with pytest.raises(ValueError, match="parallel"):
        rotation_from_axes(np.array([1.0, 0.0, 0.0]), np.array([2.0, 0.0, 0.0]))


def test_rotation_from_axes_is_a_rotation():
    rng = np.random.default_rng(0)
    for _ in range(20):
        pointing, closing = rng.normal(size=(2, 3))
        rotation = rotation_from_axes(pointing, closing)
        np.testing.assert_allclose(rotation.T @ rotation, np.eye(3), atol=1e-12)
        assert np.linalg.det(rotation) == pytest.approx(1.0)
        np.testing.assert_allclose(rotation[:, 0], pointing / np.linalg.norm(pointing))
        assert rotation[:, 1] @ closing > 0.0


@pytest.mark.parametrize("name", available_robots())
def test_what_is_reached_depends_on_the_pelvis_height(name):
    kit = robot_kit(name)
    high = kit.spec.pelvis_height_range_m[1]
    assert not any(reached(kit, "left", np.array([2.0, 0.2, 0.8])))
    deep = reached(kit, "right", np.array([0.3, -0.2, {"h1": 0.5, "x1": 0.42}[name]]))
    assert deep[0] and not deep[-1]
    assert reached(kit, "left", np.array([0.3, 0.2, high]))[-1]


def test_one_kit_per_description(tmp_path):
    assert robot_kit("x1") is robot_kit(load_robot("x1"))


def test_unknown_robot():
    with pytest.raises(ConfigError, match="allowed: h1, x1"):
        robot_kit("atlas")


@pytest.mark.parametrize("name", available_robots())
def test_a_solution_does_not_depend_on_what_was_solved_before(name):
    """Also when the earlier height was almost the same: models of heights are kept."""
    kit = robot_kit(name)
    height = float(np.mean(kit.spec.pelvis_height_range_m))
    pose = _random_poses(kit, height, np.random.default_rng(2))["left"]

    def solved(solver, pelvis_height_m):
        q = kit.crouches.posture(pelvis_height_m)
        return solver.solve({"left": ReachTarget.from_pose(pose)}, q, pelvis_height_m=pelvis_height_m).q

    alone = solved(SOLVERS[kit.spec.solver](kit.model, kit.crouches), height)
    used = SOLVERS[kit.spec.solver](kit.model, kit.crouches)
    nearby = solved(used, height + 2e-7)
    assert not np.array_equal(nearby, alone)
    assert np.array_equal(solved(used, height), alone)
