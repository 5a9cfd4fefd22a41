"""The upper body under gravity, its motors after the recording, pelvis and legs driven."""

import dataclasses

import numpy as np
import pinocchio as pin
import pytest

from data.generator import generate_clip
from data.retarget import Retargeter
from data.skeleton import HumanMotion
from data.tracking import Tracker, Tracking
from interface.motion import Motion
from robots.spec import load_robot

ROBOTS = ("h1", "x1")


@pytest.fixture(scope="module", params=ROBOTS)
def retargeter(request: pytest.FixtureRequest) -> Retargeter:
    return Retargeter(load_robot(request.param))


def standing(retargeter: Retargeter, frames: int = 30) -> Motion:
    motion = retargeter(HumanMotion("still", generate_clip(0, 6).joints[:10], 20.0)).motion
    assert motion.root_pose is not None and motion.joint_positions is not None
    root, joints = (np.repeat(array[-1:], frames, axis=0) for array in (motion.root_pose, motion.joint_positions))
    return dataclasses.replace(motion, root_pose=root, joint_positions=joints)


def test_a_still_clip_is_followed_up_to_what_gravity_bends(retargeter: Retargeter) -> None:
    tracker, motion = Tracker(retargeter.robot), standing(retargeter)
    result = tracker(motion)
    assert result.joint_deg < 2.0
    assert result.body_cm < 2.0
    assert (result.saturated_pct, result.failed_pct, result.frames) == (0.0, 0.0, 30)
    # At rest each servo is off by the torque of gravity over its stiffness, as Pinocchio computes that.
    tracked = tracker.run(motion)
    robot = retargeter.robot
    assert motion.root_pose is not None
    gravity = pin.computeGeneralizedGravity(
        robot.model, robot.data, robot.configuration(motion.root_pose[-1], tracked.joints[-1])
    )
    names = [robot.joint_names[i] for i in tracker.free]
    torque = np.array([gravity[robot.model.joints[robot.model.getJointId(name)].idx_v] for name in names])
    np.testing.assert_allclose(tracked.error_rad[-1] * tracker.stiffness, torque, atol=0.05)
    np.testing.assert_allclose(tracked.torque_ratio[-1], np.abs(torque) / tracker.limit, atol=0.01)


def test_in_free_fall_no_motor_works(retargeter: Retargeter) -> None:
    """The pelvis's acceleration reaches the arms: what falls with 9.81 m/s^2 has no weight."""
    motion = standing(retargeter)
    assert motion.root_pose is not None
    root = motion.root_pose.copy()
    root[:, 2] -= 0.5 * 9.81 * (np.arange(30) / 20.0) ** 2
    tracked = Tracker(retargeter.robot).run(dataclasses.replace(motion, root_pose=root))
    assert np.abs(tracked.error_rad).max() < 1e-3
    assert tracked.torque_ratio.max() < 1e-2


def test_faster_is_worse(retargeter: Retargeter) -> None:
    tracker, motion = Tracker(retargeter.robot), retargeter(generate_clip(0, 16)).motion
    slow, fast = tracker(motion), tracker(dataclasses.replace(motion, fps=8.0 * motion.fps))
    assert slow.joint_deg < 4.0 and slow.failed_pct == 0.0
    assert fast.joint_deg > 2.0 * slow.joint_deg
    assert fast.torque_ratio > 2.0 * slow.torque_ratio
    assert fast.saturated_pct > slow.saturated_pct
    assert tracker(motion) == slow  # nothing is left over from the run before


def test_means() -> None:
    a, b = Tracking(1.0, 0.0, 0.5, 1.0, 0.0, 10), Tracking(4.0, 30.0, 2.0, 4.0, 100.0, 20)
    assert Tracking.mean([a, b]) == Tracking(3.0, 20.0, 2.0, 3.0, 50.0, 30)
    with pytest.raises(ValueError, match="at least one"):
        Tracking.mean([])


def test_refusals(retargeter: Retargeter) -> None:
    tracker, motion = Tracker(retargeter.robot), standing(retargeter)
    for change, message in (
        ({"robot": "other"}, "is of robot 'other'"),
        ({"root_pose": None}, "joint positions"),
        ({"joint_positions": np.zeros((1, 3))}, "at least two frames"),
    ):
        with pytest.raises(ValueError, match=message):
            tracker.run(dataclasses.replace(motion, **change))
