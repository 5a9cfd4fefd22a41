"""Inverse kinematics of X1 as in the paper: each arm alone, target a 3x3 rotation and a translation in the pelvis' frame."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from robots.crouch_table import CrouchTable
from robots.kinematics import RobotModel
from robots.pink_core import PinkCore
from robots.self_collision import SELF_TOUCH_M
from robots.solver import IkResult, ReachTarget

Array = NDArray[np.float64]


class PerArmSolver:
    """Solves the arms one after the other, each with its own joints only and clear of where the other one is then.

    Args:
        robot: kinematics.
        crouches: legs and lean by pelvis height.
        avoid_self: whether the robot keeps out of itself; without, it is measured only.
    """

    def __init__(self, robot: RobotModel, crouches: CrouchTable, avoid_self: bool = True) -> None:
        self._robot = robot
        self._cores = {
            arm: PinkCore(robot, crouches, spec.joints, balance=False, avoid_self=avoid_self)
            for arm, spec in robot.spec.arms.items()
        }

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
        unknown = sorted(set(targets) - set(self._cores))
        if unknown or not targets:
            raise ValueError(f"targets for arms {unknown or 'none'}; allowed: left, right")
        result: IkResult | None = None
        for arm in sorted(targets):
            part = self._cores[arm].solve(
                {arm: targets[arm]}, q if result is None else result.q, dq, pelvis_height_m, tolerance_m, restarts
            )
            result = part if result is None else self._joined(result, part)
        if result is None:
            raise AssertionError("targets were checked above")
        return result

    def _joined(self, first: IkResult, second: IkResult) -> IkResult:
        # the first arm kept clear of where the second one was before
        clearance = self._robot.own_body.clearance_m(second.q)
        return IkResult(
            second.q,
            first.success and second.success and clearance >= -SELF_TOUCH_M,
            max(first.position_error_m, second.position_error_m),
            max(first.rotation_error_rad, second.rotation_error_rad),
            second.balance_margin_m,
            first.iterations + second.iterations,
            clearance,
        )
