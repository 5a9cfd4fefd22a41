"""Which pelvis heights bring a point within reach: the question behind `BodyTooHigh`, `BodyTooLow` and `TooFar`."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robots.build_solver import RobotKit
from robots.solver import ReachTarget

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Reach:
    """Answer for one point.

    Attributes:
        heights_m: (N,) pelvis heights asked about, ascending.
        shortfall_m: (N,) distance of the grasp site from the point at each height.
        reached: (N,) whether the point is reached in balance at each height.
    """

    heights_m: Array
    shortfall_m: Array
    reached: NDArray[np.bool_]


def reach_over_heights(
    kit: RobotKit, arm: str, point_in_base: Array, rotation: Array | None = None, heights: int = 5, restarts: int = 1
) -> Reach:
    """Asks the solver at several pelvis heights.

    Args:
        kit: robot.
        arm: `left` or `right`.
        point_in_base: (3,) metres: ahead of and left of the pelvis, above the floor.
        rotation: (3, 3) wanted orientation of the hand in the heading frame, or None.
        heights: number of pelvis heights, evenly over the robot's range.
        restarts: see `ArmSolver.solve`; few keep the answer quick, each height takes 2 to 15 ms.
    """
    grid = np.linspace(*kit.spec.pelvis_height_range_m, heights)
    shortfall, reached = np.zeros(heights), np.zeros(heights, dtype=bool)
    for i, height in enumerate(grid):
        target = ReachTarget(np.asarray(point_in_base, dtype=float) - np.array([0.0, 0.0, height]), rotation)
        start = kit.crouches.at(float(height)).q
        result = kit.solver.solve({arm: target}, start, pelvis_height_m=float(height), restarts=restarts)
        shortfall[i], reached[i] = result.position_error_m, result.success
    return Reach(grid, shortfall, reached)
