"""Crouches on a fine grid of pelvis heights, solved once per robot, so that a height change costs a lookup."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from robots.kinematics import RobotModel, root_quaternion
from robots.leg_ik import Crouch, crouch

Array = NDArray[np.float64]


class CrouchTable:
    """Legs and lean by pelvis height, interpolated between solved postures.

    The lean is the least concave function of the height that is nowhere below the least feasible lean, so that legs and trunk
    move evenly when the height changes.

    Args:
        robot: kinematics.
        step_m: grid spacing; the soles stay within a millimetre of the floor between grid points at 5 mm.
    """

    def __init__(self, robot: RobotModel, step_m: float = 0.005) -> None:
        self.robot = robot
        low, high = robot.spec.pelvis_height_range_m
        self.heights_m: Array = np.linspace(low, high, round((high - low) / step_m) + 1)
        least = np.array([crouch(robot, float(height)).pelvis_pitch_rad for height in self.heights_m])
        leans = _concave_majorant(self.heights_m, least)
        solved = [
            crouch(robot, float(height), lean_rad=float(lean)) for height, lean in zip(self.heights_m, leans, strict=True)
        ]
        bad = [f"{c.pelvis_height_m:.3f}" for c in solved if not c.feasible]
        if bad:
            raise ValueError(
                f"{robot.spec.name}: pelvis heights {', '.join(bad)} m cannot be held; shrink pelvis_height_range_m"
            )
        self._legs = robot.indices(robot.spec.leg_joints)
        self._leg_table: Array = np.stack([c.q[self._legs] for c in solved])
        self._pitch_table: Array = np.array([c.pelvis_pitch_rad for c in solved])
        self._posture = solved[-1].q

    def clamp(self, pelvis_height_m: float) -> float:
        """The height clipped to the robot's range."""
        return float(np.clip(pelvis_height_m, self.heights_m[0], self.heights_m[-1]))

    def pitch(self, pelvis_height_m: float) -> float:
        """Forward lean (rad) at a height."""
        return float(np.interp(pelvis_height_m, self.heights_m, self._pitch_table))

    def legs(self, pelvis_height_m: float) -> Array:
        """Leg joints (L,) at a height, in the order of `spec.leg_joints`."""
        return np.array([np.interp(pelvis_height_m, self.heights_m, column) for column in self._leg_table.T])

    def apply(self, q: Array, pelvis_height_m: float) -> Array:
        """Copy of `q` (J,) with the legs of this height."""
        out = np.array(q, dtype=float)
        out[self._legs] = self.legs(pelvis_height_m)
        return out

    def posture(self, pelvis_height_m: float) -> Array:
        """(J,) joints at a height, arms at rest."""
        return self.apply(self._posture, pelvis_height_m)

    def at(self, pelvis_height_m: float) -> Crouch:
        """The posture at a height with its balance, arms at rest."""
        height = self.clamp(pelvis_height_m)
        q = self.posture(height)
        return Crouch(q, height, self.pitch(height), 0.0, self.balance_margin(q, height))

    def balance_margin(self, q: Array, pelvis_height_m: float) -> float:
        """Distance (m) of the centre of mass of `q` (J,) to the edge of the support polygon at this height."""
        height = self.clamp(pelvis_height_m)
        return self.robot.balance_margin(np.array([0.0, 0.0, height, *root_quaternion(0.0, self.pitch(height))]), q)


def _concave_majorant(x: Array, y: Array) -> Array:
    """Least concave piecewise-linear function on the grid `x` (N,) that is nowhere below `y` (N,)."""
    hull: list[int] = []
    for i in range(len(x)):
        while len(hull) >= 2:
            a, b = hull[-2], hull[-1]
            if (y[b] - y[a]) * (x[i] - x[a]) > (y[i] - y[a]) * (x[b] - x[a]):
                break
            hull.pop()
        hull.append(i)
    return np.interp(x, x[hull], y[hull])
