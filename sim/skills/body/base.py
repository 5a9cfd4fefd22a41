"""The robot's base and legs: measured state and commands."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from robots.build_solver import RobotKit
from sim.skills.body.joints import JointMap
from sim.skills.body.posture import Posture
from sim.skills.footsteps import footsteps
from sim.skills.gait import leg_motion
from sim.skills.navigation import Stance
from sim.skills.runner import CONTROL_DT_S
from sim.skills.trajectory import min_jerk
from sim.world.world import World

Array = NDArray[np.float64]
#: How far above its lowest height a pelvis has to be for the legs to step, and in what time it rises to it.
_STEPPING_M: Final = 0.06
_RISE_S: Final = 0.3


@dataclass(frozen=True, slots=True)
class Walk:
    """A planned walk.

    Attributes:
        base: who walks.
        poses: (T, 3) commands of x, y and yaw, ahead of the servos' lag.
        heights_m: (T,) commands of the pelvis height.
        legs: (T, L) leg joints; the last ones are at rest.
    """

    base: Base
    poses: Array
    heights_m: Array
    legs: Array

    def command(self, tick: int, pose: Array | None = None) -> None:
        """Commands what belongs to a tick; `pose` (3,) in place of the one that is ahead of the lag."""
        self.base.command(self.poses[tick] if pose is None else pose)
        self.base.raise_pelvis(float(self.heights_m[tick]))
        self.base.place_legs(self.legs[tick])

    def stand(self, tick: int, share: float) -> None:
        """Brings the feet together from a tick, 0 to 1."""
        self.base.raise_pelvis(float((1.0 - share) * self.heights_m[tick] + share * self.heights_m[0]))
        self.base.place_legs((1.0 - share) * self.legs[tick] + share * self.legs[0])


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

    def command(self, pose: Array) -> None:
        """Sets the base target, (3,) x, y and yaw, world frame."""
        self._data.ctrl[[self._joints.base[0], self._joints.base[1], self._joints.base[3]]] = pose

    def command_height(self, pelvis_height_m: float) -> None:
        """Sets the pelvis height and the legs that go with it."""
        self._servos.command_height(pelvis_height_m)

    def place_legs(self, joints: Array) -> None:
        """Brings the leg joints to (L,) within one control tick, without the lag of their servos: they touch nothing."""
        data, at = self._data, self._joints.leg_positions
        rates = (joints - data.qpos[at]) / CONTROL_DT_S
        data.qvel[self._joints.leg_speeds] = rates
        data.ctrl[self._joints.legs] = joints + self._joints.lag_s[self._joints.legs] * rates

    def walk(self, way: Array, rises: bool = True) -> Walk:
        """Base and legs along a path.

        Args:
            way: (T, 3) x, y and yaw, the present pose first.
            rises: whether the pelvis may rise on the way from where it is too low for the legs to step.
        """
        height = self._posture.pelvis_height_m
        feet = footsteps(self._kit)
        missing_m = self._kit.spec.pelvis_height_range_m[0] + _STEPPING_M - height
        ends_s = CONTROL_DT_S * np.minimum(np.arange(len(way)), np.arange(len(way))[::-1])
        rise = max(missing_m, 0.0) * rises * np.array([min_jerk(time_s / _RISE_S) for time_s in ends_s])  # (T,)
        crouch = self._kit.crouches.posture(height)
        soles = self._kit.model.frames(self._posture.root(height), crouch, ("left_sole", "right_sole"))
        legs = leg_motion(feet, height, soles[:, :2, 3], way, rise)
        base_ids = np.array([self._joints.base[0], self._joints.base[1], self._joints.base[3]])
        return Walk(self, _ahead(way, self._joints.lag_s[base_ids]), height + rise, legs)

    def raise_pelvis(self, pelvis_height_m: float) -> None:
        """Sets the pelvis height alone, of walking legs that go with it."""
        self._data.ctrl[self._joints.base[2]] = pelvis_height_m


def _ahead(targets: Array, lag_s: Array) -> Array:
    """Targets (T, N) of a motion that ends at rest, advanced by the servo lags (N,) less what holding each for a tick gains."""
    if len(targets) < 2:
        return targets
    rates = np.gradient(targets, CONTROL_DT_S, axis=0)
    rates[-1] = 0.0
    return targets + (lag_s - 0.5 * CONTROL_DT_S) * rates
