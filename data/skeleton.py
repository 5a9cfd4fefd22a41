"""The 22-joint human skeleton of SMPL and HumanML3D, and human motions in the robot's axes.

Human motions are kept with z up and x forward at the start (the robots' convention); HumanML3D's files have y up and z forward.
Shape letters: T frames; 22 joints.

Paper: motion data. Bone lengths are those of an average adult, used by the generator only.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

JOINTS: Final = (
    "pelvis",
    "left_hip",
    "right_hip",
    "spine1",
    "left_knee",
    "right_knee",
    "spine2",
    "left_ankle",
    "right_ankle",
    "spine3",
    "left_foot",
    "right_foot",
    "neck",
    "left_collar",
    "right_collar",
    "head",
    "left_shoulder",
    "right_shoulder",
    "left_elbow",
    "right_elbow",
    "left_wrist",
    "right_wrist",
)
#: Parent of each joint; -1 for the pelvis.
PARENTS: Final = (-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19)
#: Kinematic chains in HumanML3D's order.
CHAINS: Final = ((0, 2, 5, 8, 11), (0, 1, 4, 7, 10), (0, 3, 6, 9, 12, 15), (9, 14, 17, 19, 21), (9, 13, 16, 18, 20))


def index(name: str) -> int:
    """Index of a joint by name."""
    return JOINTS.index(name)


@dataclass(frozen=True, slots=True)
class Caption:
    """A sentence with the time span that it describes; 0 to 0 is the whole clip."""

    text: str
    start_s: float = 0.0
    end_s: float = 0.0


@dataclass(frozen=True, slots=True)
class HumanMotion:
    """A human clip.

    Attributes:
        name: clip id.
        joints: (T, 22, 3) metres, z up, floor at z = 0.
        fps: frames per second.
        captions: sentences.
        hand_opening: (T, 2) left and right, 0 closed to 1 open; None when the source does not tell.
        split: train, val or test.
    """

    name: str
    joints: Array
    fps: float
    captions: tuple[Caption, ...] = ()
    hand_opening: Array | None = None
    split: str = "train"

    def __post_init__(self) -> None:
        if self.joints.ndim != 3 or self.joints.shape[1:] != (len(JOINTS), 3):
            raise ValueError(f"{self.name}: joints have shape {self.joints.shape}; expected (T, {len(JOINTS)}, 3)")
        if self.hand_opening is not None and self.hand_opening.shape != (len(self.joints), 2):
            raise ValueError(f"{self.name}: hand_opening has shape {self.hand_opening.shape}; expected ({len(self.joints)}, 2)")

    @property
    def duration_s(self) -> float:
        """Length of the clip."""
        return (len(self.joints) - 1) / self.fps


def to_y_up(points: ArrayLike) -> Array:
    """From x forward, y left, z up to HumanML3D's x left, y up, z forward; (..., 3)."""
    return np.asarray(points, dtype=np.float64)[..., [1, 2, 0]]


def to_z_up(points: ArrayLike) -> Array:
    """Inverse of `to_y_up`."""
    return np.asarray(points, dtype=np.float64)[..., [2, 0, 1]]


def mirrored(joints: Array) -> Array:
    """Left and right exchanged, (T, 22, 3) with z up; its own inverse."""
    order = [index(_other_side(name)) for name in JOINTS]
    return joints[:, order] * np.array([1.0, -1.0, 1.0])


def _other_side(name: str) -> str:
    if name.startswith("left_"):
        return name.replace("left_", "right_", 1)
    return name.replace("right_", "left_", 1)
