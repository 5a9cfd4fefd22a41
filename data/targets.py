"""What a robot should do to follow a human clip: soles, pelvis and limb vectors per frame, in the robot's size.

Lengths scale by the ratio of the legs. A planted foot gets one place per contact run; soles stay flat and are moved out to the
robot's hip width; the pelvis takes the trunk's orientation and is lowered until both legs reach; each arm bone points along the
human's.
Shape letters: T frames. Frames: world, z up, floor at 0.

Paper: data preparation, "retargeted to the robot". Left out: the roll of a foot from heel to toe.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d, minimum_filter1d

from data.contacts import lock, toe_contacts
from data.skeleton import HumanMotion, index

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Measures:
    """A robot's sizes, left before right.

    Attributes:
        hips: (2, 3) hip joints in the pelvis frame, metres.
        thigh_m, shin_m: leg bones.
        ankle_above_sole: (2, 3) from sole to ankle with the foot flat and pointing along x.
        arms_m: upper arm and forearm of each arm.
        shoulder_width_m: distance of the shoulders.
        sole_level: (2, 3, 3) rotation of the sole's frame with the foot flat and pointing along x.
        lowest_pelvis_m: lowest pelvis that the legs allow.
    """

    hips: Array
    thigh_m: float
    shin_m: float
    ankle_above_sole: Array
    arms_m: tuple[tuple[float, float], ...]
    shoulder_width_m: float
    sole_level: Array
    lowest_pelvis_m: float


@dataclass(frozen=True, slots=True)
class Targets:
    """What the robot should do, per frame.

    Attributes:
        pelvis: (T, 3) metres.
        pelvis_rotation: (T, 3, 3).
        soles: (T, 2, 3) metres, left and right.
        sole_rotation: (T, 2, 3, 3), flat.
        arms: (T, 2, 2, 3) shoulder to elbow and elbow to wrist, metres, left and right.
        shoulders: (T, 3) from the right to the left shoulder, metres.
        contact: (T, 2) planted feet.
        scale: robot metres per human metre.
    """

    pelvis: Array
    pelvis_rotation: Array
    soles: Array
    sole_rotation: Array
    arms: Array
    shoulders: Array
    contact: NDArray[np.bool_]
    scale: float


def make_targets(human: HumanMotion, robot: Measures) -> Targets:
    """What a robot should do to follow a clip."""
    joints = human.joints
    side = lambda name: joints[:, [index(f"left_{name}"), index(f"right_{name}")]]  # noqa: E731
    hips, knees, ankles, toes = side("hip"), side("knee"), side("ankle"), side("foot")
    shoulders, elbows, wrists = side("shoulder"), side("elbow"), side("wrist")
    leg = float(np.median(_length(hips - knees) + _length(knees - ankles)))
    scale = (robot.thigh_m + robot.shin_m) / leg
    contact = toe_contacts(joints, human.fps)
    # Pelvis orientation: up along the trunk, left along the hips.
    up = _unit(joints[:, index("neck")] - joints[:, 0])
    left = hips[:, 0] - hips[:, 1]
    left = _unit(left - up * np.sum(left * up, axis=1, keepdims=True))
    rotation = np.stack([np.cross(left, up), left, up], axis=-1)
    level_left = _unit(left * np.array([1.0, 1.0, 0.0]))
    # Soles: human mid-foot, moved out to the robot's hip width.
    human_half = 0.5 * float(np.median(_length(hips[:, 0] - hips[:, 1])))
    spread = max(0.0, 0.85 * float(robot.hips[0, 1]) - scale * human_half)
    soles, yaws = np.empty((len(joints), 2, 3)), np.empty((len(joints), 2))
    for foot, sign in ((0, 1.0), (1, -1.0)):
        floor = _floor_height(ankles[:, foot, 2], contact[:, foot])
        place = (0.55 * ankles[:, foot] + 0.45 * toes[:, foot]) * scale + sign * spread * level_left
        place[:, 2] = np.where(contact[:, foot], 0.0, np.maximum(ankles[:, foot, 2] - floor, 0.0) * scale)
        toward = toes[:, foot] - ankles[:, foot]
        yaw = np.unwrap(np.arctan2(toward[:, 1], toward[:, 0]))
        locked = lock(np.column_stack([place, yaw]), contact[:, foot])
        soles[:, foot], yaws[:, foot] = locked[:, :3], locked[:, 3]
    soles[..., 2] = np.maximum(soles[..., 2], 0.0)
    turn = _about_z(yaws)  # (T, 2, 3, 3)
    sole_rotation = np.stack([turn[:, foot] @ robot.sole_level[foot] for foot in (0, 1)], axis=1)
    ankle_targets = soles + np.stack([(turn[:, foot] @ robot.ankle_above_sole[foot]) for foot in (0, 1)], axis=1)
    # Pelvis place: hips scaled about the floor, then lowered until both legs reach.
    floor = min(_floor_height(ankles[:, foot, 2], contact[:, foot]) for foot in (0, 1))
    middle = 0.5 * (hips[:, 0] + hips[:, 1])
    hip_middle = middle * scale
    hip_middle[:, 2] = (middle[:, 2] - floor) * scale + float(robot.ankle_above_sole[0, 2])
    offsets = np.einsum("tij,fj->tfi", rotation, robot.hips)
    pelvis = hip_middle - offsets.mean(axis=1)
    pelvis[:, 2] = np.maximum(_reachable(pelvis, offsets, ankle_targets, robot), robot.lowest_pelvis_m)
    arms = np.empty((len(joints), 2, 2, 3))
    for arm in (0, 1):
        arms[:, arm, 0] = _unit(elbows[:, arm] - shoulders[:, arm]) * robot.arms_m[arm][0]
        arms[:, arm, 1] = _unit(wrists[:, arm] - elbows[:, arm]) * robot.arms_m[arm][1]
    across = _unit(shoulders[:, 0] - shoulders[:, 1]) * robot.shoulder_width_m
    return Targets(pelvis, rotation, soles, sole_rotation, arms, across, contact, scale)


def _reachable(pelvis: Array, hip_offsets: Array, ankles: Array, robot: Measures) -> Array:
    flat = _length((pelvis[:, None] + hip_offsets - ankles)[..., :2])
    leg = 0.985 * (robot.thigh_m + robot.shin_m)
    rise = np.sqrt(np.maximum(leg**2 - np.minimum(flat, 0.95 * leg) ** 2, 0.0))
    limit = np.minimum(pelvis[:, 2], np.min(ankles[..., 2] + rise - hip_offsets[..., 2], axis=1))
    if len(limit) < 5:
        return limit
    return np.minimum(gaussian_filter1d(minimum_filter1d(limit, 3), 1.0, mode="nearest"), limit)


def _length(vectors: Array) -> Array:
    lengths: Array = np.linalg.norm(vectors, axis=-1).astype(np.float64)
    return lengths


def _unit(vectors: Array) -> Array:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-9)


def _floor_height(ankle_z: Array, contact: NDArray[np.bool_]) -> float:
    return float(np.median(ankle_z[contact])) if contact.any() else float(np.min(ankle_z))


def _about_z(yaw_rad: Array) -> Array:
    cos, sin, zero, one = np.cos(yaw_rad), np.sin(yaw_rad), np.zeros_like(yaw_rad), np.ones_like(yaw_rad)
    rows = [np.stack(row, axis=-1) for row in ([cos, -sin, zero], [sin, cos, zero], [zero, zero, one])]
    return np.stack(rows, axis=-2)
