"""What a planner sees: the camera's view, names, its own body and the log.

Frames: the `pelvis heading frame` has its origin at the pelvis, x forward and z up, rotated with the pelvis' yaw only.
Shape letters: T frames, F motion features, J robot joints, K key bodies, H and W image rows and columns.

Paper: section on problem formulation (observation, proprioception); its exact content is fixed here.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from interface.episode import STEP_LIMIT


@dataclass(frozen=True, slots=True)
class Camera:
    """A pinhole camera.

    Attributes:
        intrinsics: (3, 3) matrix K in pixels.
        camera_in_pelvis: (4, 4) pose of the camera (x right, y down, z forward) in the pelvis heading frame.
        height: rows H.
        width: columns W.
    """

    intrinsics: NDArray[np.float64]
    camera_in_pelvis: NDArray[np.float64]
    height: int
    width: int


@dataclass(frozen=True, slots=True)
class Proprioception:
    """What the robot knows of its own body.

    Attributes:
        motion: (T, F) features of the last T frames at `fps`, newest last (`data.motion.FEATURES`).
        fps: frames per second of `motion`.
        joint_positions: (J,) radians, in the robot's joint order.
        key_bodies_in_pelvis: (K, 3) metres, current positions of the key bodies in the pelvis heading frame.
    """

    motion: NDArray[np.float32]
    fps: float
    joint_positions: NDArray[np.float64]
    key_bodies_in_pelvis: NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class HistoryItem:
    """One earlier step of the episode: its text and the feedback text."""

    step: str
    feedback: str


@dataclass(frozen=True, slots=True)
class Observation:
    """All that a planner sees. It never holds positions or states of objects.

    Attributes:
        instruction: the task in natural language.
        robot: robot name.
        image: (H, W, 3) uint8 head-camera view.
        camera: the head camera; its pose follows from the robot's own joints.
        visible_objects: ids of objects in the current view.
        known_objects: ids seen so far in the episode, and the room's furniture.
        proprioception: the robot's own state.
        history: earlier steps with their feedback, oldest first.
        step: index of the coming step.
        time_limit: steps within which the task is done in time.
        step_limit: steps after which the episode ends.
    """

    instruction: str
    robot: str
    image: NDArray[np.uint8]
    camera: Camera
    visible_objects: tuple[str, ...]
    known_objects: tuple[str, ...]
    proprioception: Proprioception
    history: tuple[HistoryItem, ...]
    step: int
    time_limit: int
    step_limit: int = STEP_LIMIT
