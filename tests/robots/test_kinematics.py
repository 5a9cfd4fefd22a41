"""Pinocchio and MuJoCo read the same MJCF: forward kinematics and centre of mass agree at random configurations."""

import mujoco
import numpy as np
import pytest

from interface.bodies import KEY_BODIES
from robots.kinematics import RobotModel
from robots.spec import available_robots, load_robot

CONFIGURATIONS = 100


@pytest.mark.parametrize("name", available_robots())
def test_two_engines_agree(name):
    spec = load_robot(name)
    robot = RobotModel(spec)
    model = mujoco.MjModel.from_xml_path(str(spec.mjcf_path))
    data = mujoco.MjData(model)
    addresses = [int(model.joint(joint).qposadr[0]) for joint in spec.joints]
    bodies = [model.body(i).name for i in range(1, model.nbody)]
    sites = [model.site(i).name for i in range(model.nsite)]
    rng = np.random.default_rng(7)
    for _ in range(CONFIGURATIONS):
        q = rng.uniform(robot.lower, robot.upper)
        quaternion = rng.normal(size=4)
        root = np.concatenate([rng.uniform(-2.0, 2.0, size=3), quaternion / np.linalg.norm(quaternion)])
        data.qpos[:7], data.qpos[addresses] = root, q
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        expected = np.zeros((len(bodies) + len(sites), 4, 4))
        expected[:, 3, 3] = 1.0
        expected[:, :3, 3] = np.concatenate([data.xpos[1:], data.site_xpos])
        expected[:, :3, :3] = np.concatenate([data.xmat[1:], data.site_xmat]).reshape(-1, 3, 3)
        np.testing.assert_allclose(robot.frames(root, q, tuple(bodies + sites)), expected, rtol=0.0, atol=1e-6)
        np.testing.assert_allclose(robot.centre_of_mass(root, q), data.subtree_com[1], rtol=0.0, atol=1e-6)
        keys = [expected[(bodies + sites).index(spec.key_bodies[key]), :3, 3] for key in KEY_BODIES]
        np.testing.assert_allclose(robot.key_body_positions(root, q), keys, rtol=0.0, atol=1e-6)


@pytest.mark.parametrize("name", available_robots())
def test_limits_are_the_mjcfs(name):
    spec = load_robot(name)
    robot = RobotModel(spec)
    model = mujoco.MjModel.from_xml_path(str(spec.mjcf_path))
    ranges = np.array([model.joint(joint).range for joint in spec.joints])
    np.testing.assert_allclose(np.stack([robot.lower, robot.upper], axis=1), ranges, atol=1e-9)


@pytest.mark.parametrize(
    ("name", "pelvis_m", "shoulder_m", "reach_m", "mass_kg"),
    [("h1", 1.044, 1.483, 0.594, 51.4), ("x1", 0.626, 1.038, 0.419, 36.1)],
)
def test_published_dimensions(name, pelvis_m, shoulder_m, reach_m, mass_kg):
    """Straight-legged shoulder height, shoulder to wrist length and mass (without hands) as the makers give them."""
    robot = RobotModel(load_robot(name))
    root = np.array([0.0, 0.0, pelvis_m, 1.0, 0.0, 0.0, 0.0])
    keys = dict(zip(KEY_BODIES, robot.key_body_positions(root, robot.posture()), strict=True))
    assert keys["left_shoulder"][2] == pytest.approx(shoulder_m, abs=2e-3)
    assert keys["left_shoulder"][1] == pytest.approx(-keys["right_shoulder"][1], abs=2e-3)
    joint_names = (robot.spec.arms["left"].joints[1], robot.spec.arms["left"].joints[3], robot.spec.arms["left"].joints[-1])
    shoulder, elbow, hand = (
        robot.frames(root, robot.posture(), (robot.model.names[robot.model.getJointId(joint)],))[0, :3, 3]
        for joint in joint_names
    )
    assert np.linalg.norm(elbow - shoulder) + np.linalg.norm(hand - elbow) == pytest.approx(reach_m, abs=0.02)
    assert sum(inertia.mass for inertia in robot.model.inertias) == pytest.approx(mass_kg, abs=0.8)
    soles = robot.frames(root, robot.posture(), ("left_sole", "right_sole"))
    np.testing.assert_allclose(soles[:, 2, 3], 0.0, atol=2e-3)


def test_refusals():
    robot = RobotModel(load_robot("x1"))
    with pytest.raises(ValueError, match="x1: no body or site 'tail'"):
        robot.frame_id("tail")
    with pytest.raises(ValueError, match=r"got \(7,\) and \(3,\)"):
        robot.configuration(np.array([0, 0, 0, 1, 0, 0, 0]), np.zeros(3))


def test_postures():
    robot = RobotModel(load_robot("h1"))
    q = robot.posture({"left_knee": 9.0})
    assert q[robot.indices(("left_knee",))] == pytest.approx(2.05)
    carry = robot.arm_posture(q, "carry")
    arm = robot.spec.arms["left"]
    np.testing.assert_allclose(carry[robot.indices(arm.joints)], arm.carry)
    assert carry[robot.indices(("left_knee",))] == pytest.approx(2.05)


def test_balance_margin_of_two_feet():
    """The margin is the distance to the nearest edge: pushing the centre of mass forward by d lowers it by d."""
    robot = RobotModel(load_robot("x1"))
    root = np.array([0.0, 0.0, robot.spec.standing_pelvis_height_m, 1.0, 0.0, 0.0, 0.0])
    q = robot.arm_posture(robot.posture(), "rest")
    forward = robot.posture({"lumbar_pitch_joint": 0.2})
    com = robot.centre_of_mass(root, q)[0]
    soles = robot.frames(root, q, ("left_sole", "right_sole"))[:, 0, 3]
    half = robot.spec.foot.half_length_m
    edge = min(soles.max() + half - com, com - soles.min() + half)
    assert robot.balance_margin(root, q) == pytest.approx(edge, abs=0.01)
    assert robot.balance_margin(root, forward) != pytest.approx(edge, abs=1e-3)
