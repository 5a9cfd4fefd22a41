"""Retargets human motion to a robot: Gauss-Newton on Pinocchio, a few iterations per frame from the previous frame's solution.

For each frame, with q the configuration (floating base included), W the weights and r the residuals below, it iterates
`q <- q ⊕ -(JᵀWJ + λ)⁻¹ JᵀWr`, with joints held at the bounds that joint limits and joint velocity give.

Residuals: place and orientation of both soles (flat, locked during contact), place and orientation of the pelvis (orientation
from the human trunk, height lowered until both legs reach), and for each arm the vectors shoulder to elbow and elbow to
wrist, which are the robot's bone lengths along the human's directions. Lengths scale by the ratio of the legs.
Shape letters: T frames, J joints. Frames: world, z up, floor at 0.

Paper: data preparation, "retargeted to the robot". Left out: hands' orientation, objects, self-collision as a constraint.
Run `python -m data.retarget report` for a table of metrics.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d, minimum_filter1d

from data.contacts import lock, toe_contacts
from data.motion import FPS, encode_frames, resample
from data.records import Motion
from data.skeleton import HumanMotion, index
from sim.robots.kinematics import RobotModel
from sim.robots.leg_ik import crouch
from sim.robots.spec import RobotSpec

__all__ = ["MAX_JOINT_VELOCITY", "Measured", "Retargeted", "Retargeter", "Targets"]

Array = NDArray[np.float64]
#: rad/s; the slowest limit in H1's vendor description (ankles and shoulders), used for both robots.
MAX_JOINT_VELOCITY: Final = 9.0
_FIRST_ITERATIONS: Final = 40
_LEAST_KNEE_RAD: Final = 0.05
_DAMPING: Final = 1e-2
_POSTURE_WEIGHT: Final = 0.03
_HIP_YAW_WEIGHT: Final = 0.12
_WEIGHTS: Final = {"sole": 20.0, "sole_rotation": 3.0, "pelvis": 3.0, "pelvis_rotation": 2.0, "arm": 4.0, "shoulders": 2.0}
_DEFAULT_OPENING: Final = 0.6


@dataclass(frozen=True, slots=True)
class Targets:
    """What the robot should do, per frame.

    Attributes:
        pelvis: (T, 3) metres.
        pelvis_rotation: (T, 3, 3).
        soles: (T, 2, 3) metres, left and right.
        sole_rotation: (T, 2, 3, 3), flat.
        arms: (T, 2, 2, 3) shoulder to elbow and elbow to wrist, metres, left and right.
        shoulders: (T, 3) from the right to the left shoulder, metres.
        contact: (T, 2) planted feet.
        scale: robot metres per human metre.
    """

    pelvis: Array
    pelvis_rotation: Array
    soles: Array
    sole_rotation: Array
    arms: Array
    shoulders: Array
    contact: NDArray[np.bool_]
    scale: float


@dataclass(frozen=True, slots=True)
class Retargeted:
    """A robot motion with what it was made from, for metrics and filters."""

    motion: Motion
    source: HumanMotion
    targets: Targets


@dataclass(frozen=True, slots=True)
class Measured:
    """Where the robot really is, per frame, for comparison with `Targets`.

    Attributes:
        soles: (T, 2, 3) metres.
        sole_corners: (T, 2, 4, 3) metres.
        arms: (T, 2, 2, 3) shoulder to elbow, elbow to wrist.
        legs: (T, 2, 2, 3) hip to knee, knee to ankle.
    """

    soles: Array
    sole_corners: Array
    arms: Array
    legs: Array


class Retargeter:
    """Retargets clips to one robot; keeps the robot model and its bone lengths between clips."""

    def __init__(self, spec: RobotSpec, iterations: int = 3) -> None:
        """Measures the robot.

        Args:
            spec: robot.
            iterations: Gauss-Newton iterations per frame.

        Raises:
            ValueError: when `iterations` is not positive.
        """
        if iterations < 1:
            raise ValueError(f"iterations {iterations} must be at least 1")
        self.spec, self.iterations = spec, iterations
        self.robot = RobotModel(spec)
        model = self.robot.model
        low, high = spec.pelvis_height_range_m
        self._stance = crouch(self.robot, high - 0.06 * (high - low) - 0.01).q
        joints = [*spec.leg_joints, *spec.waist_joints, *(j for arm in spec.arms.values() for j in arm.joints)]
        ids = [model.getJointId(name) for name in joints]
        self._q_columns = np.array([model.joints[i].idx_q for i in ids])
        self._v_columns = np.concatenate([np.arange(6), [model.joints[i].idx_v for i in ids]])
        self._lower = model.lowerPositionLimit[self._q_columns].copy()
        self._upper = model.upperPositionLimit[self._q_columns].copy()
        for i, name in enumerate(joints):
            if "knee" in name:  # a knee stays on the side to which it bends when crouching; stretched legs would flip it
                if self._stance[self.robot.indices((name,))[0]] > 0.0:
                    self._lower[i] = max(self._lower[i], _LEAST_KNEE_RAD)
                else:
                    self._upper[i] = min(self._upper[i], -_LEAST_KNEE_RAD)
        self._prior = np.array([_HIP_YAW_WEIGHT if "hip_yaw" in name else _POSTURE_WEIGHT for name in joints])
        frame = self.robot.frame_id
        keys = spec.key_bodies
        self._pelvis = frame(spec.root_body)
        self._soles = [frame(f"{side}_sole") for side in ("left", "right")]
        self._arm_frames = [
            (frame(keys[f"{side}_shoulder"]), frame(keys[f"{side}_elbow"]), self._wrist_frame(side))
            for side in ("left", "right")
        ]
        self._measure()

    def _wrist_frame(self, side: str) -> int:
        joint = self.robot.model.getJointId(self.spec.arms[side].joints[-1])
        frames = self.robot.model.frames
        return next(i for i, f in enumerate(frames) if f.type == pin.FrameType.JOINT and f.parentJoint == joint)

    def _measure(self) -> None:
        model, data = self.robot.model, self.robot.data
        root = np.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0])
        self._reference = self.robot.configuration(root, self._stance)
        pin.framesForwardKinematics(model, data, self._reference)
        at = lambda name: data.oMf[self.robot.frame_id(self.spec.key_bodies[name])].translation.copy()  # noqa: E731
        self._hips = np.stack([at("left_hip"), at("right_hip")])  # in the pelvis frame
        self._thigh = float(np.linalg.norm(at("left_knee") - at("left_hip")))
        self._shin = float(np.linalg.norm(at("left_ankle") - at("left_knee")))
        soles = np.stack([data.oMf[i].translation for i in self._soles])
        self._ankle_above_sole = np.stack([at("left_ankle"), at("right_ankle")]) - soles
        self._bones = [
            (
                float(np.linalg.norm(data.oMf[e].translation - data.oMf[s].translation)),
                float(np.linalg.norm(data.oMf[w].translation - data.oMf[e].translation)),
            )
            for s, e, w in self._arm_frames
        ]
        self._shoulder_width = float(np.linalg.norm(at("left_shoulder") - at("right_shoulder")))
        self._sole_home = [data.oMf[i].rotation.copy() for i in self._soles]
        self._sole_level = [_level(rotation) for rotation in self._sole_home]

    def targets(self, human: HumanMotion) -> Targets:
        """What the robot should do to follow a clip that runs at 20 frames per second."""
        joints = human.joints
        side = lambda name: joints[:, [index(f"left_{name}"), index(f"right_{name}")]]  # noqa: E731
        hips, knees, ankles, toes = side("hip"), side("knee"), side("ankle"), side("foot")
        shoulders, elbows, wrists = side("shoulder"), side("elbow"), side("wrist")
        leg = float(np.median(_length(hips - knees) + _length(knees - ankles)))
        scale = (self._thigh + self._shin) / leg
        contact = toe_contacts(joints, human.fps)
        # Pelvis orientation: up along the trunk, left along the hips.
        up = _unit(joints[:, index("neck")] - joints[:, 0])
        left = hips[:, 0] - hips[:, 1]
        left = _unit(left - up * np.sum(left * up, axis=1, keepdims=True))
        rotation = np.stack([np.cross(left, up), left, up], axis=-1)
        level_left = _unit(left * np.array([1.0, 1.0, 0.0]))
        # Soles: human mid-foot, moved out to the robot's hip width.
        human_half = 0.5 * float(np.median(_length(hips[:, 0] - hips[:, 1])))
        spread = max(0.0, 0.85 * float(self._hips[0, 1]) - scale * human_half)
        soles, yaws = np.empty((len(joints), 2, 3)), np.empty((len(joints), 2))
        for foot, sign in ((0, 1.0), (1, -1.0)):
            floor = _floor_height(ankles[:, foot, 2], contact[:, foot])
            place = (0.55 * ankles[:, foot] + 0.45 * toes[:, foot]) * scale + sign * spread * level_left
            place[:, 2] = np.where(contact[:, foot], 0.0, np.maximum(ankles[:, foot, 2] - floor, 0.0) * scale)
            toward = toes[:, foot] - ankles[:, foot]
            yaw = np.unwrap(np.arctan2(toward[:, 1], toward[:, 0]))
            locked = lock(np.column_stack([place, yaw]), contact[:, foot])
            soles[:, foot], yaws[:, foot] = locked[:, :3], locked[:, 3]
        soles[..., 2] = np.maximum(soles[..., 2], 0.0)
        turn = _about_z(yaws)  # (T, 2, 3, 3)
        sole_rotation = np.stack([turn[:, foot] @ self._sole_level[foot] for foot in (0, 1)], axis=1)
        ankle_targets = soles + np.stack([(turn[:, foot] @ self._ankle_above_sole[foot]) for foot in (0, 1)], axis=1)
        # Pelvis place: hips scaled about the floor, then lowered until both legs reach.
        floor = min(_floor_height(ankles[:, foot, 2], contact[:, foot]) for foot in (0, 1))
        middle = 0.5 * (hips[:, 0] + hips[:, 1])
        hip_middle = middle * scale
        hip_middle[:, 2] = (middle[:, 2] - floor) * scale + float(self._ankle_above_sole[0, 2])
        offsets = np.einsum("tij,fj->tfi", rotation, self._hips)
        pelvis = hip_middle - offsets.mean(axis=1)
        lowest = self.spec.pelvis_height_range_m[0]
        pelvis[:, 2] = np.maximum(self._reachable(pelvis, offsets, ankle_targets), lowest)
        arms = np.empty((len(joints), 2, 2, 3))
        for arm in (0, 1):
            arms[:, arm, 0] = _unit(elbows[:, arm] - shoulders[:, arm]) * self._bones[arm][0]
            arms[:, arm, 1] = _unit(wrists[:, arm] - elbows[:, arm]) * self._bones[arm][1]
        across = _unit(shoulders[:, 0] - shoulders[:, 1]) * self._shoulder_width
        return Targets(pelvis, rotation, soles, sole_rotation, arms, across, contact, scale)

    def _reachable(self, pelvis: Array, hip_offsets: Array, ankles: Array) -> Array:
        flat = _length((pelvis[:, None] + hip_offsets - ankles)[..., :2])
        leg = 0.985 * (self._thigh + self._shin)
        rise = np.sqrt(np.maximum(leg**2 - np.minimum(flat, 0.95 * leg) ** 2, 0.0))
        limit = np.minimum(pelvis[:, 2], np.min(ankles[..., 2] + rise - hip_offsets[..., 2], axis=1))
        if len(limit) < 5:
            return limit
        return np.minimum(gaussian_filter1d(minimum_filter1d(limit, 3), 1.0, mode="nearest"), limit)

    def __call__(self, human: HumanMotion) -> Retargeted:
        """Retargets one clip; motions of another rate are resampled to 20 frames per second first."""
        if human.fps != FPS:
            opening = None if human.hand_opening is None else resample(human.hand_opening, human.fps)
            human = HumanMotion(human.name, resample(human.joints, human.fps), FPS, human.captions, opening, human.split)
        targets = self.targets(human)
        frames = len(human.joints)
        opening = (
            np.full((frames, 2), _DEFAULT_OPENING) if human.hand_opening is None else np.clip(human.hand_opening, 0.0, 1.0)
        )
        q = self._reference.copy()
        q[:3] = targets.pelvis[0]
        q[3:7] = pin.Quaternion(targets.pelvis_rotation[0]).coeffs()
        root, joints = np.empty((frames, 7)), np.empty((frames, len(self.robot.joint_names)))
        keys = np.empty((frames, 14, 3))
        for t in range(frames):
            q = self._solve(q, targets, t)
            root[t] = q[[0, 1, 2, 6, 3, 4, 5]]
            joints[t] = self._with_hands(q, opening[t])
            keys[t] = self.robot.key_body_positions(root[t], joints[t])
        features = encode_frames(root, keys, opening, FPS)
        captions = tuple(caption.text for caption in human.captions if caption.end_s == 0.0)
        captions = captions or tuple(caption.text for caption in human.captions)
        motion = Motion(human.name, self.spec.name, FPS, features, captions, root, joints)
        return Retargeted(motion, human, targets)

    def measured_points(self, result: Retargeted) -> Measured:
        """Points of the robot in every frame of a retargeted clip."""
        motion = result.motion
        assert motion.root_pose is not None
        assert motion.joint_positions is not None
        frames = len(motion.root_pose)
        soles, corners = np.empty((frames, 2, 3)), np.empty((frames, 2, 4, 3))
        arms, legs = np.empty((frames, 2, 2, 3)), np.empty((frames, 2, 2, 3))
        foot = self.spec.foot
        signs = np.array([[1, 1], [1, -1], [-1, 1], [-1, -1]]) * [foot.half_length_m, foot.half_width_m]
        level = np.concatenate([signs, np.zeros((4, 1))], axis=1)  # corners around the sole site, foot along x
        model, data = self.robot.model, self.robot.data
        keys = self.spec.key_bodies
        leg_frames = [
            [self.robot.frame_id(keys[f"{side}_{part}"]) for part in ("hip", "knee", "ankle")] for side in ("left", "right")
        ]
        for t in range(frames):
            pin.framesForwardKinematics(model, data, self.robot.configuration(motion.root_pose[t], motion.joint_positions[t]))
            for side in (0, 1):
                sole = data.oMf[self._soles[side]]
                soles[t, side] = sole.translation
                corners[t, side] = sole.translation + level @ (sole.rotation @ self._sole_level[side].T).T
                for into, chain in ((arms, self._arm_frames[side]), (legs, leg_frames[side])):
                    points = np.stack([data.oMf[frame].translation for frame in chain])
                    into[t, side] = np.diff(points, axis=0)
        return Measured(soles, corners, arms, legs)

    def _with_hands(self, q: Array, opening: Array) -> Array:
        joints = q[self.robot._q_index].copy()
        for arm, share in zip(("left", "right"), opening, strict=True):
            spec = self.spec.arms[arm]
            hand = np.array(spec.hand_closed) * (1.0 - share) + np.array(spec.hand_open) * share
            joints[self.robot.indices(spec.hand_joints)] = hand
        return joints

    def _solve(self, q: Array, targets: Targets, t: int) -> Array:
        lower, upper = self._lower, self._upper
        if t > 0:
            step = MAX_JOINT_VELOCITY / FPS * 0.999
            lower, upper = np.maximum(lower, q[self._q_columns] - step), np.minimum(upper, q[self._q_columns] + step)
        columns = self._v_columns
        for _ in range(_FIRST_ITERATIONS if t == 0 else self.iterations):
            jacobian, residual = self._system(q, targets, t)
            hessian = jacobian.T @ jacobian
            gradient = jacobian.T @ residual
            gradient[6:] += self._prior**2 * (q[self._q_columns] - self._reference[self._q_columns])
            diagonal = np.full(len(columns), _DAMPING)
            diagonal[6:] += self._prior**2
            hessian.flat[:: len(columns) + 1] += diagonal
            step = np.zeros(self.robot.model.nv)
            here = q[self._q_columns]
            step[columns] = _bounded_step(hessian, gradient, lower - here, upper - here)
            q = pin.integrate(self.robot.model, q, step)
            q[self._q_columns] = np.clip(q[self._q_columns], lower, upper)
        return q

    def _system(self, q: Array, targets: Targets, t: int) -> tuple[Array, Array]:
        model, data = self.robot.model, self.robot.data
        pin.computeJointJacobians(model, data, q)
        pin.updateFramePlacements(model, data)
        rows: list[Array] = []
        residuals: list[Array] = []

        def jacobian(frame: int) -> Array:
            return pin.getFrameJacobian(model, data, frame, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED)[:, self._v_columns]

        def add(J: Array, r: Array, weight: float) -> None:
            rows.append(J * weight)
            residuals.append(r * weight)

        def add_pose(frame: int, place: Array, rotation: Array, w_place: float, w_rotation: float) -> None:
            J, pose = jacobian(frame), data.oMf[frame]
            add(J[:3], pose.translation - place, w_place)
            add(J[3:], pin.log3(pose.rotation @ rotation.T), w_rotation)

        w = _WEIGHTS
        add_pose(self._pelvis, targets.pelvis[t], targets.pelvis_rotation[t], w["pelvis"], w["pelvis_rotation"])
        for foot in (0, 1):
            add_pose(self._soles[foot], targets.soles[t, foot], targets.sole_rotation[t, foot], w["sole"], w["sole_rotation"])
        shoulder_jacobians = []
        for arm, (shoulder, elbow, wrist) in enumerate(self._arm_frames):
            J_s, J_e, J_w = (jacobian(frame)[:3] for frame in (shoulder, elbow, wrist))
            p_s, p_e, p_w = (data.oMf[frame].translation for frame in (shoulder, elbow, wrist))
            add(J_e - J_s, p_e - p_s - targets.arms[t, arm, 0], w["arm"])
            add(J_w - J_s, p_w - p_s - targets.arms[t, arm].sum(axis=0), 2.0 * w["arm"])
            shoulder_jacobians.append((J_s, p_s.copy()))
        (J_l, p_l), (J_r, p_r) = shoulder_jacobians
        add(J_l - J_r, p_l - p_r - targets.shoulders[t], w["shoulders"])
        return np.concatenate(rows), np.concatenate(residuals)


def _bounded_step(hessian: Array, gradient: Array, lower: Array, upper: Array) -> Array:
    """Newton step whose joint part (all but the first six entries) stays within bounds; joints that would leave are held."""
    step = -np.linalg.solve(hessian, gradient)
    held = np.zeros(len(step), dtype=bool)
    for _ in range(3):
        joints = step[6:]
        outside = np.concatenate([np.zeros(6, dtype=bool), (joints < lower - 1e-12) | (joints > upper + 1e-12)])
        if not outside.any():
            break
        held |= outside
        step[6:] = np.clip(joints, lower, upper)
        free = ~held
        right = -gradient[free] - hessian[np.ix_(free, held)] @ step[held]
        step[free] = np.linalg.solve(hessian[np.ix_(free, free)], right)
    step[6:] = np.clip(step[6:], lower, upper)
    return step


def _length(vectors: Array) -> Array:
    lengths: Array = np.linalg.norm(vectors, axis=-1).astype(np.float64)
    return lengths


def _unit(vectors: Array) -> Array:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-9)


def _floor_height(ankle_z: Array, contact: NDArray[np.bool_]) -> float:
    return float(np.median(ankle_z[contact])) if contact.any() else float(np.min(ankle_z))


def _about_z(yaw_rad: Array) -> Array:
    cos, sin, zero, one = np.cos(yaw_rad), np.sin(yaw_rad), np.zeros_like(yaw_rad), np.ones_like(yaw_rad)
    rows = [np.stack(row, axis=-1) for row in ([cos, -sin, zero], [sin, cos, zero], [zero, zero, one])]
    return np.stack(rows, axis=-2)


def _level(rotation: Array) -> Array:
    """The right-angled rotation closest to `rotation`: the sole's frame when the foot is flat and points along x."""
    snapped = np.zeros((3, 3))
    for column in range(3):
        row = int(np.argmax(np.abs(rotation[:, column])))
        snapped[row, column] = np.sign(rotation[row, column])
    return snapped
