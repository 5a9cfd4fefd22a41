"""Crouching: legs and trunk lean that put the pelvis at a height with both soles flat and the centre of mass over the feet.

Each leg is solved by damped Gauss-Newton on its sole's pose; the feet are moved fore and aft under the pelvis until the centre
of mass lies above the middle of the soles, as a standing person does. Where an ankle's limit stops an upright crouch, the
pelvis leans forward as little as is needed: H1 reaches down to coffee tables only so.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from robots.kinematics import RobotModel, root_quaternion

Array = NDArray[np.float64]
#: Sole error above which a height counts as out of reach.
SOLE_TOLERANCE_M = 1e-3
_DAMPING = 1e-6
LEANS_RAD = np.arange(0.0, 0.71, 0.05)


@dataclass(frozen=True, slots=True)
class Crouch:
    """A standing posture.

    Attributes:
        q: (J,) joints with the legs solved, other joints as given.
        pelvis_height_m: the height asked for.
        pelvis_pitch_rad: forward lean of the pelvis.
        sole_error_m: largest distance of a sole from its place on the floor.
        balance_margin_m: distance of the centre of mass to the edge of the support polygon.
    """

    q: Array
    pelvis_height_m: float
    pelvis_pitch_rad: float
    sole_error_m: float
    balance_margin_m: float

    @property
    def feasible(self) -> bool:
        """Soles on the floor and centre of mass over the support polygon."""
        return self.sole_error_m <= SOLE_TOLERANCE_M and self.balance_margin_m > 0.0


def crouch(robot: RobotModel, pelvis_height_m: float, q: Array | None = None, lean_rad: float | None = None) -> Crouch:
    """Solves the legs for a pelvis height, with the smallest forward lean that makes it feasible.

    Args:
        robot: kinematics.
        pelvis_height_m: pelvis above the floor.
        q: (J,) posture of the other joints; arms at rest when None.
        lean_rad: the forward lean to use; None searches for the smallest that is feasible.

    Returns:
        The first feasible posture over leans of 0 to 0.7 rad, or the one with the smallest sole error when none is.
    """
    posture = robot.arm_posture(robot.posture(), "rest") if q is None else np.array(q, dtype=float)
    best: Crouch | None = None
    for pitch_rad in LEANS_RAD if lean_rad is None else (lean_rad,):
        found = _crouch_with_lean(robot, pelvis_height_m, float(pitch_rad), posture)
        if found.feasible:
            return found
        if best is None or found.sole_error_m < best.sole_error_m:
            best = found
    if best is None:
        raise AssertionError("LEANS_RAD is empty")
    return best


def _crouch_with_lean(robot: RobotModel, pelvis_height_m: float, pitch_rad: float, start: Array) -> Crouch:
    spec = robot.spec
    posture = start.copy()
    root = np.array([0.0, 0.0, pelvis_height_m, *root_quaternion(0.0, pitch_rad)])
    standing = robot.frames(np.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0]), robot.posture(), ("left_sole", "right_sole"))
    lateral = standing[:, 1, 3]
    forward = float(standing[:, 0, 3].mean())
    error = np.inf
    legs = robot.indices(spec.leg_joints)
    posture[legs] = _bent_start(robot, pelvis_height_m)[legs]
    for _ in range(8):
        targets = [pin.SE3(np.eye(3), np.array([forward, lateral[i], 0.0])) for i in range(2)]
        posture, error = solve_legs(robot, root, posture, targets)
        offset = float(robot.centre_of_mass(root, posture)[0]) - forward
        if abs(offset) < 5e-4:
            break
        forward += offset
    return Crouch(posture, pelvis_height_m, pitch_rad, error, robot.balance_margin(root, posture))


def _bent_start(robot: RobotModel, pelvis_height_m: float) -> Array:
    """Legs bent a little the right way round, so that the knees do not start at their singularity."""
    standing = robot.spec.standing_pelvis_height_m
    bend = np.clip(1.2 * (standing - pelvis_height_m) / standing, 0.02, 0.7)
    q = robot.posture()
    for name in robot.spec.leg_joints:
        sign = _pitch_sign(robot, name)
        part = -bend if "hip_pitch" in name else 2.0 * bend if "knee" in name else -bend if "ankle" in name else 0.0
        if "ankle_roll" not in name:
            q[robot.indices((name,))] = sign * part
    return np.clip(q, robot.lower, robot.upper)


def _pitch_sign(robot: RobotModel, joint: str) -> float:
    """+1 when a positive angle pitches the child link nose-down (about world +y at the zero pose), else -1."""
    frames = robot.configuration(np.array([0, 0, 0, 1.0, 0, 0, 0]), robot.posture())
    pin.computeJointJacobians(robot.model, robot.data, frames)
    index = robot.model.getJointId(joint)
    jacobian = pin.getJointJacobian(robot.model, robot.data, index, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED)
    column = jacobian[3:, robot.model.joints[index].idx_v]
    return 1.0 if column[1] >= 0.0 else -1.0


def solve_legs(
    robot: RobotModel,
    root: Array,
    posture: Array,
    targets: list[pin.SE3],
    *,
    level: float = 1.0,
    damping: float = _DAMPING,
    iterations: int = 60,
) -> tuple[Array, float]:
    """Leg joints that put the soles at two poses, world frame, from the legs of `posture`.

    Args:
        robot: kinematics.
        root: (7,) pose of the pelvis.
        posture: (J,) joints.
        targets: poses of the left and the right sole.
        level: weight of a radian of roll or pitch of a sole against a metre.
        damping: of the Gauss-Newton steps.
        iterations: how many at most.

    Returns:
        (J,) joints, and the largest distance of a sole from its place (m), its turn counted with 0.1 m per radian.
    """
    model, data = robot.model, robot.data
    legs = robot.indices(robot.spec.leg_joints)
    columns = np.array([model.joints[model.getJointId(name)].idx_v for name in robot.spec.leg_joints])
    soles = [robot.frame_id("left_sole"), robot.frame_id("right_sole")]
    q = posture.copy()
    worst = np.inf
    weights = np.tile([1.0, 1.0, 1.0, level, level, 1.0], len(soles))
    for _ in range(iterations):
        full = robot.configuration(root, q)
        pin.computeJointJacobians(model, data, full)
        pin.updateFramePlacements(model, data)
        errors, rows = [], []
        worst = 0.0
        for frame, target in zip(soles, targets, strict=True):
            pose = data.oMf[frame]
            rotation = pin.log3(target.rotation @ pose.rotation.T)
            shift = target.translation - pose.translation
            worst = max(worst, float(np.linalg.norm(shift)), 0.1 * float(np.linalg.norm(rotation)))
            errors.append(np.concatenate([shift, rotation]))
            rows.append(pin.getFrameJacobian(model, data, frame, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED)[:, columns])
        if worst < 1e-6:
            break
        jacobian, error = weights[:, None] * np.concatenate(rows), weights * np.concatenate(errors)
        step = jacobian.T @ np.linalg.solve(jacobian @ jacobian.T + damping * np.eye(len(error)), error)
        q[legs] = np.clip(q[legs] + np.clip(step, -0.3, 0.3), robot.lower[legs], robot.upper[legs])
    return q, worst


@lru_cache(maxsize=16)
def pelvis_height_range(robot: RobotModel, step_m: float = 0.01) -> tuple[float, float]:
    """Lowest and highest pelvis height (m) of the run of feasible heights below standing, on a grid."""
    heights = np.arange(robot.spec.standing_pelvis_height_m, 0.15, -step_m)
    good: list[float] = []
    for height in heights:
        if not crouch(robot, float(height)).feasible:
            break
        good.append(float(height))
    if not good:
        raise ValueError(f"{robot.spec.name}: cannot stand at {robot.spec.standing_pelvis_height_m} m")
    return good[-1], good[0]
