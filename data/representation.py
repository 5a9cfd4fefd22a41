"""HumanML3D's 263-number motion representation, and back to joint positions.

Per frame: root yaw rate (1), root velocity on the floor (2), root height (1), joint positions relative to the root (63), joint
rotations as 6 numbers (126), joint velocities (66), foot contacts (4). A clip of T frames has T - 1 rows. Axes: x left, y up,
z forward.

Source: HumanML3D (Guo et al., CVPR 2022), `motion_representation.ipynb`. One peculiarity of the published code is kept
because the
published vectors have it: its root direction adds the hips' vector with the sign opposite to the shoulders' one.
Shape letters: T frames.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from data.skeleton import CHAINS, JOINTS

Array = NDArray[np.float64]
VECTOR_SIZE: Final = 263
_CONTACT_SPEED: Final = 0.002  # squared metres per frame
#: Direction of each bone in the rest pose, by HumanML3D's convention.
_OFFSETS: Final = np.array(
    [
        *([0, 0, 0], [1, 0, 0], [-1, 0, 0], [0, 1, 0]),
        *([0, -1, 0], [0, -1, 0], [0, 1, 0], [0, -1, 0], [0, -1, 0], [0, 1, 0]),
        *([0, 0, 1], [0, 0, 1], [0, 1, 0], [1, 0, 0], [-1, 0, 0], [0, 0, 1]),
        *([[0, -1, 0]] * 6),
    ],
    dtype=np.float64,
)


def vectors_from_joints(joints: Array) -> Array:
    """The representation of a clip; the clip is put on the floor, at the origin, facing z.

    Args:
        joints: (T, 22, 3) metres, y up.

    Returns:
        (T - 1, 263).
    """
    positions = joints - np.array([0.0, joints[..., 1].min(), 0.0])
    positions = positions - positions[0, 0] * np.array([1.0, 0.0, 1.0])
    across = positions[0, 2] - positions[0, 1] + positions[0, 17] - positions[0, 16]
    forward = np.cross([0.0, 1.0, 0.0], across)
    positions = _rotate(_between(forward, np.array([0.0, 0.0, 1.0])), positions)
    rotations = _inverse_kinematics(positions)  # (T, 22, 4)
    root = rotations[:, 0]
    velocity = _rotate(root[1:], positions[1:, 0] - positions[:-1, 0])
    spin = np.arcsin(np.clip(_multiply(root[1:], _inverse(root[:-1]))[:, 2:3], -1.0, 1.0))
    local = positions - positions[:, :1] * np.array([1.0, 0.0, 1.0])
    local = _rotate(root[:, None], local)
    joint_velocity = _rotate(root[:-1, None], np.diff(positions, axis=0))
    still = np.sum(np.diff(positions, axis=0) ** 2, axis=-1) < _CONTACT_SPEED
    frames = len(joints) - 1
    return np.concatenate(
        [
            spin,
            velocity[:, [0, 2]],
            local[:-1, 0, 1:2],
            local[:-1, 1:].reshape(frames, -1),
            _six_numbers(rotations[:-1, 1:]).reshape(frames, -1),
            joint_velocity.reshape(frames, -1),
            still[:, [7, 10]],
            still[:, [8, 11]],
        ],
        axis=1,
    )


def joints_from_vectors(vectors: Array) -> Array:
    """Joint positions (T, 22, 3), y up, of a clip (T, 263) in the representation.

    Raises:
        ValueError: when rows do not have 263 numbers.
    """
    if vectors.ndim != 2 or vectors.shape[1] != VECTOR_SIZE:
        raise ValueError(f"vectors have shape {vectors.shape}; expected (T, {VECTOR_SIZE})")
    frames = len(vectors)
    half_yaw = np.concatenate([[0.0], np.cumsum(vectors[:-1, 0])])
    zero = np.zeros(frames)
    root = np.stack([np.cos(half_yaw), zero, np.sin(half_yaw), zero], axis=1)
    step = np.zeros((frames, 3))
    step[1:, [0, 2]] = vectors[:-1, 1:3]
    path = np.cumsum(_rotate(_inverse(root), step), axis=0)
    path[:, 1] = vectors[:, 3]
    local = vectors[:, 4 : 4 + 63].reshape(frames, 21, 3)
    others = _rotate(_inverse(root)[:, None], local) + path[:, None] * np.array([1.0, 0.0, 1.0])
    return np.concatenate([path[:, None], others], axis=1)


def _inverse_kinematics(positions: Array) -> Array:
    across = positions[:, 1] - positions[:, 2] + positions[:, 17] - positions[:, 16]
    forward = np.cross([0.0, 1.0, 0.0], across / np.linalg.norm(across, axis=1, keepdims=True))
    forward = gaussian_filter1d(forward, 20, axis=0, mode="nearest")
    root = _between(forward / np.linalg.norm(forward, axis=1, keepdims=True), np.array([0.0, 0.0, 1.0]))
    rotations = np.zeros((len(positions), len(JOINTS), 4))
    rotations[:, 0] = root
    for chain in CHAINS:
        so_far = root
        for parent, child in pairwise(chain):
            bone = positions[:, child] - positions[:, parent]
            bone /= np.maximum(np.linalg.norm(bone, axis=1, keepdims=True), 1e-9)
            local = _multiply(_inverse(so_far), _between(_OFFSETS[child], bone))
            rotations[:, child] = local
            so_far = _multiply(so_far, local)
    return rotations


def _between(a: Array, b: Array) -> Array:
    a, b = np.broadcast_arrays(a, b)
    w = np.sqrt(np.sum(a * a, axis=-1) * np.sum(b * b, axis=-1)) + np.sum(a * b, axis=-1)
    quaternion = np.concatenate([w[..., None], np.cross(a, b)], axis=-1)
    norm = np.linalg.norm(quaternion, axis=-1, keepdims=True)
    flipped = np.zeros_like(quaternion)
    flipped[..., 1] = 1.0  # opposite directions: half a turn about any axis
    return np.where(norm < 1e-9, flipped, quaternion / np.maximum(norm, 1e-9))


def _multiply(a: Array, b: Array) -> Array:
    w1, x1, y1, z1 = np.moveaxis(a, -1, 0)
    w2, x2, y2, z2 = np.moveaxis(b, -1, 0)
    return np.stack(
        [
            w1 * w2 - x1 * x2 - y1 * y2 - z1 * z2,
            w1 * x2 + x1 * w2 + y1 * z2 - z1 * y2,
            w1 * y2 - x1 * z2 + y1 * w2 + z1 * x2,
            w1 * z2 + x1 * y2 - y1 * x2 + z1 * w2,
        ],
        axis=-1,
    )


def _inverse(quaternion: Array) -> Array:
    return quaternion * np.array([1.0, -1.0, -1.0, -1.0])


def _rotate(quaternion: Array, vectors: Array) -> Array:
    axis = quaternion[..., 1:]
    twice = 2.0 * np.cross(axis, vectors)
    return vectors + quaternion[..., :1] * twice + np.cross(axis, twice)


def _six_numbers(quaternion: Array) -> Array:
    columns = [_rotate(quaternion, np.array(axis)) for axis in ([1.0, 0.0, 0.0], [0.0, 1.0, 0.0])]
    return np.concatenate(columns, axis=-1)
