"""Inverse kinematics in the world: which joints bring the hands to a pose, and where hands are with given joints.

The waist stays straight while a single arm acts, so that parallel arm skills do not disturb each other. Paper: low-level
control through inverse kinematics (each arm alone, or the whole body).
"""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import mujoco
import numpy as np
from numpy.typing import NDArray

from interface.bodies import Arm
from robots.arm_ik import PerArmSolver
from robots.build_solver import RobotKit
from robots.self_collision import SELF_TOUCH_M
from robots.solver import ReachTarget
from sim.skills.body.joints import JointMap
from sim.skills.body.posture import Posture
from sim.skills.body.ready import ready_posture
from sim.skills.navigation import Stance
from sim.skills.reach_map import WOUND_RAD, HandPose, ReachMap, reach_maps

Array = NDArray[np.float64]

#: Position error of an arm posture that still counts as reaching, metres. Chosen by hand.
REACH_TOLERANCE_M: Final = 0.012
#: Steps of pelvis height tried when a target is out of reach, metres.
_HEIGHT_STEP_M: Final = 0.05


@dataclass(frozen=True, slots=True)
class ArmGoal:
    """A solved arm posture.

    Attributes:
        q: (A,) arm joints.
        error_m: distance of the grasp site from the target.
        pointing_cos, closing_cos: how well the hand's axes agree with the target, 1 where it left them open.
        pointing, closing: (3,) directions that the hand has then, world frame.
    """

    q: Array
    error_m: float
    pointing_cos: float
    closing_cos: float
    pointing: Array
    closing: Array


@dataclass(frozen=True, slots=True)
class BothGoal:
    """A solved posture of both arms and the waist.

    Attributes:
        arms: (A,) joints per arm.
        waist: waist joints.
        error_m: largest distance of a grasp site from its target.
        tilt_rad: largest angle between a pointing direction that is asked for and the one reached direction.
    """

    arms: Mapping[Arm, Array]
    waist: Array
    error_m: float
    tilt_rad: float = 0.0


class InverseKinematics:
    """Solvers of one robot, for the posture that is commanded or assumed.

    Attributes:
        maps: reach map per arm.
    """

    def __init__(self, data: mujoco.MjData, joints: JointMap, kit: RobotKit, posture: Posture) -> None:
        self._data, self._joints, self._kit, self._posture = data, joints, kit, posture
        self.maps: Mapping[str, ReachMap] = reach_maps(kit)
        self._per_arm = PerArmSolver(kit.model, kit.crouches)
        self._columns = {arm: kit.model.indices(kit.spec.arms[arm.value].joints) for arm in Arm}
        self._vias: dict[Arm, tuple[Array, ...]] = {}

    def under(self, posture: Posture) -> InverseKinematics:
        """The same solvers for another posture."""
        there = copy.copy(self)
        there._posture = posture
        return there

    def solve(
        self,
        arm: Arm,
        hand_target: HandPose,
        start: Array | None = None,
        pelvis_height_m: float | None = None,
        base: Stance | None = None,
        pointing_weight: float = 0.1,
        roll_weight: float = 0.1,
    ) -> ArmGoal:
        """Solves one arm for a hand pose in the world frame, with the waist straight and the other arm as commanded.

        An arm that is wound up or inside the robot's own body counts as far from its target.

        Args:
            arm: which one.
            hand_target: the hand pose, position and directions in the world frame.
            start: (A,) joints to start from; the best postures of the reach map when None.
            pelvis_height_m: pelvis height to solve for, the commanded one by default.
            base: base pose to solve for, the commanded one by default.
            pointing_weight: weight of the fingers' direction against the position.
            roll_weight: weight of the closing direction.
        """
        height = self._posture.pelvis_height_m if pelvis_height_m is None else pelvis_height_m
        lean = self._posture.lean(height)
        local = self._posture.target_in_pelvis(hand_target, height, base)
        reach_map = self.maps[arm.value]
        starts: Sequence[Array]
        if start is None:
            upright = HandPose(
                lean.T @ local.position,
                None if local.pointing is None else lean.T @ local.pointing,
                None if local.closing is None else lean.T @ local.closing,
                local.either_way,
            )
            starts = list(reach_map.starts(upright, 2, near=ready_posture(self._kit, arm)))
        else:
            starts = [start]
        best: tuple[float, ArmGoal] | None = None
        q = self._kit.model.posture()
        for other in Arm:
            q[self._columns[other]] = self._data.ctrl[self._joints.arms[other]]
        root = self._posture.root(height)
        site = (self._kit.spec.arms[arm.value].grasp_site,)
        for candidate in starts:
            q[self._columns[arm]] = candidate
            rotation = None
            if local.pointing is not None or local.closing is not None:
                hand = self._kit.model.frames(root, q, site)[0, :3, :3]
                rotation = local.rotation(hand[:, 0], hand[:, 1])
            target = ReachTarget(
                local.position,
                rotation,
                pointing_weight if local.pointing is not None else 0.0,
                roll_weight if local.closing is not None else 0.0,
            )
            result = self._per_arm.solve(
                {arm.value: target}, q, pelvis_height_m=height, restarts=0, tolerance_m=REACH_TOLERANCE_M
            )
            reached = self._kit.model.frames(root, result.q, site)[0, :3, :3]
            pointing = 1.0 if local.pointing is None else float(reached[:, 0] @ local.pointing)
            along = 1.0 if local.closing is None else float(reached[:, 1] @ local.closing)
            q_arm = result.q[self._columns[arm]].copy()
            wound = float(np.max(np.abs(q_arm - np.asarray(self._kit.spec.arms[arm.value].carry))[:-1]))
            sound = wound < WOUND_RAD + 0.3 and result.self_clearance_m >= -SELF_TOUCH_M
            goal = ArmGoal(
                q_arm,
                result.position_error_m if sound else 1.0,
                pointing,
                abs(along) if local.either_way else along,
                self._posture.turn_to_world(reached[:, 0]),
                self._posture.turn_to_world(reached[:, 1]),
            )
            cost = 20.0 * max(goal.error_m - 0.5 * REACH_TOLERANCE_M, 0.0) + 2.0 - goal.pointing_cos - goal.closing_cos
            if best is None or cost < best[0]:
                best = (cost, goal)
            if goal.error_m <= REACH_TOLERANCE_M and goal.pointing_cos > 0.9 and goal.closing_cos > 0.9:
                break
        assert best is not None
        return best[1]

    def solve_both(self, hand_targets: Mapping[Arm, HandPose], start: Mapping[Arm, Array] | None = None) -> BothGoal:
        """Solves both arms as one problem with the robot's own solver.

        Args:
            hand_targets: world hand poses; pointing and closing must be given.
            start: (A,) joints per arm to start from; the best postures of the reach maps when None.
        """
        height = self._posture.pelvis_height_m
        lean = self._posture.lean(height)
        q = self._commanded_joints()
        targets: dict[str, ReachTarget] = {}
        for arm, hand_target in hand_targets.items():
            local = self._posture.target_in_pelvis(hand_target, height)
            if local.pointing is None or local.closing is None:
                raise ValueError(f"both directions of the {arm} hand must be given, got {hand_target}")
            rotation = local.rotation(local.pointing, local.closing)
            targets[arm.value] = ReachTarget(local.position, rotation, 0.15, 0.08)
            upright = HandPose(lean.T @ local.position, lean.T @ local.pointing, lean.T @ local.closing)
            q[self._columns[arm]] = (
                self.maps[arm.value].starts(upright, 1, near=ready_posture(self._kit, arm))[0] if start is None else start[arm]
            )
        result = self._kit.solver.solve(targets, q, pelvis_height_m=height, restarts=1, tolerance_m=REACH_TOLERANCE_M)
        waist = self._kit.model.indices(self._kit.spec.waist_joints)
        arms = {arm: result.q[self._columns[arm]].copy() for arm in Arm}
        error = result.position_error_m if result.self_clearance_m >= -SELF_TOUCH_M else 1.0
        return BothGoal(arms, result.q[waist].copy(), error, result.rotation_error_rad)

    def hand_at(self, arm: Arm, q: Array) -> Array:
        """(3,) world position of the grasp site with an arm posture, from the commanded base."""
        return self.hand_pose_at(arm, q)[0]

    def hand_pose_at(self, arm: Arm, q: Array, base: Stance | None = None) -> tuple[Array, Array]:
        """World position (3,) and rotation (3, 3) of the grasp site with an arm posture.

        The base is the commanded one, or another that is turned like it.
        """
        full = self._kit.model.posture()
        full[self._columns[arm]] = q
        root = self._posture.root(self._posture.pelvis_height_m)
        base = self._posture.stance() if base is None else base
        frame = self._kit.model.frames(root, full, (self._kit.spec.arms[arm.value].grasp_site,))[0]
        position = self._posture.turn_to_world(frame[:3, 3]) + (base.x, base.y, self._posture.pelvis_height_m)
        return position, np.stack([self._posture.turn_to_world(axis) for axis in frame[:3, :3].T], axis=1)

    def hand_height(self, goal: BothGoal) -> float:
        """Mean height of both grasp sites in a posture, metres."""
        return float(np.mean([self.hand_at(arm, q)[2] for arm, q in goal.arms.items()]))

    def heights(self) -> list[float]:
        """A grid over the robot's pelvis heights, metres."""
        low, high = self._kit.spec.pelvis_height_range_m
        return [float(h) for h in np.linspace(low, high, max(2, int(np.ceil((high - low) / _HEIGHT_STEP_M)) + 1))]

    def within(self, arm: Arm, point: Array, pelvis_height_m: float, base: Stance | None = None) -> bool:
        """Whether a world point is within the arm's envelope at a pelvis height, from this stance or another one."""
        return self.maps[arm.value].contains(self._posture.in_trunk(point, pelvis_height_m, base))

    def vias(self, arm: Arm) -> tuple[Array, ...]:
        """(A,) postures that lead around furniture edges: ready, hand forward at shoulder height, hand above the shoulder."""
        if arm not in self._vias:
            reach_map = self.maps[arm.value]
            high = reach_map.shoulder + reach_map.reach_m * np.array([0.6, 0.0, -0.05])
            forward = reach_map.starts(HandPose(high, np.array([1.0, 0.0, 0.0])), 1, near=ready_posture(self._kit, arm))[0]
            self._vias[arm] = (ready_posture(self._kit, arm), forward, ready_posture(self._kit, arm, raised=True))
        return self._vias[arm]

    def _commanded_joints(self) -> Array:
        """(J,) commanded joints where there is an actuator, measured ones elsewhere."""
        q = self._data.qpos[self._joints.positions].copy()
        for column, name in enumerate(self._kit.spec.joints):
            if name in self._joints.actuators:
                q[column] = self._data.ctrl[self._joints.actuators[name]]
        return q
