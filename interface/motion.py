"""Motion clips of robots and people.

Shape letters: T frames, F motion features, J robot joints.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True)
class Motion:
    """A robot or human motion clip.

    Attributes:
        name: clip id.
        robot: robot name, or `human`.
        fps: frames per second.
        features: (T, F) float32, `data.motion.FEATURES`.
        captions: sentences that describe the whole clip.
        root_pose: (T, 7) pelvis position (m) and quaternion (w, x, y, z) in the world, or None.
        joint_positions: (T, J) radians in the robot's joint order, or None.
    """

    name: str
    robot: str
    fps: float
    features: NDArray[np.float32]
    captions: tuple[str, ...] = ()
    root_pose: NDArray[np.float64] | None = None
    joint_positions: NDArray[np.float64] | None = None
