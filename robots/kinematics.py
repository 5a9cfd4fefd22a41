"""Forward kinematics, centre of mass and support polygon of a robot on Pinocchio, from the same MJCF that MuJoCo compiles."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import ConvexHull

from interface.bodies import KEY_BODIES
from robots.self_collision import OwnBody
from robots.spec import RobotSpec

Array = NDArray[np.float64]


def root_quaternion(yaw_rad: float, pitch_rad: float = 0.0) -> Array:
    """Quaternion (w, x, y, z) of a pelvis turned by `yaw_rad` and then leaning forward by `pitch_rad`."""
    cy, sy, cp, sp = np.cos(yaw_rad / 2), np.sin(yaw_rad / 2), np.cos(pitch_rad / 2), np.sin(pitch_rad / 2)
    return np.array([cy * cp, -sy * sp, cy * sp, sy * cp])


class RobotModel:
    """A robot's kinematics.

    Joint vectors are (J,) in `joint_names` order, every scalar joint of the MJCF; root poses are (7,): position (m) and
    quaternion (w, x, y, z) in the world.
    """

    def __init__(self, spec: RobotSpec) -> None:
        self.spec = spec
        self.model: pin.Model = pin.buildModelFromMJCF(str(spec.mjcf_path))
        self.data: pin.Data = self.model.createData()
        self.joint_names = spec.joints
        self._q_index = np.array([self.model.joints[self.model.getJointId(name)].idx_q for name in spec.joints])
        self._index = {name: i for i, name in enumerate(spec.joints)}
        self.lower: Array = self.model.lowerPositionLimit[self._q_index].copy()
        self.upper: Array = self.model.upperPositionLimit[self._q_index].copy()
        self._key_frames = [self.frame_id(spec.key_bodies[name]) for name in KEY_BODIES]

    @cached_property
    def own_body(self) -> OwnBody:
        """The robot's shapes, for distances to itself."""
        return OwnBody(self)

    def frame_id(self, name: str) -> int:
        """Pinocchio frame of a body or site.

        Raises:
            ValueError: when the MJCF has no such frame.
        """
        if not self.model.existFrame(name):
            raise ValueError(f"{self.spec.name}: no body or site {name!r}")
        return int(self.model.getFrameId(name))

    def indices(self, names: tuple[str, ...]) -> NDArray[np.int64]:
        """Positions of the named joints in a joint vector."""
        return np.array([self._index[name] for name in names], dtype=np.int64)

    def configuration(self, root_pose: ArrayLike, q: ArrayLike) -> Array:
        """Pinocchio's configuration vector from root pose (7,) and joints (J,)."""
        root, joints = np.asarray(root_pose, dtype=float), np.asarray(q, dtype=float)
        if root.shape != (7,) or joints.shape != (len(self.joint_names),):
            raise ValueError(f"expected shapes (7,) and ({len(self.joint_names)},), got {root.shape} and {joints.shape}")
        full = pin.neutral(self.model)
        full[:3] = root[:3]
        full[3:7] = root[[4, 5, 6, 3]]  # Pinocchio: x, y, z, w
        full[self._q_index] = joints
        return full

    def frames(self, root_pose: ArrayLike, q: ArrayLike, names: tuple[str, ...]) -> Array:
        """World poses (N, 4, 4) of bodies or sites."""
        pin.framesForwardKinematics(self.model, self.data, self.configuration(root_pose, q))
        return np.stack([self.data.oMf[self.frame_id(name)].homogeneous for name in names])

    def key_body_positions(self, root_pose: ArrayLike, q: ArrayLike) -> Array:
        """World positions (K, 3) of `KEY_BODIES` in metres."""
        pin.framesForwardKinematics(self.model, self.data, self.configuration(root_pose, q))
        return np.stack([self.data.oMf[index].translation for index in self._key_frames])

    def centre_of_mass(self, root_pose: ArrayLike, q: ArrayLike) -> Array:
        """World position (3,) of the centre of mass in metres."""
        return np.asarray(pin.centerOfMass(self.model, self.data, self.configuration(root_pose, q))).copy()

    def posture(self, values: Mapping[str, float] | None = None) -> Array:
        """A joint vector (J,) of zeros with the given joints set, clipped to the limits."""
        q = np.zeros(len(self.joint_names))
        for name, value in (values or {}).items():
            q[self._index[name]] = value
        return np.clip(q, self.lower, self.upper)

    def arm_posture(self, q: ArrayLike, kind: str) -> Array:
        """Copy of `q` with both arms at their `rest` or `carry` posture and both hands open."""
        out = np.array(q, dtype=float)
        for arm in self.spec.arms.values():
            out[self.indices(arm.joints)] = arm.rest if kind == "rest" else arm.carry
            out[self.indices(arm.hand_joints)] = arm.hand_open
        return np.clip(out, self.lower, self.upper)

    def balance_margin(self, root_pose: ArrayLike, q: ArrayLike) -> float:
        """Distance (m) of the centre of mass to the edge of the support polygon of both flat soles, positive inside."""
        com = self.centre_of_mass(root_pose, q)[:2]
        soles = self.frames(root_pose, q, ("left_sole", "right_sole"))
        half = np.array([self.spec.foot.half_length_m, self.spec.foot.half_width_m])
        signs = np.array([[-1, -1], [-1, 1], [1, -1], [1, 1]])
        points = np.concatenate([sole[:2, 3] + (signs * half) @ sole[:2, :2].T for sole in soles])  # (8, 2)
        return _distance_to_hull_edge(com, points)


def _distance_to_hull_edge(point: Array, points: Array) -> float:
    """Signed distance of a planar point to the edge of the convex hull of `points` (N, 2), positive inside."""
    hull = ConvexHull(points)
    # rows of `equations` are outward unit normals n and offsets c with n x + c <= 0 inside
    return float(np.min(-(hull.equations[:, :2] @ point + hull.equations[:, 2])))
