"""The robot's base and legs: measured state and commands."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from robots.build_solver import RobotKit
from sim.skills.body.joints import JointMap
from sim.skills.body.posture import Posture
from sim.skills.footsteps import footsteps
from sim.skills.gait import leg_motion
from sim.skills.navigation import Stance
from sim.skills.runner import CONTROL_DT_S
from sim.world.world import World

Array = NDArray[np.float64]


class Base:
    """Base and legs of one robot."""

    def __init__(self, world: World, joints: JointMap, kit: RobotKit, posture: Posture) -> None:
        self._data, self._servos = world.data, world.servos
        self._joints, self._kit, self._posture = joints, kit, posture

    def measured(self) -> Stance:
        """Where the base is."""
        x, y, _, yaw = self._servos.base_pose[:4]
        return Stance(float(x), float(y), float(yaw))

    def error_m(self) -> float:
        """Tracking error of the base in metres; heading counts 0.3 m per radian."""
        x, y, z, yaw = self._data.ctrl[self._joints.base[:4]] - self._servos.base_pose[:4]
        return float(np.sqrt(x * x + y * y + z * z + (0.3 * yaw) ** 2))

    def command(self, x: float, y: float, yaw_rad: float) -> None:
        """Sets the base target, world frame."""
        self._data.ctrl[[self._joints.base[0], self._joints.base[1], self._joints.base[3]]] = (x, y, yaw_rad)

    def command_height(self, pelvis_height_m: float) -> None:
        """Sets the pelvis height and the legs that go with it."""
        self._servos.command_height(pelvis_height_m)

    def place_legs(self, joints: Array) -> None:
        """Brings the leg joints to (L,) within one control tick, without the lag of their servos: they touch nothing."""
        data, at = self._data, self._joints.leg_positions
        rates = (joints - data.qpos[at]) / CONTROL_DT_S
        data.qvel[self._joints.leg_speeds] = rates
        data.ctrl[self._joints.legs] = joints + self._joints.lag_s[self._joints.legs] * rates

    def walking_targets(self, way: Array) -> tuple[Array, Array]:
        """Targets for base and legs along a path (T, 3) of x, y and yaw.

        Returns:
            (T, 3) commands of the base, ahead of its servos' lag, and (T, L) leg joints; the last ones are at rest.
        """
        height = self._posture.pelvis_height_m
        crouch = self._kit.crouches.posture(height)
        soles = self._kit.model.frames(self._posture.root(height), crouch, ("left_sole", "right_sole"))
        legs = leg_motion(footsteps(self._kit), height, soles[:, :2, 3], way)
        base_ids = np.array([self._joints.base[0], self._joints.base[1], self._joints.base[3]])
        return _ahead(way, self._joints.lag_s[base_ids]), legs


def _ahead(targets: Array, lag_s: Array) -> Array:
    """Targets (T, N) of a motion that ends at rest, advanced by the servo lags (N,) less what holding each for a tick gains."""
    if len(targets) < 2:
        return targets
    rates = np.gradient(targets, CONTROL_DT_S, axis=0)
    rates[-1] = 0.0
    return targets + (lag_s - 0.5 * CONTROL_DT_S) * rates
