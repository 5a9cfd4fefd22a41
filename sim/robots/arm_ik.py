"""Inverse kinematics of X1 as in the paper: each arm alone, target a 3x3 rotation and a translation in the pelvis' frame."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from sim.robots.crouch_table import CrouchTable
from sim.robots.kinematics import RobotModel
from sim.robots.pink_core import PinkCore
from sim.robots.solver import IkResult, ReachTarget

__all__ = ["PerArmSolver"]

Array = NDArray[np.float64]


class PerArmSolver:
    """Solves the arms one after the other, each with its own joints only."""

    def __init__(self, robot: RobotModel, crouches: CrouchTable) -> None:
        self._cores = {arm: PinkCore(robot, crouches, spec.joints, balance=False) for arm, spec in robot.spec.arms.items()}

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
            result = part if result is None else _joined(result, part)
        if result is None:
            raise AssertionError("targets were checked above")
        return result


def _joined(first: IkResult, second: IkResult) -> IkResult:
    return IkResult(
        second.q,
        first.success and second.success,
        max(first.position_error_m, second.position_error_m),
        max(first.rotation_error_rad, second.rotation_error_rad),
        second.balance_margin_m,
        first.iterations + second.iterations,
    )
