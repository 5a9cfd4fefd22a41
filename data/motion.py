"""Motion features shared by every robot: what the tokenizer reads and what proprioception holds.

A frame has 48 numbers: the positions of 14 key bodies in the pelvis heading frame, pelvis height, planar velocity, yaw rate and
the opening of both hands. H1, X1 and a human have the same key bodies, so one tokenizer serves all of them.

Frames: `pelvis heading frame` has its origin at the pelvis, x forward and z up, rotated with the pelvis' yaw only.
Rates are backward differences: the displacement from frame t-1 to t, in the heading frame of t-1. They are causal, so that a
window of a recording has the features of the recording (its first frame aside, which repeats the second frame's rates).
Shape letters: T frames, K key bodies, F features.

Paper: motion tokenizer, input representation. The paper takes HumanML3D-style features of one humanoid; what is left out here
is rotations and foot contacts, because the two robots differ in their joints and the key bodies already determine both.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from interface.bodies import KEY_BODIES

#: Frames per second of every stored motion.
FPS: Final = 20.0
KEY_BODY_COUNT: Final = len(KEY_BODIES)
#: Name of each feature, in order; unit after the last underscore.
FEATURES: Final[tuple[str, ...]] = (
    *(f"{body}_{axis}_m" for body in KEY_BODIES for axis in "xyz"),
    "pelvis_height_m",
    "velocity_x_mps",
    "velocity_y_mps",
    "yaw_rate_radps",
    "left_hand_opening",
    "right_hand_opening",
)
N_FEATURES: Final = len(FEATURES)
_KEYS: Final = slice(0, 3 * KEY_BODY_COUNT)
PELVIS_HEIGHT: Final = 3 * KEY_BODY_COUNT
PLANAR_VELOCITY: Final = slice(PELVIS_HEIGHT + 1, PELVIS_HEIGHT + 3)
YAW_RATE: Final = PELVIS_HEIGHT + 3
HAND_OPENING: Final = slice(PELVIS_HEIGHT + 4, PELVIS_HEIGHT + 6)
#: Opening from which on a hand counts as open; what it holds keeps it below.
OPEN_HAND: Final = 0.97


def wrap_angle(angle_rad: ArrayLike) -> NDArray[np.float64]:
    """Wraps angles (rad) to [-pi, pi)."""
    return (np.asarray(angle_rad, dtype=np.float64) + np.pi) % (2.0 * np.pi) - np.pi


def yaw_from_quaternion(quaternion_wxyz: ArrayLike) -> NDArray[np.float64]:
    """Yaw (rad) of the body's x axis projected on the floor.

    Args:
        quaternion_wxyz: (..., 4) unit quaternions.

    Returns:
        (...,) rad.
    """
    w, x, y, z = np.moveaxis(np.asarray(quaternion_wxyz, dtype=np.float64), -1, 0)
    return np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))


def world_to_heading(points_world: ArrayLike, root_pose: ArrayLike) -> NDArray[np.float64]:
    """Points of the world in the pelvis heading frame.

    Args:
        points_world: (..., N, 3) metres.
        root_pose: (..., 7) pelvis position (m) and quaternion (w, x, y, z) in the world.

    Returns:
        (..., N, 3) metres.
    """
    points, pose = np.asarray(points_world, dtype=np.float64), np.asarray(root_pose, dtype=np.float64)
    return _rotate(points - pose[..., None, :3], -yaw_from_quaternion(pose[..., 3:7])[..., None])


def heading_to_world(points_in_heading: ArrayLike, root_pose: ArrayLike) -> NDArray[np.float64]:
    """Inverse of `world_to_heading`, same shapes."""
    points, pose = np.asarray(points_in_heading, dtype=np.float64), np.asarray(root_pose, dtype=np.float64)
    return _rotate(points, yaw_from_quaternion(pose[..., 3:7])[..., None]) + pose[..., None, :3]


def _rotate(vectors: NDArray[np.float64], yaw_rad: NDArray[np.float64]) -> NDArray[np.float64]:
    cos, sin = np.cos(yaw_rad), np.sin(yaw_rad)
    x, y = vectors[..., 0], vectors[..., 1]
    return np.stack([cos * x - sin * y, sin * x + cos * y, vectors[..., 2]], axis=-1)


def encode_frames(
    root_pose: ArrayLike, key_bodies_world: ArrayLike, hand_opening: ArrayLike, fps: float = FPS
) -> NDArray[np.float32]:
    """Features of a motion.

    Args:
        root_pose: (T, 7) pelvis position (m) and unit quaternion (w, x, y, z) in the world.
        key_bodies_world: (T, K, 3) metres, in the order of `interface.bodies.KEY_BODIES`.
        hand_opening: (T, 2) left and right, 0 closed to 1 open.
        fps: frames per second.

    Returns:
        (T, F) in the order of `FEATURES`.

    Raises:
        ValueError: on shapes that do not agree, no frame, fps that is not positive, or values that are not finite.
    """
    pose = np.asarray(root_pose, dtype=np.float64)
    keys = np.asarray(key_bodies_world, dtype=np.float64)
    opening = np.asarray(hand_opening, dtype=np.float64)
    frames = len(pose)
    if not fps > 0.0:
        raise ValueError(f"fps {fps} must be positive")
    for name, array, shape in (
        ("root_pose", pose, (frames, 7)),
        ("key_bodies_world", keys, (frames, KEY_BODY_COUNT, 3)),
        ("hand_opening", opening, (frames, 2)),
    ):
        if array.shape != shape or frames == 0:
            raise ValueError(f"{name} has shape {array.shape}; expected {shape} with at least one frame")
        if not np.isfinite(array).all():
            raise ValueError(f"{name} has values that are not finite")
    yaw = yaw_from_quaternion(pose[:, 3:7])
    rates = np.zeros((frames, 3))
    if frames > 1:
        steps = np.diff(pose[:, :3], axis=0)  # (T-1, 3)
        rates[1:, :2] = _rotate(steps, -yaw[:-1])[:, :2] * fps
        rates[1:, 2] = wrap_angle(np.diff(yaw)) * fps
        rates[0] = rates[1]
    features = np.empty((frames, N_FEATURES), dtype=np.float32)
    features[:, _KEYS] = world_to_heading(keys, pose).reshape(frames, -1)
    features[:, PELVIS_HEIGHT] = pose[:, 2]
    features[:, PLANAR_VELOCITY] = rates[:, :2]
    features[:, YAW_RATE] = rates[:, 2]
    features[:, HAND_OPENING] = opening
    return features


def decode_key_bodies(features: ArrayLike) -> NDArray[np.float32]:
    """Key bodies in the pelvis heading frame.

    Args:
        features: (..., F).

    Returns:
        (..., K, 3) metres.

    Raises:
        ValueError: when the last axis is not F long.
    """
    array = _checked(features)
    return array[..., _KEYS].reshape(*array.shape[:-1], KEY_BODY_COUNT, 3)


def decode_root(features: ArrayLike, fps: float = FPS) -> NDArray[np.float64]:
    """Pelvis path that starts at x = y = yaw = 0, by summing the rates; the pelvis stays upright.

    Args:
        features: (T, F).
        fps: frames per second.

    Returns:
        (T, 7) pelvis position (m) and quaternion (w, x, y, z).
    """
    array = _checked(features).astype(np.float64)
    yaw = np.concatenate([[0.0], np.cumsum(array[1:, YAW_RATE]) / fps])
    local = np.pad(array[1:, PLANAR_VELOCITY] / fps, ((0, 0), (0, 1)))  # (T-1, 3)
    path = np.concatenate([np.zeros((1, 3)), np.cumsum(_rotate(local, yaw[:-1]), axis=0)])
    path[:, 2] = array[:, PELVIS_HEIGHT]
    zero = np.zeros_like(yaw)
    return np.concatenate([path, np.stack([np.cos(yaw / 2), zero, zero, np.sin(yaw / 2)], axis=1)], axis=1)


def _checked(features: ArrayLike) -> NDArray[np.float32]:
    array = np.asarray(features, dtype=np.float32)
    if array.ndim < 1 or array.shape[-1] != N_FEATURES:
        raise ValueError(f"features have shape {array.shape}; the last axis must be {N_FEATURES}")
    return array


def resample(values: ArrayLike, fps_from: float, fps_to: float = FPS) -> NDArray[np.float64]:
    """Linear resampling in time of positions or angles that do not wrap.

    Args:
        values: (T, ...).
        fps_from: frames per second of `values`.
        fps_to: wanted frames per second.

    Returns:
        (T', ...), covering the same duration.

    Raises:
        ValueError: on rates that are not positive.
    """
    if not (fps_from > 0.0 and fps_to > 0.0):
        raise ValueError(f"frames per second {fps_from} and {fps_to} must be positive")
    array = np.asarray(values, dtype=np.float64)
    count = int(np.floor((len(array) - 1) / fps_from * fps_to + 1e-9)) + 1
    position = np.arange(count) * fps_from / fps_to
    low = np.minimum(position.astype(int), len(array) - 1)
    high = np.minimum(low + 1, len(array) - 1)
    weight = (position - low).reshape(-1, *([1] * (array.ndim - 1)))
    return array[low] * (1.0 - weight) + array[high] * weight
