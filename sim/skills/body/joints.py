"""Where the robot's joints, servos and hands are in MuJoCo's arrays."""

from __future__ import annotations

import mujoco
import numpy as np
from numpy.typing import NDArray

from interface.bodies import Arm
from robots.spec import RobotSpec
from sim.scene.compiler import BASE_JOINTS

Array = NDArray[np.float64]
Indices = NDArray[np.int64]


class JointMap:
    """Indices of one robot in a compiled model.

    Args:
        model: the compiled room with its robot.
        spec: the robot.

    Attributes:
        actuators: actuator per joint name, for joints that have one.
        base: actuators of x, y, pelvis height, yaw and pitch.
        positions: (J,) address in `qpos` of every joint of the robot.
        arms, hands: actuators per arm.
        arm_positions: (A,) addresses in `qpos` per arm.
        legs, waist: actuators.
        leg_positions, leg_speeds: (L,) addresses in `qpos` and `qvel`.
        grasp_sites: site per arm.
        lag_s: (nu,) how far each servo is behind a steadily moving target: its damping over its stiffness.
    """

    def __init__(self, model: mujoco.MjModel, spec: RobotSpec) -> None:
        self.actuators = {name: int(model.actuator(name).id) for name in spec.joints if _has_actuator(model, name)}
        self.base = [int(model.actuator(name).id) for name in BASE_JOINTS]
        self.positions = _addresses(model, spec.joints)
        self.arms = {arm: self._ids(spec.arms[arm.value].joints) for arm in Arm}
        self.hands = {arm: self._ids(spec.arms[arm.value].hand_joints) for arm in Arm}
        self.arm_positions = {arm: _addresses(model, spec.arms[arm.value].joints) for arm in Arm}
        self.legs, self.waist = self._ids(spec.leg_joints), self._ids(spec.waist_joints)
        self.leg_positions = _addresses(model, spec.leg_joints)
        self.leg_speeds = np.array([int(model.joint(name).dofadr[0]) for name in spec.leg_joints])
        self.grasp_sites = {arm: int(model.site(spec.arms[arm.value].grasp_site).id) for arm in Arm}
        self.lag_s = _lags(model)

    def _ids(self, names: tuple[str, ...]) -> Indices:
        return np.array([self.actuators[name] for name in names])


def _addresses(model: mujoco.MjModel, names: tuple[str, ...]) -> Indices:
    return np.array([int(model.joint(name).qposadr[0]) for name in names])


def _lags(model: mujoco.MjModel) -> Array:
    """(nu,) seconds that each position servo lags behind a steadily moving target: its damping over its stiffness."""
    stiffness = np.maximum(model.actuator_gainprm[:, 0], 1e-9)
    joints = model.actuator_trnid[:, 0]
    damping = model.dof_damping[model.jnt_dofadr[joints]].reshape(-1) - model.actuator_biasprm[:, 2]
    return damping / stiffness


def _has_actuator(model: mujoco.MjModel, name: str) -> bool:
    return mujoco.mj_name2id(model, int(mujoco.mjtObj.mjOBJ_ACTUATOR), name) >= 0
