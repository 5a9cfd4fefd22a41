"""Key bodies: the points of a body whose positions make up a motion frame, shared by all robots and by people."""

from __future__ import annotations

from typing import Final

__all__ = ["KEY_BODIES", "SIDES"]

#: Sides of the body, in the order of every array that has one entry per arm or leg.
SIDES: Final = ("left", "right")
#: Order of the key bodies in every (K, 3) array; `data` matches them to SMPL's joints.
KEY_BODIES: Final = (
    "torso",
    "head",
    "left_shoulder",
    "left_elbow",
    "left_hand",
    "right_shoulder",
    "right_elbow",
    "right_hand",
    "left_hip",
    "left_knee",
    "left_ankle",
    "right_hip",
    "right_knee",
    "right_ankle",
)
