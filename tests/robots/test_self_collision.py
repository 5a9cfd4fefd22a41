"""A robot does not run into itself: distances to its own body, solutions that keep clear, starts that get out, defaults."""

import dataclasses

import mujoco
import numpy as np
import pytest

from interface.bodies import SIDES
from robots.build_solver import SOLVERS, robot_kit
from robots.kinematics import RobotModel
from robots.self_collision import SELF_TOUCH_M, OwnBody
from robots.solver import ReachTarget, rotation_from_axes
from robots.spec import BodyShape, available_robots

ROBOTS = available_robots()


def _folded(kit, arm="left"):
    """A posture with one hand in the robot's own trunk, the deepest of some random ones."""
    rng = np.random.default_rng(4)
    index = kit.model.indices(kit.spec.arms[arm].joints)
    start = kit.crouches.at(kit.spec.standing_pelvis_height_m).q
    postures = []
    for _ in range(200):
        q = start.copy()
        q[index] = np.clip(
            kit.spec.arms[arm].carry + rng.uniform(-1.2, 1.2, len(index)), kit.model.lower[index], kit.model.upper[index]
        )
        postures.append(q)
    return min(postures, key=lambda q: kit.model.own_body.clearance_m(q, (arm,), ("trunk",)))


@pytest.mark.parametrize("name", ROBOTS)
def test_postures_of_rest_and_carrying_are_clear(name):
    kit = robot_kit(name)
    for height in (kit.spec.standing_pelvis_height_m, sum(kit.spec.pelvis_height_range_m) / 2):
        for kind in ("rest", "carry"):
            assert kit.model.own_body.clearance_m(kit.model.arm_posture(kit.crouches.posture(height), kind)) > -SELF_TOUCH_M


@pytest.mark.parametrize("name", ROBOTS)
def test_declared_shapes_agree_with_the_mjcf(name):
    """What MuJoCo's geoms of hands and forearms touch of the trunk's, the declared shapes touch too."""
    kit = robot_kit(name)
    q = _folded(kit)
    model = mujoco.MjModel.from_xml_path(str(kit.spec.mjcf_path))
    data = mujoco.MjData(model)
    for joint, value in zip(kit.spec.joints, q, strict=True):
        data.qpos[model.joint(joint).qposadr[0]] = value
    mujoco.mj_forward(model, data)
    top = int(model.joint(kit.spec.arms["left"].joints[0]).bodyid[0])
    arm = {top}
    for body in range(top + 1, model.nbody):
        if int(model.body_parentid[body]) in arm:
            arm.add(body)
    hard = [g for g in range(model.ngeom) if model.geom_contype[g] and int(model.geom_bodyid[g]) in arm]
    trunk_body = int(model.site("chest").bodyid[0])
    trunk = [g for g in range(model.ngeom) if int(model.geom_bodyid[g]) == trunk_body and model.geom_dataid[g] < 0]
    nearest = min(mujoco.mj_geomDistance(model, data, a, b, 1.0, None) for a in hard for b in trunk)
    assert nearest < 0.0
    assert kit.model.own_body.clearance_m(q, ("left",), ("trunk",)) <= nearest + 0.02


@pytest.mark.parametrize("name", ROBOTS)
def test_solutions_keep_out_of_the_robot(name):
    """Targets near the body: without the rows some solutions run into it, with them none that counts as a success."""
    kit = robot_kit(name)
    height = kit.spec.standing_pelvis_height_m
    q = kit.crouches.at(height).q
    found = {}
    for avoid in (False, True):
        solver = SOLVERS[kit.spec.solver](kit.model, kit.crouches, avoid)
        rng, found[avoid] = np.random.default_rng(1), []
        for _ in range(25):
            sides = {side: np.array([*rng.uniform((0.1, -0.1), (0.3, 0.1)), rng.uniform(-0.1, 0.3)]) for side in SIDES}
            targets = {side: ReachTarget(point) for side, point in sides.items()}
            result = solver.solve(targets, q, pelvis_height_m=height, restarts=1)
            found[avoid].append(result)
            # the clearance is that of the joints returned
            assert result.self_clearance_m == pytest.approx(kit.model.own_body.clearance_m(result.q), abs=1e-6)
    assert any(r.position_error_m < 0.01 and r.self_clearance_m < -0.01 for r in found[False])
    assert all(r.self_clearance_m >= -SELF_TOUCH_M for r in found[True] if r.success)
    assert sum(r.success for r in found[True]) >= sum(r.success for r in found[False])


@pytest.mark.parametrize("name", ROBOTS)
def test_crossed_arms_do_not_meet(name):
    kit = robot_kit(name)
    height = kit.spec.standing_pelvis_height_m
    shoulder = kit.model.frames(
        np.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0]), kit.crouches.at(height).q, (kit.spec.key_bodies["left_shoulder"],)
    )[0, :3, 3]
    ahead = rotation_from_axes(np.array([1.0, 0.0, 0.0]), np.array([0.0, -1.0, 0.0]))
    for x, z in ((0.25, -0.25), (0.3, -0.1), (0.35, -0.2)):
        targets = {
            side: ReachTarget(np.array([x, -sign * 0.12, shoulder[2] + z]), ahead, 0.05, 0.0)
            for side, sign in zip(SIDES, (1.0, -1.0), strict=True)
        }
        result = kit.solver.solve(targets, kit.crouches.at(height).q, pelvis_height_m=height)
        assert not result.success or kit.model.own_body.clearance_m(result.q) >= -SELF_TOUCH_M


@pytest.mark.parametrize("name", ROBOTS)
def test_a_start_inside_the_trunk_gets_out(name):
    kit = robot_kit(name)
    height, q = kit.spec.standing_pelvis_height_m, _folded(kit)
    assert kit.model.own_body.clearance_m(q, ("left",), ("trunk",)) < -0.02
    easy = kit.model.arm_posture(kit.crouches.posture(height), "carry")
    hand = kit.model.frames(np.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0]), easy, (kit.spec.arms["left"].grasp_site,))[0, :3, 3]
    result = kit.solver.solve({"left": ReachTarget(hand)}, q, pelvis_height_m=height, restarts=2)
    assert result.success and result.self_clearance_m >= -SELF_TOUCH_M


@pytest.mark.parametrize("name", ROBOTS)
def test_a_robot_without_declared_shapes_has_those_of_its_geoms(name):
    kit = robot_kit(name)
    own = OwnBody(RobotModel(dataclasses.replace(kit.spec, self_shapes=())))
    assert set(own.parts) == {*SIDES, "trunk", "legs"}
    height = kit.spec.standing_pelvis_height_m
    assert own.clearance_m(kit.model.arm_posture(kit.crouches.posture(height), "carry")) > 0.0
    assert own.clearance_m(_folded(kit), ("left",), ("trunk",)) < 0.0


def test_one_arm_sees_where_the_other_one_is():
    """X1's arms are solved one by one: the right arm in the way changes what the left one does."""
    kit = robot_kit("x1")
    height = kit.spec.standing_pelvis_height_m
    q = kit.crouches.at(height).q
    point = np.array([0.25, 0.0, 0.25])
    first = kit.solver.solve({"right": ReachTarget(point)}, q, pelvis_height_m=height)
    assert first.success
    second = kit.solver.solve({"left": ReachTarget(point)}, first.q, pelvis_height_m=height)
    assert not second.success or kit.model.own_body.clearance_m(second.q) >= -SELF_TOUCH_M
    again = kit.solver.solve({"left": ReachTarget(point)}, q, pelvis_height_m=height)
    assert again.success and not np.array_equal(again.q, second.q)


def test_a_shape_needs_a_size():
    with pytest.raises(ValueError, match="radius_m"):
        BodyShape("chest", (0.0, 0.0, 0.0))
