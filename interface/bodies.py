"""Parts of the body that all robots share: the two arms, and the key bodies whose positions make up a motion frame."""

from __future__ import annotations

from enum import StrEnum
from typing import Final

#: The robots of the paper, and the one that is taken where nobody says which.
PAPER_ROBOTS: Final = ("h1", "x1")
DEFAULT_ROBOT: Final = PAPER_ROBOTS[0]

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


class Arm(StrEnum):
    """One of the robot's two arms."""

    LEFT = "left"
    RIGHT = "right"

    @property
    def other(self) -> Arm:
        """The opposite arm."""
        return Arm.RIGHT if self is Arm.LEFT else Arm.LEFT
