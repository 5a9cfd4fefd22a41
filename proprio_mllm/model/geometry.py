"""Where the robot's body stands in its own image, and point maps from depth.

The paper's position embedding needs "the robot's centroid" in the image and leaves open what that is for a first-person view,
where the projected body usually lies below the frame. Three providers, all from the robot's own state, never from the scene:

- `body`: the mean of the key bodies, projected. Closest to the words; in most first-person frames it lies below the image, so
  that the vertical sign is constant.
- `arms`: the mean of elbows and hands, projected.
- `reach`: the point straight ahead of the pelvis at the height of the body's mean and one arm's length away, projected: what
  stands above, below, left and right of it is so for the arms too. The default: with both robots standing it lies at 0.64 and
  0.70 of the image's height (H1, X1), while `body` lies at 1.4 and 2.0, and `arms` at 1.1 and 2.1.

Frames: pelvis heading frame (x forward, y left, z up, metres); camera frame (x right, y down, z forward). Image x runs right
and y down, pixels. Shape letters: K key bodies, H and W image rows and columns.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from configs.schema.model import CentroidName
from interface.bodies import KEY_BODIES
from interface.observation import Camera

_INDEX = {name: i for i, name in enumerate(KEY_BODIES)}
_ARMS = [_INDEX[f"{side}_{part}"] for side in ("left", "right") for part in ("elbow", "hand")]
#: A point behind the camera is projected from this depth, metres: far outside the image on the side where it is.
NEAR_M = 0.05


def _check(key_bodies: NDArray[np.floating]) -> NDArray[np.float64]:
    bodies = np.asarray(key_bodies, dtype=np.float64)
    if bodies.shape != (len(KEY_BODIES), 3):
        raise ValueError(f"key bodies: expected shape {(len(KEY_BODIES), 3)}, got {bodies.shape}")
    return bodies


def arm_length_m(key_bodies: NDArray[np.floating]) -> float:
    """Mean length of the two arms, shoulder to elbow to hand, from (K, 3) key bodies."""
    bodies = _check(key_bodies)
    lengths = []
    for side in ("left", "right"):
        chain = bodies[[_INDEX[f"{side}_{part}"] for part in ("shoulder", "elbow", "hand")]]
        lengths.append(np.linalg.norm(np.diff(chain, axis=0), axis=1).sum())
    return float(np.mean(lengths))


def shoulders(key_bodies: NDArray[np.floating]) -> NDArray[np.float64]:
    """The left and the right shoulder (2, 3) of (K, 3) key bodies."""
    return _check(key_bodies)[[_INDEX["left_shoulder"], _INDEX["right_shoulder"]]]


def body_point_in_pelvis(key_bodies: NDArray[np.floating], provider: CentroidName) -> NDArray[np.float64]:
    """The body point (3,) that stands for the robot, metres, pelvis heading frame.

    Raises:
        ValueError: on an unknown provider or a wrong shape.
    """
    bodies = _check(key_bodies)
    if provider == "body":
        return bodies.mean(axis=0)
    if provider == "arms":
        return bodies[_ARMS].mean(axis=0)
    if provider == "reach":
        return np.array([arm_length_m(bodies), 0.0, bodies[:, 2].mean()])
    raise ValueError(f"centroid provider {provider!r} is not allowed; allowed: body, arms, reach")


def to_camera(camera: Camera, point_in_pelvis: NDArray[np.floating]) -> NDArray[np.float64]:
    """A point (3,) of the pelvis heading frame in the camera frame, metres."""
    pose = np.asarray(camera.camera_in_pelvis, dtype=np.float64)
    return pose[:3, :3].T @ (np.asarray(point_in_pelvis, dtype=np.float64) - pose[:3, 3])


def to_pelvis(camera: Camera, point_in_camera: NDArray[np.floating]) -> NDArray[np.float64]:
    """A point (3,) of the camera frame in the pelvis heading frame, metres."""
    pose = np.asarray(camera.camera_in_pelvis, dtype=np.float64)
    return pose[:3, :3] @ np.asarray(point_in_camera, dtype=np.float64) + pose[:3, 3]


def floor_m(key_bodies: NDArray[np.floating]) -> float:
    """Height in the pelvis heading frame of the floor, on which the lowest key body stands, metres."""
    return float(_check(key_bodies)[:, 2].min())


def project(camera: Camera, point_in_pelvis: NDArray[np.floating]) -> tuple[float, float]:
    """Pixel (x, y) of a point (3,) of the pelvis heading frame; points behind the camera fall far outside the image."""
    in_camera = to_camera(camera, point_in_pelvis)
    depth = max(float(in_camera[2]), NEAR_M)
    x, y, w = np.asarray(camera.intrinsics, dtype=np.float64) @ np.array([in_camera[0], in_camera[1], depth])
    return float(x / w), float(y / w)


def centroid(camera: Camera, key_bodies: NDArray[np.floating], provider: CentroidName) -> tuple[float, float]:
    """The robot's centroid in the image as fractions (x / W, y / H); outside [0, 1] when it is outside the image."""
    x, y = project(camera, body_point_in_pelvis(key_bodies, provider))
    return x / camera.width, y / camera.height


def stance(camera: Camera, key_bodies: NDArray[np.floating]) -> NDArray[np.float64]:
    """How a camera stands, (3, 4): where its rays go, and where it is above the floor.

    The first three columns turn homogeneous pixels (x, y, 1) into directions in the pelvis heading frame. The last is the
    camera's position in that frame, but for z its height above the floor, metres.
    """
    pose = np.asarray(camera.camera_in_pelvis, dtype=np.float64)
    rays = pose[:3, :3] @ np.linalg.inv(np.asarray(camera.intrinsics, dtype=np.float64))
    place = pose[:3, 3] - [0.0, 0.0, floor_m(key_bodies)]
    return np.concatenate([rays, place[:, None]], axis=1)


def unproject(depth_m: NDArray[np.floating], intrinsics: NDArray[np.floating]) -> NDArray[np.float32]:
    """Points (H, W, 3) in the camera frame from depth (H, W) along the camera's axis and K (3, 3), pixel centres at +0.5.

    Raises:
        ValueError: on wrong shapes.
    """
    depth = np.asarray(depth_m, dtype=np.float32)
    K = np.asarray(intrinsics, dtype=np.float32)
    if depth.ndim != 2 or K.shape != (3, 3):
        raise ValueError(f"expected depth (H, W) and intrinsics (3, 3), got {depth.shape} and {K.shape}")
    rows, cols = np.meshgrid(np.arange(depth.shape[0]) + 0.5, np.arange(depth.shape[1]) + 0.5, indexing="ij")
    x = (cols - K[0, 2]) / K[0, 0] * depth
    y = (rows - K[1, 2]) / K[1, 1] * depth
    return np.stack([x, y, depth], axis=-1).astype(np.float32)  # (H, W, 3)
