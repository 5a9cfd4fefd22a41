"""Poses a human skeleton from a few channels: pelvis, trunk, feet on the ground, hands around the body.

Legs and arms are two-bone chains solved in closed form; the pelvis is lowered until both legs reach their feet, so that a
planted foot stays where it is. Everything is vectorised over frames.
Shape letters: T frames. Axes: x forward, y left, z up.

Paper: none; it feeds the generator of motions that stands in where HumanML3D is not at hand.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d, minimum_filter1d
from scipy.spatial.transform import Rotation

from data.skeleton import JOINTS, index

Array = NDArray[np.float64]

THIGH_M: Final = 0.386
SHIN_M: Final = 0.402
UPPER_ARM_M: Final = 0.262
FOREARM_M: Final = 0.250
ANKLE_HEIGHT_M: Final = 0.075
STANDING_HEIGHT_M: Final = 0.925
FOOT_SPREAD_M: Final = 0.095
ARM_LENGTH_M: Final = UPPER_ARM_M + FOREARM_M
SHOULDER_HEIGHT_M: Final = STANDING_HEIGHT_M + 0.475
_HIP: Final = np.array([-0.01, 0.075, -0.085])
_SPINE: Final = {"spine1": 0.105, "spine2": 0.135, "spine3": 0.055, "neck": 0.215, "head": 0.10}
_COLLAR: Final = np.array([-0.01, 0.075, 0.12])
_SHOULDER: Final = np.array([-0.015, 0.105, 0.06])
_TOE: Final = np.array([0.125, 0.01, -0.055])


@dataclass(frozen=True, slots=True)
class Channels:
    """What a pose follows from.

    Attributes:
        base: (T, 3) x, y (m) and yaw (rad) of the body over the floor.
        pelvis_height_m: (T,) wanted pelvis height; lowered where the legs are too short.
        lean_rad: (T,) forward lean of the trunk.
        side_rad: (T,) lean of the trunk to the right.
        twist_rad: (T,) turn of the chest to the left of the base's heading.
        hip_rad: (T,) turn of the pelvis to the left of it.
        sway_m: (T, 2) shift of the pelvis ahead and to the left of the base.
        feet: (T, 2, 4) left and right ankle x, y, z (m) and foot yaw (rad) in the world.
        hands: (T, 2, 3) left and right wrist in the base frame (x forward, y left, z above the floor).
        swivel_rad: (T, 2) how far each elbow is raised outwards about the line from shoulder to wrist.
    """

    base: Array
    pelvis_height_m: Array
    lean_rad: Array
    side_rad: Array
    twist_rad: Array
    hip_rad: Array
    sway_m: Array
    feet: Array
    hands: Array
    swivel_rad: Array


def two_bone(root: Array, target: Array, upper_m: float, lower_m: float, pole: Array) -> tuple[Array, Array]:
    """Middle and end of a two-bone chain.

    Args:
        root: (T, 3) start.
        target: (T, 3) wanted end; pulled into reach along the straight line.
        upper_m: length of the first bone.
        lower_m: length of the second bone.
        pole: (T, 3) direction to which the middle joint bends.

    Returns:
        (T, 3) middle and (T, 3) end.
    """
    to_target = target - root
    distance = np.maximum(np.linalg.norm(to_target, axis=1, keepdims=True), 1e-9)
    along = to_target / distance
    reach = np.clip(distance, abs(upper_m - lower_m) + 0.02, 0.995 * (upper_m + lower_m))
    side = pole - np.sum(pole * along, axis=1, keepdims=True) * along
    side /= np.maximum(np.linalg.norm(side, axis=1, keepdims=True), 1e-9)
    projection = (upper_m**2 - lower_m**2 + reach**2) / (2.0 * reach)
    offset = np.sqrt(np.maximum(upper_m**2 - projection**2, 0.0))
    return root + along * projection + side * offset, root + along * reach


def pose(channels: Channels) -> Array:
    """Joint positions (T, 22, 3) in metres, world frame, floor at z = 0."""
    frames = len(channels.base)
    joints = np.zeros((frames, len(JOINTS), 3))
    yaw, lean, side_lean = channels.base[:, 2], channels.lean_rad, channels.side_rad
    # The pelvis takes a third of the lean, the spine the rest.
    pelvis_rotation = _rotation(yaw + channels.hip_rad, 0.35 * lean, 0.2 * side_lean)
    spine_rotation = _rotation(yaw + channels.twist_rad, lean, side_lean)
    # The hips shift back when the trunk leans forward, as balance needs.
    ahead = channels.sway_m[:, 0] - 0.16 * np.sin(lean)
    left = channels.sway_m[:, 1] + 0.08 * np.sin(side_lean)
    cos, sin = np.cos(yaw), np.sin(yaw)
    pelvis = np.column_stack(
        [
            channels.base[:, 0] + cos * ahead - sin * left,
            channels.base[:, 1] + sin * ahead + cos * left,
            channels.pelvis_height_m,
        ]
    )
    pelvis[:, 2] = _reachable_height(pelvis, pelvis_rotation, channels.feet)
    joints[:, 0] = pelvis
    forward, outwards = spine_rotation[:, :, 0], spine_rotation[:, :, 1]
    above = pelvis
    for name, length in _SPINE.items():
        rotation = pelvis_rotation if name == "spine1" else spine_rotation
        above = above + rotation[:, :, 2] * length
        joints[:, index(name)] = above
    chest = joints[:, index("spine3")]
    for side, sign in (("left", 1.0), ("right", -1.0)):
        flip = np.array([1.0, sign, 1.0])
        foot = channels.feet[:, 0 if side == "left" else 1]
        hip = pelvis + pelvis_rotation @ (_HIP * flip)
        foot_rotation = _rotation(foot[:, 3], np.zeros(frames), np.zeros(frames))
        knee, ankle = two_bone(hip, foot[:, :3], THIGH_M, SHIN_M, foot_rotation[:, :, 0])
        joints[:, index(f"{side}_hip")] = hip
        joints[:, index(f"{side}_knee")] = knee
        joints[:, index(f"{side}_ankle")] = ankle
        joints[:, index(f"{side}_foot")] = ankle + foot_rotation @ (_TOE * flip)
        collar = chest + spine_rotation @ (_COLLAR * flip)
        shoulder = collar + spine_rotation @ (_SHOULDER * flip)
        hand = channels.hands[:, 0 if side == "left" else 1]
        wrist = _rotation(yaw, np.zeros(frames), np.zeros(frames)) @ hand[:, :, None]
        wrist = wrist[:, :, 0] + np.column_stack([channels.base[:, :2], np.zeros(frames)])
        swivel = channels.swivel_rad[:, 0 if side == "left" else 1][:, None]
        down = np.array([0.0, 0.0, 0.8])
        pole = -0.5 * forward - np.cos(swivel) * down + (0.35 + 0.8 * np.sin(swivel)) * sign * outwards
        elbow, wrist = two_bone(shoulder, wrist, UPPER_ARM_M, FOREARM_M, pole)
        joints[:, index(f"{side}_collar")] = collar
        joints[:, index(f"{side}_shoulder")] = shoulder
        joints[:, index(f"{side}_elbow")] = elbow
        joints[:, index(f"{side}_wrist")] = wrist
    return joints


def _reachable_height(pelvis: Array, rotation: Array, feet: Array) -> Array:
    limit = pelvis[:, 2].copy()
    for side, sign in ((0, 1.0), (1, -1.0)):
        hip_offset = rotation @ (_HIP * np.array([1.0, sign, 1.0]))
        flat = np.linalg.norm(pelvis[:, :2] + hip_offset[:, :2] - feet[:, side, :2], axis=1)
        leg = 0.985 * (THIGH_M + SHIN_M)
        rise = np.sqrt(np.maximum(leg**2 - np.minimum(flat, 0.95 * leg) ** 2, 0.0))
        limit = np.minimum(limit, feet[:, side, 2] + rise - hip_offset[:, 2])
    if len(limit) < 5:
        return limit
    # A smoothed lower envelope: low enough at every frame (to within the leg's slack), without kinks.
    return np.minimum(gaussian_filter1d(minimum_filter1d(limit, 5), 1.5, mode="nearest"), limit + 0.004)


def _rotation(yaw_rad: Array, pitch_rad: Array, roll_rad: Array) -> Array:
    """(T, 3, 3) rotations: roll about x, then pitch about y, then yaw about z."""
    return Rotation.from_euler("ZYX", np.column_stack([yaw_rad, pitch_rad, roll_rad])).as_matrix()
