"""How well a robot follows a human clip: errors, contact, limits, smoothness, balance.

Definitions follow common practice: an error is the distance to the method's own targets (after scaling), limb
direction is scale-free and compares with the human, contact comes from the human's toes.
Shape letters: T frames. Units: cm, degrees, percent of frames; radians for joints.

Paper: none (the paper reports no retargeting quality).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Final

import numpy as np
from numpy.typing import NDArray

from data.contacts import toe_contacts
from data.motion import FPS
from data.retarget import MAX_JOINT_VELOCITY, Retargeted, Retargeter
from data.self_contact import DEEP_M
from data.skeleton import HumanMotion, index
from data.targets import Targets

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
_ARM_BONES: Final = (("shoulder", "elbow"), ("elbow", "wrist"))
_LEG_BONES: Final = (("hip", "knee"), ("knee", "ankle"))
_POINTS: Final = ("hip", "knee", "ankle", "shoulder", "elbow", "wrist")
_JUMP_RAD: Final = 0.2


@dataclass(frozen=True, slots=True)
class Metrics:
    """Quality of one retargeted clip.

    Attributes:
        hand_cm, hand_p95_cm: distance of the wrists to their targets, mean and 95th percentile.
        foot_cm, foot_p95_cm: same for the soles.
        arm_deg, leg_deg: mean angle between robot and human limb segments.
        skate_cm_s: mean horizontal speed of soles in contact.
        human_skate_cm_s: the human's own toes.
        penetration_cm: mean depth of the lowest sole corner below the floor.
        penetration_max_cm: the deepest of them.
        penetration_pct: frames in which that is deeper than 1 cm.
        float_pct: frames with a contact in which both soles are more than 2 cm above the floor.
        limit_pct: joint-frames outside their limits by more than 1e-3 rad.
        saturation_pct: joint-frames within 0.01 rad of a limit.
        velocity_pct: frames with a joint faster than the limit.
        jump_pct: frames in which a joint moves by more than 0.2 rad.
        jerk_rad_s3: mean size of the joints' third difference over time.
        self_pct: frames in which parts that are no neighbours overlap by more than 1 cm (`data.self_contact`).
        self_max_cm: the deepest such overlap.
        pa_mpjpe_cm: mean distance of 12 points (hips, knees, ankles, shoulders, elbows, wrists) to the human's after the best
            similarity transform of each frame: comparable across methods, whatever they scale.
        balance_cm: mean distance of the centre of mass inside the support polygon, in slow double support; nan without such
            frames.
        lowest_pelvis: lowest pelvis as a share of its standing height.
        frames: length of the clip.
    """

    hand_cm: float
    hand_p95_cm: float
    foot_cm: float
    foot_p95_cm: float
    arm_deg: float
    leg_deg: float
    skate_cm_s: float
    human_skate_cm_s: float
    penetration_cm: float
    penetration_max_cm: float
    penetration_pct: float
    float_pct: float
    limit_pct: float
    saturation_pct: float
    velocity_pct: float
    jump_pct: float
    jerk_rad_s3: float
    self_pct: float
    self_max_cm: float
    pa_mpjpe_cm: float
    balance_cm: float
    lowest_pelvis: float
    frames: int

    @staticmethod
    def mean(of: Sequence[Metrics]) -> Metrics:
        """Mean over clips, weighted by their frames; nan entries are left out. Of a greatest value it is the greatest.

        Raises:
            ValueError: on an empty list.
        """
        if not of:
            raise ValueError("no metrics to average; at least one clip is needed")
        weight = np.array([m.frames for m in of], dtype=float)
        values: dict[str, float] = {}
        for f in fields(Metrics):
            column = np.array([getattr(m, f.name) for m in of], dtype=float)
            known = np.isfinite(column)
            if not known.any():
                values[f.name] = float("nan")
            elif f.name.endswith("_max_cm"):
                values[f.name] = float(column[known].max())
            else:
                values[f.name] = float(np.average(column[known], weights=weight[known]))
        return Metrics(**{**values, "frames": int(weight.sum())})  # type: ignore[arg-type]


def angle_deg(a: Array, b: Array) -> Array:
    """Angle between vectors (..., 3) in degrees."""
    cross = np.linalg.norm(np.cross(a, b), axis=-1)
    return np.rad2deg(np.arctan2(cross, np.sum(a * b, axis=-1)))


def skate_cm_s(places: Array, contact: Mask, fps: float) -> float:
    """Mean horizontal speed (cm/s) of points (T, N, 3) while in contact (T, N) in both frames of a step; 0 without contact."""
    speed = np.linalg.norm(np.diff(places[..., :2], axis=0), axis=-1) * fps * 100.0
    both = contact[1:] & contact[:-1]
    return float(speed[both].mean()) if both.any() else 0.0


def limit_violation_pct(q: Array, lower: Array, upper: Array, tolerance: float = 1e-3) -> float:
    """Percent of joint-frames (T, J) outside the limits (J,) by more than `tolerance` rad."""
    return float(100.0 * np.mean((q < lower - tolerance) | (q > upper + tolerance)))


def saturation_pct(q: Array, lower: Array, upper: Array, margin: float = 0.01) -> float:
    """Percent of joint-frames (T, J) within `margin` rad of a limit (J,)."""
    return float(100.0 * np.mean((q < lower + margin) | (q > upper - margin)))


def pa_mpjpe_cm(points: Array, reference: Array) -> float:
    """Mean distance (cm) of points (T, P, 3) to reference points after the best similarity transform of each frame.

    Rotation, scale and shift follow from the singular values of the cross-covariance (Umeyama), without reflection.
    """
    a, b = points - points.mean(axis=1, keepdims=True), reference - reference.mean(axis=1, keepdims=True)
    left, sizes, right = np.linalg.svd(np.swapaxes(a, 1, 2) @ b)  # a^T b = left sizes right
    sign = np.sign(np.linalg.det(left) * np.linalg.det(right))
    sizes[:, 2] *= sign
    left[:, :, 2] *= sign[:, None]
    scale = sizes.sum(axis=1) / np.maximum(np.sum(a * a, axis=(1, 2)), 1e-12)
    fitted = scale[:, None, None] * (a @ left @ right)
    return float(100.0 * np.linalg.norm(fitted - b, axis=-1).mean())


def jerk_rad_s3(q: Array, fps: float) -> float:
    """Mean absolute third difference over time of joints (T, J), rad/s^3; 0 for fewer than four frames."""
    return float(np.abs(np.diff(q, 3, axis=0)).mean() * fps**3) if len(q) > 3 else 0.0


def balance_cm(retargeter: Retargeter, root_pose: Array, q: Array, contact: Mask) -> float:
    """Mean signed distance (cm) of the centre of mass to the support polygon's edge, over slow double support.

    Args:
        retargeter: of the robot.
        root_pose: (T, 7) metres and quaternion (w, x, y, z).
        q: (T, J) joints.
        contact: (T, 2) planted feet.

    Returns:
        Positive inside; nan without such frames.
    """
    slow = np.zeros(len(q), dtype=bool)
    slow[1:] = np.linalg.norm(np.diff(root_pose[:, :2], axis=0), axis=1) * FPS < 0.1
    frames = np.flatnonzero(contact.all(axis=1) & slow)[::4]
    margins = [retargeter.robot.balance_margin(root_pose[t], q[t]) for t in frames]
    return float(100.0 * np.mean(margins)) if margins else float("nan")


def evaluate(retargeter: Retargeter, result: Retargeted) -> Metrics:
    """Metrics of one retargeted clip."""
    motion = result.motion
    assert motion.root_pose is not None
    assert motion.joint_positions is not None
    targets = result.targets
    return evaluate_joints(retargeter, motion.root_pose, motion.joint_positions, result.source, targets.contact, targets)


def evaluate_joints(
    retargeter: Retargeter, root: Array, q: Array, source: HumanMotion, contact: Mask, targets: Targets | None = None
) -> Metrics:
    """Metrics of a motion of the robot, whichever method made it.

    Args:
        retargeter: of the robot.
        root: (T, 7) position (m) and quaternion (w, x, y, z) of the pelvis at 20 frames per second.
        q: (T, J) joints, in the order of `RobotModel.joint_names`.
        source: the human motion that it follows, in the same world and frame by frame.
        contact: (T, 2) planted feet of the human.
        targets: what the method aimed at; None when those are not known, which leaves hand and foot errors nan.

    Raises:
        ValueError: when the lengths differ.
    """
    human = source.joints
    if not len(root) == len(q) == len(contact) == len(human):
        lengths = f"{len(root)}, {len(q)}, {len(contact)} and {len(human)}"
        raise ValueError(f"root poses, joints, contacts and human have {lengths} frames; they must be as many")
    robot, spec = retargeter.robot, retargeter.spec
    places = retargeter.measured_joints(root, q)
    soles, corners = places.soles, places.sole_corners
    hand = foot = np.array([np.nan])
    if targets is not None:
        foot = np.linalg.norm(soles - targets.soles, axis=-1) * 100.0
        hand = np.linalg.norm(places.arms.sum(axis=2) - targets.arms.sum(axis=2), axis=-1) * 100.0
    side = lambda name: human[:, [index(f"left_{name}"), index(f"right_{name}")]]  # noqa: E731
    arm = [angle_deg(places.arms[:, :, k], side(b) - side(a)) for k, (a, b) in enumerate(_ARM_BONES)]
    leg = [angle_deg(places.legs[:, :, k], side(b) - side(a)) for k, (a, b) in enumerate(_LEG_BONES)]
    lowest = corners[..., 2].reshape(len(q), -1).min(axis=1)
    depth = np.maximum(-lowest, 0.0) * 100.0
    overlap = np.array([retargeter.self_contact.depth_m(pose, joints) for pose, joints in zip(root, q, strict=True)])
    touching = contact.any(axis=1)
    moves = np.abs(np.diff(q, axis=0))
    body = robot.indices((*spec.leg_joints, *spec.waist_joints, *(j for a in spec.arms.values() for j in a.joints)))
    lower, upper = robot.lower[body], robot.upper[body]
    return Metrics(
        hand_cm=float(hand.mean()),
        hand_p95_cm=float(np.quantile(hand, 0.95)),
        foot_cm=float(foot.mean()),
        foot_p95_cm=float(np.quantile(foot, 0.95)),
        arm_deg=float(np.mean(arm)),
        leg_deg=float(np.mean(leg)),
        skate_cm_s=skate_cm_s(soles, contact, FPS),
        human_skate_cm_s=skate_cm_s(
            human[:, [index("left_foot"), index("right_foot")]], toe_contacts(human, source.fps), source.fps
        ),
        penetration_cm=float(depth.mean()),
        penetration_max_cm=float(depth.max()),
        penetration_pct=float(100.0 * np.mean(depth > 1.0)),
        float_pct=float(100.0 * np.mean(touching & (soles[..., 2].min(axis=1) > 0.02))),
        limit_pct=limit_violation_pct(q[:, body], lower, upper),
        saturation_pct=saturation_pct(q[:, body], lower, upper),
        velocity_pct=float(100.0 * np.mean((moves[:, body] * FPS > MAX_JOINT_VELOCITY).any(axis=1))) if len(q) > 1 else 0.0,
        jump_pct=float(100.0 * np.mean((moves[:, body] > _JUMP_RAD).any(axis=1))) if len(q) > 1 else 0.0,
        jerk_rad_s3=jerk_rad_s3(q[:, body], FPS),
        self_pct=float(100.0 * np.mean(overlap > DEEP_M)),
        self_max_cm=float(100.0 * overlap.max()),
        pa_mpjpe_cm=pa_mpjpe_cm(places.points, np.concatenate([side(name) for name in _POINTS], axis=1)),
        balance_cm=balance_cm(retargeter, root, q, contact),
        lowest_pelvis=float(root[:, 2].min() / spec.standing_pelvis_height_m),
        frames=len(q),
    )
