"""Retargets human motion to a robot: Gauss-Newton on Pinocchio, a few iterations per frame from the previous frame's solution.

For each frame, with q the configuration (floating base included), W the weights and r the residuals below, it iterates
`q <- q ⊕ -(JᵀWJ + λ)⁻¹ JᵀWr`, with joints held at the bounds that joint limits and joint velocity give (`data.least_squares`).

Residuals, against `data.targets`: place and orientation of both soles (flat, locked during contact), place and orientation
of the pelvis (orientation from the human trunk, height lowered until both legs reach), and for each arm the vectors shoulder
to elbow and elbow to wrist, which are the robot's bone lengths along the human's directions. Corners of the soles below the
floor, and parts of the robot that come too near to each other, are residuals as well.
Shape letters: T frames, J joints. Frames: world, z up, floor at 0.

Paper: data preparation, "retargeted to the robot". Left out: hands' orientation, objects.
Run `python -m proprio_mllm report retarget` for a table of metrics.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from data.least_squares import BoundedSearch, System
from data.motion import FPS, encode_frames, resample
from data.residuals import BodyFrames, Residuals
from data.self_contact import SelfContact
from data.skeleton import HumanMotion
from data.targets import Measures, Targets, make_targets
from interface.bodies import KEY_BODIES
from interface.motion import Motion
from robots.kinematics import RobotModel
from robots.leg_ik import crouch
from robots.spec import RobotSpec

Array = NDArray[np.float64]
#: rad/s; the slowest limit in H1's vendor description (ankles and shoulders), used for both robots.
MAX_JOINT_VELOCITY: Final = 9.0
_FIRST_ITERATIONS: Final = 40
_LEAST_KNEE_RAD: Final = 0.05
_DAMPING: Final = 0.3
_POSTURE_WEIGHT: Final = 0.03
_HIP_YAW_WEIGHT: Final = 0.12
_DEFAULT_OPENING: Final = 0.6


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
        points: (T, 12, 3) hips, knees, ankles, shoulders, elbows, wrists; left before right.
    """

    soles: Array
    sole_corners: Array
    arms: Array
    legs: Array
    points: Array


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
            (frame(keys[f"{side}_shoulder"]), frame(keys[f"{side}_elbow"]), _wrist_frame(self.robot, side))
            for side in ("left", "right")
        ]
        self._measure()
        left, right = self._arm_frames
        frames = BodyFrames(
            self._pelvis, (self._soles[0], self._soles[1]), (left, right), self.measures.sole_level, self._corners
        )
        #: views into Pinocchio's data
        self._keys = [self.robot.data.oMf[frame(keys[name])].translation for name in KEY_BODIES]
        self._residuals = Residuals(self.robot, frames, self._v_columns)
        self._search = BoundedSearch(
            model, self._q_columns, self._v_columns, self._prior, self._reference[self._q_columns], _DAMPING
        )

    @cached_property
    def self_contact(self) -> SelfContact:
        """Depth of the robot's contacts with itself."""
        return SelfContact(self.robot)

    def _measure(self) -> None:
        model, data = self.robot.model, self.robot.data
        root = np.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0])
        self._reference = self.robot.configuration(root, self._stance)
        pin.framesForwardKinematics(model, data, self._reference)
        place = {name: data.oMf[self.robot.frame_id(body)].translation.copy() for name, body in self.spec.key_bodies.items()}
        soles = np.stack([data.oMf[i].translation for i in self._soles])
        bones = [[data.oMf[frame].translation.copy() for frame in frames] for frames in self._arm_frames]
        foot = self.spec.foot
        signs = np.array([[1, 1], [1, -1], [-1, 1], [-1, -1]]) * [foot.half_length_m, foot.half_width_m]
        self._corners = np.concatenate([signs, np.zeros((4, 1))], axis=1)  # around the sole site, foot along x
        self._sole_level = [_level(data.oMf[i].rotation) for i in self._soles]
        self.measures = Measures(
            hips=np.stack([place["left_hip"], place["right_hip"]]),
            thigh_m=_distance(place["left_hip"], place["left_knee"]),
            shin_m=_distance(place["left_knee"], place["left_ankle"]),
            ankle_above_sole=np.stack([place["left_ankle"], place["right_ankle"]]) - soles,
            arms_m=tuple((_distance(s, e), _distance(e, w)) for s, e, w in bones),
            shoulder_width_m=_distance(place["left_shoulder"], place["right_shoulder"]),
            sole_level=np.stack(self._sole_level),
            lowest_pelvis_m=self.spec.pelvis_height_range_m[0],
        )

    def __call__(self, human: HumanMotion) -> Retargeted:
        """Retargets one clip; motions of another rate are resampled to 20 frames per second first."""
        if human.fps != FPS:
            opening = None if human.hand_opening is None else resample(human.hand_opening, human.fps)
            human = HumanMotion(human.name, resample(human.joints, human.fps), FPS, human.captions, opening, human.split)
        targets = make_targets(human, self.measures)
        frames = len(human.joints)
        opening = (
            np.full((frames, 2), _DEFAULT_OPENING) if human.hand_opening is None else np.clip(human.hand_opening, 0.0, 1.0)
        )
        q = self._reference.copy()
        q[:3] = targets.pelvis[0]
        q[3:7] = pin.Quaternion(targets.pelvis_rotation[0]).coeffs()
        root, joints = np.empty((frames, 7)), np.empty((frames, len(self.robot.joint_names)))
        keys = np.empty((frames, 14, 3))
        for t, system in enumerate(self._residuals.follow(targets)):
            q = self._solve(q, system, t == 0)
            root[t] = q[[0, 1, 2, 6, 3, 4, 5]]
            joints[t] = self._with_hands(q, opening[t])
            pin.framesForwardKinematics(self.robot.model, self.robot.data, q)
            keys[t] = self._keys
        features = encode_frames(root, keys, opening, FPS)
        captions = tuple(caption.text for caption in human.captions if caption.end_s == 0.0)
        captions = captions or tuple(caption.text for caption in human.captions)
        motion = Motion(human.name, self.spec.name, FPS, features, captions, root, joints)
        return Retargeted(motion, human, targets)

    def measured_joints(self, root_pose: Array, joints: Array) -> Measured:
        """Points of the robot for root poses (T, 7) and joint vectors (T, J)."""
        frames = len(root_pose)
        soles, corners = np.empty((frames, 2, 3)), np.empty((frames, 2, 4, 3))
        chains = np.empty((frames, 2, 2, 3, 3))  # side, leg or arm, along the limb
        model, data = self.robot.model, self.robot.data
        keys = self.spec.key_bodies
        leg_frames = [
            [self.robot.frame_id(keys[f"{side}_{part}"]) for part in ("hip", "knee", "ankle")] for side in ("left", "right")
        ]
        for t in range(frames):
            pin.framesForwardKinematics(model, data, self.robot.configuration(root_pose[t], joints[t]))
            for side in (0, 1):
                sole = data.oMf[self._soles[side]]
                soles[t, side] = sole.translation
                corners[t, side] = sole.translation + self._corners @ (sole.rotation @ self._sole_level[side].T).T
                for limb, frames_of in enumerate((leg_frames[side], self._arm_frames[side])):
                    chains[t, side, limb] = [data.oMf[frame].translation for frame in frames_of]
        bones = np.diff(chains, axis=3)
        points = chains.transpose(0, 2, 3, 1, 4).reshape(frames, 12, 3)
        return Measured(soles, corners, arms=bones[:, :, 1], legs=bones[:, :, 0], points=points)

    def _with_hands(self, q: Array, opening: Array) -> Array:
        joints = q[self.robot._q_index].copy()
        for arm, share in zip(("left", "right"), opening, strict=True):
            spec = self.spec.arms[arm]
            hand = np.array(spec.hand_closed) * (1.0 - share) + np.array(spec.hand_open) * share
            joints[self.robot.indices(spec.hand_joints)] = hand
        return joints

    def _solve(self, q: Array, system: System, first: bool) -> Array:
        lower, upper = self._lower, self._upper
        if not first:
            step = MAX_JOINT_VELOCITY / FPS * 0.999
            lower, upper = np.maximum(lower, q[self._q_columns] - step), np.minimum(upper, q[self._q_columns] + step)
        return self._search(q, system, lower, upper, _FIRST_ITERATIONS if first else self.iterations)


def _wrist_frame(robot: RobotModel, side: str) -> int:
    """The frame of the last joint of an arm."""
    joint = robot.model.getJointId(robot.spec.arms[side].joints[-1])
    return next(i for i, f in enumerate(robot.model.frames) if f.type == pin.FrameType.JOINT and f.parentJoint == joint)


def _distance(a: Array, b: Array) -> float:
    return float(np.linalg.norm(b - a))


def _level(rotation: Array) -> Array:
    """The right-angled rotation closest to `rotation`: the sole's frame when the foot is flat and points along x."""
    snapped = np.zeros((3, 3))
    for column in range(3):
        row = int(np.argmax(np.abs(rotation[:, column])))
        snapped[row, column] = np.sign(rotation[row, column])
    return snapped
