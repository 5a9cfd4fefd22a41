"""The seam between skills and inverse kinematics: targets in, joints and residuals out.

`ArmSolver` is what skills, the expert and the failure margins use. Two solvers implement it, as in the paper:
`arm_ik.PerArmSolver` (X1, each arm alone) and `whole_body_ik.WholeBodySolver` (H1, both arms at once, balanced).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class ReachTarget:
    """Where a grasp site shall be, in the pelvis heading frame (origin at the pelvis, z up, turned with the yaw only).

    Attributes:
        position: (3,) metres.
        rotation: (3, 3) orientation of the grasp site (x along the fingers, y the closing direction), or None.
        pointing_weight: weight of the fingers' direction (radians against metres); 0 leaves it free.
        roll_weight: weight of the roll about the fingers' direction.
    """

    position: Array
    rotation: Array | None = None
    pointing_weight: float = 0.3
    roll_weight: float = 0.1

    def __post_init__(self) -> None:
        if np.shape(self.position) != (3,) or not np.all(np.isfinite(self.position)):
            raise ValueError(f"target position {self.position!r} must be three finite numbers")
        if self.rotation is not None and np.shape(self.rotation) != (3, 3):
            raise ValueError(f"target rotation of shape {np.shape(self.rotation)} must be (3, 3)")

    @staticmethod
    def from_pose(pose: Array) -> ReachTarget:
        """Full 4x4 target, orientation weighted like the paper's H1 problem."""
        return ReachTarget(np.asarray(pose)[:3, 3].copy(), np.asarray(pose)[:3, :3].copy(), 0.3, 0.3)


@dataclass(frozen=True, slots=True)
class IkResult:
    """Outcome of a solve.

    Attributes:
        q: (J,) joints; those that the solver does not own are as given.
        success: every targeted arm within the position tolerance, balanced, and free of the robot's own body.
        position_error_m: largest position error over the targeted arms.
        rotation_error_rad: largest angle between wanted and reached pointing direction.
        balance_margin_m: distance of the centre of mass to the edge of the support polygon.
        iterations: steps taken, over all restarts.
        self_clearance_m: distance of the arms that were solved for to trunk, legs and each other, negative when they overlap.
    """

    q: Array
    success: bool
    position_error_m: float
    rotation_error_rad: float
    balance_margin_m: float
    iterations: int
    self_clearance_m: float


class ArmSolver(Protocol):
    """Solves for grasp sites of one or both arms."""

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
        """Joints that bring the grasp sites to their targets.

        Args:
            targets: by arm, `left` or `right`.
            q: (J,) current joints, the warm start.
            dq: (J,) current velocities, None at rest.
            pelvis_height_m: pelvis above the floor, which fixes legs and lean.
            tolerance_m: position error that counts as reached.
            restarts: other starting postures to try when the warm start fails.
        """
        ...


def rotation_from_axes(pointing: Array, closing: Array) -> Array:
    """(3, 3) rotation with x along `pointing` and y as close to `closing` as orthogonality allows."""
    x = np.asarray(pointing, dtype=float) / np.linalg.norm(pointing)
    y = np.asarray(closing, dtype=float) - x * float(np.dot(closing, x))
    norm = float(np.linalg.norm(y))
    if norm < 1e-6:
        raise ValueError(f"closing direction {closing} is parallel to the pointing direction {pointing}")
    y /= norm
    return np.stack([x, y, np.cross(x, y)], axis=1)
