"""The stance and pelvis height for which geometric questions are asked, and the frames that follow from them.

Frames: `world`; `pelvis` is the pelvis heading frame; the trunk's is the pelvis frame turned with the lean.
"""

from __future__ import annotations

import mujoco
import numpy as np
from numpy.typing import NDArray

from interface.bodies import Arm
from robots.build_solver import RobotKit
from sim.skills.body.hypothesis import Hypothesis
from sim.skills.body.joints import JointMap
from sim.skills.navigation import Stance
from sim.skills.reach_map import HandPose, reach_maps

Array = NDArray[np.float64]


class Posture:
    """Commanded stance and pelvis height, or those of a hypothesis.

    Args:
        data: simulator state; the commands are read from its controls.
        joints: where they are.
        kit: the robot's kinematics.
        hypothesis: what is assumed in place of the commands.
    """

    def __init__(self, data: mujoco.MjData, joints: JointMap, kit: RobotKit, hypothesis: Hypothesis) -> None:
        self._data, self._joints, self._kit, self.hypothesis = data, joints, kit, hypothesis

    def under(self, hypothesis: Hypothesis) -> Posture:
        """The same robot under another hypothesis."""
        return Posture(self._data, self._joints, self._kit, hypothesis)

    def stance(self) -> Stance:
        """Commanded or assumed base pose."""
        if self.hypothesis.stance is not None:
            return self.hypothesis.stance
        x, y, _, yaw = self._data.ctrl[self._joints.base[:4]]
        return Stance(float(x), float(y), float(yaw))

    @property
    def pelvis_height_m(self) -> float:
        """Commanded pelvis height, or the assumed one."""
        assumed = self.hypothesis.pelvis_height_m
        return float(self._data.ctrl[self._joints.base[2]]) if assumed is None else assumed

    def to_pelvis(self, point: Array, pelvis_height_m: float | None = None, base: Stance | None = None) -> Array:
        """A world point in the pelvis frame, for a base and a pelvis height (the commanded ones by default)."""
        base = self.stance() if base is None else base
        height = self.pelvis_height_m if pelvis_height_m is None else pelvis_height_m
        return self.turn_to_pelvis(np.asarray(point, dtype=float) - (base.x, base.y, height), base)

    def target_in_pelvis(self, hand_target: HandPose, pelvis_height_m: float, base: Stance | None = None) -> HandPose:
        return HandPose(
            self.to_pelvis(hand_target.position, pelvis_height_m, base),
            None if hand_target.pointing is None else self.turn_to_pelvis(hand_target.pointing, base),
            None if hand_target.closing is None else self.turn_to_pelvis(hand_target.closing, base),
            hand_target.either_way,
        )

    def turn_to_pelvis(self, direction: Array, base: Stance | None = None) -> Array:
        """A world direction in the pelvis frame."""
        yaw = (self.stance() if base is None else base).yaw_rad
        c, s = np.cos(yaw), np.sin(yaw)
        return np.array([c * direction[0] + s * direction[1], -s * direction[0] + c * direction[1], direction[2]])

    def turn_to_world(self, direction: Array) -> Array:
        """A direction of the pelvis frame in the world."""
        yaw = self.stance().yaw_rad
        c, s = np.cos(yaw), np.sin(yaw)
        return np.array([c * direction[0] - s * direction[1], s * direction[0] + c * direction[1], direction[2]])

    def in_trunk(self, point: Array, pelvis_height_m: float | None = None, base: Stance | None = None) -> Array:
        """A world point in the frame of the reach maps: the pelvis frame, turned with the trunk's lean."""
        height = self.pelvis_height_m if pelvis_height_m is None else pelvis_height_m
        return self.lean(height).T @ self.to_pelvis(point, height, base)

    def shoulder(self, arm: Arm) -> Array:
        """World position of a shoulder, from the commanded base."""
        base = self.stance()
        x, y, z = self.lean(self.pelvis_height_m) @ reach_maps(self._kit)[arm.value].shoulder
        c, s = np.cos(base.yaw_rad), np.sin(base.yaw_rad)
        return np.array([base.x + c * x - s * y, base.y + s * x + c * y, self.pelvis_height_m + z])

    def lean(self, pelvis_height_m: float) -> Array:
        """(3, 3) rotation of the trunk's lean at a pelvis height, pelvis frame."""
        pitch = self._kit.crouches.pitch(pelvis_height_m)
        c, s = np.cos(pitch), np.sin(pitch)
        return np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])

    def root(self, pelvis_height_m: float) -> Array:
        """(7,) pose of the pelvis at its own origin, leaning as it does at a height: position and quaternion (w, x, y, z)."""
        return np.array([0.0, 0.0, 0.0, *quaternion_about_y(self._kit.crouches.pitch(pelvis_height_m))])


def quaternion_about_y(angle_rad: float) -> Array:
    """(4,) rotation about the y axis, w first."""
    return np.array([np.cos(angle_rad / 2), 0.0, np.sin(angle_rad / 2), 0.0])
