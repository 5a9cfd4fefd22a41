"""What a planner may be told of a robot's body: constants of its description, nothing of the world.

Paper: baselines, "robot type" of the prompts. The numbers come from the robot's own description and its kinematics at rest.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from interface.bodies import KEY_BODIES, SIDES
from robots.kinematics import RobotModel
from robots.spec import RobotSpec, load_robot


@dataclass(frozen=True, slots=True)
class RobotFacts:
    """A robot's body in numbers.

    Attributes:
        name: robot name.
        hand: what an arm ends in, in words.
        arm_joints: joints of each arm.
        arm_length_m: from shoulder to the point between the fingers, outstretched.
        shoulder_above_pelvis_m: height of the shoulders over the pelvis.
        pelvis_height_m: lowest and highest pelvis.
        arm_load_kg, two_arm_load_kg: heaviest object for one arm and for both.
    """

    name: str
    hand: str
    arm_joints: int
    arm_length_m: float
    shoulder_above_pelvis_m: float
    pelvis_height_m: tuple[float, float]
    arm_load_kg: float
    two_arm_load_kg: float

    @property
    def reach_height_m(self) -> tuple[float, float]:
        """Lowest and highest hand above the floor, over the pelvis heights."""
        low, high = (height + self.shoulder_above_pelvis_m for height in self.pelvis_height_m)
        return max(0.0, low - self.arm_length_m), high + self.arm_length_m


@functools.cache
def robot_facts(name: str) -> RobotFacts:
    """The facts of a robot by name, or by the path of its description.

    Raises:
        ValueError: on an unknown robot.
    """
    return _facts(load_robot(name))


def _facts(spec: RobotSpec) -> RobotFacts:
    model = RobotModel(spec)
    root = np.array([0.0, 0.0, spec.standing_pelvis_height_m, 1.0, 0.0, 0.0, 0.0])
    keys: dict[str, NDArray[np.float64]] = dict(zip(KEY_BODIES, model.key_body_positions(root, model.posture()), strict=True))
    lengths, heights = [], []
    for side in SIDES:
        shoulder, elbow, hand = (keys[f"{side}_{part}"] for part in ("shoulder", "elbow", "hand"))
        lengths.append(np.linalg.norm(elbow - shoulder) + np.linalg.norm(hand - elbow))
        heights.append(shoulder[2] - spec.standing_pelvis_height_m)
    arm = spec.arms["left"]
    return RobotFacts(
        spec.name,
        "two-finger gripper" if len(arm.hand_joints) == 2 else "five-finger hand",
        len(arm.joints),
        round(float(np.mean(lengths)), 2),
        round(float(np.mean(heights)), 2),
        spec.pelvis_height_range_m,
        arm.max_load_kg,
        spec.two_arm_max_load_kg,
    )
