"""Joint angles of a robot from motion features: the way back from key bodies, for clips that come out of the motion tokenizer.

Every frame is solved from the one before it: configurations whose key bodies are where the features have them, in the pelvis
heading frame, with the pelvis free to lean. What the key bodies do not show (the roll of a wrist) stays at rest.

Shape letters: T frames, F features, K key bodies, J joints. Paper: none; it shows what tokens keep of a robot's posture.
"""

from __future__ import annotations

from typing import Final

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from data.least_squares import BoundedSearch
from data.motion import HAND_OPENING, PELVIS_HEIGHT, decode_key_bodies, decode_root
from interface.bodies import KEY_BODIES, SIDES
from robots.kinematics import RobotModel
from robots.leg_ik import crouch
from robots.spec import RobotSpec

Array = NDArray[np.float64]
_FIRST_ITERATIONS: Final = 60
_ITERATIONS: Final = 6
_DAMPING: Final = 1e-4
_PRIOR: Final = 3e-3
#: Least change of a key body (m/rad) that makes a joint one that key bodies show.
_SEEN_M: Final = 0.02


class JointAngles:
    """Solves for one robot.

    Args:
        spec: the robot.

    Attributes:
        shown: (J,) joints that some key body's place depends on.
    """

    def __init__(self, spec: RobotSpec) -> None:
        self.robot = RobotModel(spec)
        robot, model = self.robot, self.robot.model
        self._frames = [robot.frame_id(spec.key_bodies[name]) for name in KEY_BODIES]
        names = [*spec.leg_joints, *spec.waist_joints, *(joint for arm in spec.arms.values() for joint in arm.joints)]
        ids = [model.getJointId(name) for name in names]
        self._q = np.array([model.joints[i].idx_q for i in ids])
        self._v = np.concatenate([np.arange(6), [model.joints[i].idx_v for i in ids]])
        self._lower, self._upper = model.lowerPositionLimit[self._q].copy(), model.upperPositionLimit[self._q].copy()
        low, high = spec.pelvis_height_range_m
        stance = robot.arm_posture(crouch(robot, high - 0.06 * (high - low) - 0.01).q, "rest")
        self._start = robot.configuration(np.array([0.0, 0.0, high, 1.0, 0.0, 0.0, 0.0]), stance)
        prior = np.full(len(names), _PRIOR)
        self._search = BoundedSearch(model, self._q, self._v, prior, self._start[self._q], _DAMPING)
        jacobian, _ = self._system(self._start, np.zeros((len(KEY_BODIES), 3)))
        moves = np.linalg.norm(jacobian.reshape(len(KEY_BODIES), 3, -1), axis=1).max(axis=0)[6:]
        self.shown = np.zeros(len(robot.joint_names), dtype=bool)
        self.shown[robot.indices(tuple(names))] = moves > _SEEN_M

    def __call__(self, features: NDArray[np.floating]) -> tuple[Array, Array]:
        """Root pose (T, 7), position (m) and quaternion (w, x, y, z), and joints (T, J) of features (T, F).

        The path starts at x = y = yaw = 0.

        Raises:
            ValueError: when the last axis is not F long.
        """
        keys = decode_key_bodies(features).astype(np.float64)
        path = decode_root(features)
        root, joints = np.empty((len(keys), 7)), np.empty((len(keys), len(self.robot.joint_names)))
        q = self._start.copy()
        for t, places in enumerate(keys):
            q[2] = features[t, PELVIS_HEIGHT]
            targets = places + np.array([0.0, 0.0, features[t, PELVIS_HEIGHT]])
            q = self._search(
                q, lambda at, aim=targets: self._system(at, aim), self._lower, self._upper,
                _FIRST_ITERATIONS if t == 0 else _ITERATIONS,
            )  # fmt: skip
            turn = pin.Quaternion(np.array([0.0, 0.0, path[t, 6], path[t, 3]])) * pin.Quaternion(q[3:7])
            x, y, z, w = turn.coeffs()
            root[t] = [path[t, 0], path[t, 1], q[2], w, x, y, z]
            joints[t] = q[self.robot._q_index]
            for side, share in zip(SIDES, np.clip(features[t, HAND_OPENING], 0.0, 1.0), strict=True):
                arm = self.robot.spec.arms[side]
                hand = np.array(arm.hand_closed) * (1.0 - share) + np.array(arm.hand_open) * share
                joints[t, self.robot.indices(arm.hand_joints)] = hand
        return root, joints

    def _system(self, q: Array, targets: Array) -> tuple[Array, Array]:
        """Jacobian (3 K + 3, N) and residual of key bodies at `targets` (K, 3) and the pelvis above the origin without yaw."""
        model, data = self.robot.model, self.robot.data
        pin.computeJointJacobians(model, data, q)
        pin.updateFramePlacements(model, data)
        world = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
        rows = [pin.getFrameJacobian(model, data, frame, world)[:3, self._v] for frame in self._frames]
        residual = [data.oMf[frame].translation - target for frame, target in zip(self._frames, targets, strict=True)]
        return np.concatenate(rows), np.concatenate(residual)
