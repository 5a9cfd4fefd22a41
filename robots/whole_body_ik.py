"""Inverse kinematics of H1 as in the paper: one problem for waist and both arms, 4x4 targets, current q and dq, balance.

The centre of mass is a task of the same quadratic program, so that reaching far is paid for by the posture, and a solution
whose centre of mass leaves the support polygon is not a success. Legs and lean follow the pelvis height (see `leg_ik`).
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from robots.crouch_table import CrouchTable
from robots.kinematics import RobotModel
from robots.pink_core import PinkCore
from robots.solver import IkResult, ReachTarget

Array = NDArray[np.float64]


class WholeBodySolver:
    """Solves waist and both arms together; an arm without a target keeps its posture as well as it can.

    Args:
        robot: kinematics.
        crouches: legs and lean by pelvis height.
        avoid_self: whether the robot keeps out of itself; without, it is measured only.
    """

    def __init__(self, robot: RobotModel, crouches: CrouchTable, avoid_self: bool = True) -> None:
        spec = robot.spec
        movable = (*spec.waist_joints, *spec.arms["left"].joints, *spec.arms["right"].joints)
        self._core = PinkCore(robot, crouches, movable, balance=True, avoid_self=avoid_self)

    def solve(
        self,
        targets: Mapping[str, ReachTarget],
        q: Array,
        dq: Array | None = None,
        *,
        pelvis_height_m: float,
        tolerance_m: float = 0.01,
        restarts: int = 3,
    ) -> IkResult:
        """See `ArmSolver.solve`."""
        return self._core.solve(targets, q, dq, pelvis_height_m, tolerance_m, restarts)
