"""The robot's recent motion: frames at 20 Hz in a ring buffer, the raw material of motion features.

Paper: proprioception is a window of past motion. A frame is taken every 50 ms of simulated time, whatever the robot does.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from typing import Final

import mujoco
import numpy as np
from numpy.typing import NDArray

from interface.bodies import KEY_BODIES, SIDES
from robots.spec import RobotSpec

FRAME_DT_S: Final = 0.05
HISTORY_FRAMES: Final = 64


@dataclass(frozen=True, slots=True)
class MotionWindow:
    """T consecutive frames, oldest first.

    Attributes:
        root_pose: (T, 7) pelvis position (m) and quaternion (w, x, y, z), world frame.
        joints: (T, J) positions in the order of `RobotSpec.joints`, radians or metres.
        hands: (T, 2) opening of the left and right hand, 0 closed to 1 open.
        key_bodies: (T, 14, 3) positions of `KEY_BODIES`, world frame, metres.
    """

    root_pose: NDArray[np.float64]
    joints: NDArray[np.float64]
    hands: NDArray[np.float64]
    key_bodies: NDArray[np.float64]


@dataclass(slots=True)
class Recorder:
    """Samples one robot.

    Attributes:
        model: compiled scene.
        robot: the robot in it.
        frames: the last `HISTORY_FRAMES` frames; earlier ones go to `on_frame` listeners only.
    """

    model: mujoco.MjModel
    robot: RobotSpec
    frames: deque[tuple[NDArray[np.float64], ...]] = field(default_factory=lambda: deque(maxlen=HISTORY_FRAMES))
    _joint_adr: NDArray[np.int64] = field(init=False, repr=False)
    _hand_adr: list[NDArray[np.int64]] = field(init=False, repr=False)
    _bodies: list[tuple[bool, int]] = field(init=False, repr=False)
    _root: int = field(init=False, repr=False)

    def __post_init__(self) -> None:
        model, robot = self.model, self.robot
        self._joint_adr = np.array([int(model.joint(name).qposadr[0]) for name in robot.joints])
        self._hand_adr = [
            np.array([int(model.joint(name).qposadr[0]) for name in robot.arms[side].hand_joints]) for side in SIDES
        ]
        self._root = int(model.body(robot.root_body).id)
        self._bodies = []
        for name in KEY_BODIES:
            target = robot.key_bodies[name]
            site = mujoco.mj_name2id(model, int(mujoco.mjtObj.mjOBJ_SITE), target)
            self._bodies.append((True, site) if site >= 0 else (False, int(model.body(target).id)))

    def joints(self, data: mujoco.MjData) -> NDArray[np.float64]:
        """(J,) joint positions in the order of `RobotSpec.joints`."""
        return data.qpos[self._joint_adr].copy()

    def hands(self, data: mujoco.MjData) -> NDArray[np.float64]:
        """(2,) hand openings, mean over the joints that move between open and closed."""
        values = []
        for side, adr in zip(SIDES, self._hand_adr, strict=True):
            opened, closed = (np.asarray(getattr(self.robot.arms[side], name)) for name in ("hand_open", "hand_closed"))
            span = opened - closed
            used = np.abs(span) > 1e-6
            values.append(float(np.clip(np.mean((data.qpos[adr] - closed)[used] / span[used]), 0.0, 1.0)))
        return np.array(values)

    def key_bodies(self, data: mujoco.MjData) -> NDArray[np.float64]:
        """(14, 3) positions of `KEY_BODIES`, world frame, metres."""
        return np.array([data.site_xpos[index] if is_site else data.xpos[index] for is_site, index in self._bodies])

    def root_pose(self, data: mujoco.MjData) -> NDArray[np.float64]:
        """(7,) pelvis position and quaternion (w, x, y, z), world frame."""
        return np.concatenate([data.xpos[self._root], data.xquat[self._root]])

    def record(self, data: mujoco.MjData) -> None:
        """Appends the current frame."""
        self.frames.append((self.root_pose(data), self.joints(data), self.hands(data), self.key_bodies(data)))

    def fill(self, data: mujoco.MjData) -> None:
        """Makes the whole window the current frame: a robot that stood still before the episode."""
        self.record(data)
        frame = self.frames[-1]
        self.frames.extend([frame] * HISTORY_FRAMES)

    def window(self, frames: int = HISTORY_FRAMES) -> MotionWindow:
        """The last `frames` frames.

        Raises:
            ValueError: when `frames` is outside 1..HISTORY_FRAMES.
        """
        if not 1 <= frames <= HISTORY_FRAMES:
            raise ValueError(f"frames {frames} outside 1..{HISTORY_FRAMES}")
        last = list(self.frames)[-frames:]
        return MotionWindow(*(np.stack([frame[i] for frame in last]) for i in range(4)))
