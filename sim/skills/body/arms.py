"""Arms and waist: joint commands, and motions with bounded velocity and acceleration."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterable, Sequence
from typing import Final

import mujoco
import numpy as np
from numpy.typing import NDArray

from interface.bodies import Arm
from robots.build_solver import RobotKit
from sim.skills.body.clearance import ClearanceProbe
from sim.skills.body.hands import Hands
from sim.skills.body.ik import BothGoal, InverseKinematics
from sim.skills.body.joints import JointMap
from sim.skills.body.ready import ready_posture
from sim.skills.runner import CONTROL_DT_S, Skill
from sim.skills.trajectory import Trajectory, min_jerk, plan

Array = NDArray[np.float64]

#: Bounds of every arm joint at speed 1, rad/s and rad/s². Chosen by hand.
ARM_SPEED_RAD_S: Final = 3.8
ARM_ACCELERATION_RAD_S2: Final = 20.0
#: Bound of what a hand carries, m/s, at speed 1; servos that catch up add a quarter to it.
CARRYING_M_S: Final = 1.0
#: An arm that falls behind its way by more than this, rad, is waited for, for so many ticks. What it does not get past then
#: with something in the hand ends the motion: pushed on, it would come off at metres per second.
#: A load between both hands bends the arms by as much again, and more.
_BEHIND_RAD: Final = {1: 0.12, 2: 0.4}
_PATIENCE: Final = 50
_SAMPLES: Final = np.linspace(0.0, 1.0, 13)


class Arms:
    """Both arms and the waist of one robot."""

    def __init__(
        self, data: mujoco.MjData, joints: JointMap, kit: RobotKit, probe: ClearanceProbe, ik: InverseKinematics, hands: Hands
    ) -> None:
        self._data, self._joints, self._kit, self._probe, self._ik, self._hands = data, joints, kit, probe, ik, hands

    def commanded(self, arm: Arm) -> Array:
        """(A,) commanded arm joints."""
        return self._data.ctrl[self._joints.arms[arm]].copy()

    def commanded_both(self) -> dict[Arm, Array]:
        """Commanded joints of both arms."""
        return {arm: self.commanded(arm) for arm in Arm}

    def commanded_waist(self) -> Array:
        """Commanded waist joints."""
        return self._data.ctrl[self._joints.waist].copy()

    def off_rad(self, arm: Arm, q: Array) -> float:
        """How far the joints are from (A,) others, the farthest of them."""
        return float(np.max(np.abs(self._data.qpos[self._joints.arm_positions[arm]] - q)))

    def command(self, arm: Arm, q: Array) -> None:
        """Sets the arm joints' targets."""
        self._data.ctrl[self._joints.arms[arm]] = q

    def hold(self, arms: Iterable[Arm]) -> None:
        """Commands the joints of arms to where they are."""
        for arm in arms:
            self.command(arm, self._data.qpos[self._joints.arm_positions[arm]])

    def hand_pose(self, arm: Arm) -> tuple[Array, Array]:
        """Measured world position (3,) and rotation (3, 3) of the grasp site."""
        site = self._joints.grasp_sites[arm]
        return self._data.site_xpos[site].copy(), self._data.site_xmat[site].reshape(3, 3).copy()

    def move(self, arm: Arm, waypoints: Sequence[Array], speed: float = 1.0) -> Skill:
        """Moves the arm in joint space from its commanded posture through (A,) waypoints; `speed` scales the bounds."""
        ids = self._joints.arms[arm]
        for goal in waypoints:
            ends = np.stack([self._data.ctrl[ids].copy(), goal])
            least_s = self._least_s(arm, ends, speed)
            way = plan(ends, ARM_SPEED_RAD_S * speed, ARM_ACCELERATION_RAD_S2 * speed * speed, least_s)
            if (yield from self._follow(way, ids, arms=(arm,))):
                return

    def _least_s(self, arm: Arm, ends: Array, speed: float) -> float:
        """Duration below which what the hand carries would be too fast between two postures (2, A)."""
        name = self._hands.held[arm]
        if name is None:
            return 0.0
        position, hand = self.hand_pose(arm)
        load = hand.T @ (self._hands.place(name) - position)  # in the hand
        poses = [self._ik.hand_pose_at(arm, ends[0] + min_jerk(float(u)) * (ends[1] - ends[0])) for u in _SAMPLES]
        paths = np.stack([[place, place + turn @ load] for place, turn in poses])  # (S, 2, 3)
        return float(np.linalg.norm(np.diff(paths, axis=0), axis=-1).max()) / (_SAMPLES[1] * CARRYING_M_S * speed)

    def touch(self, arm: Arm, goal: Array, geoms: NDArray[np.int64], speed: float = 1.0) -> Skill:
        """Moves the arm to (A,) joints in joint space; stops when the hand touches one of the given geoms."""
        ids = self._joints.arms[arm]
        ends = np.stack([self._data.ctrl[ids].copy(), goal])
        way = plan(ends, ARM_SPEED_RAD_S * speed, ARM_ACCELERATION_RAD_S2 * speed * speed)
        yield from self._follow(way, ids, lead=False, stop=lambda: self._probe.hand_gap_m(arm, geoms) <= 0.0)

    def _follow(
        self,
        way: Trajectory,
        ids: NDArray[np.int64],
        lead: bool = True,
        stop: Callable[[], bool] = lambda: False,
        arms: Sequence[Arm] = (),
    ) -> Generator[None, None, bool]:
        """Tracks a trajectory with the servos; returns whether something holds up what the arms carry.

        They then rest where they are: bent against their servos, they would fling it when they come free.

        Args:
            way: of the joints.
            ids: the servos.
            lead: whether commands are ahead by what the servos lag behind, so that the joints are where the trajectory says.
            stop: asked before every tick; ends the motion.
            arms: those that move, whose joints come first; they are waited for where something holds them up.
        """
        time_s, waited = 0.0, 0
        joints = [self._joints.arm_positions[arm] for arm in arms]
        measured = np.concatenate(joints) if joints else np.zeros(0, dtype=np.int64)
        loaded = any(self._hands.held[arm] is not None for arm in arms)

        def off_rad(at_s: float) -> float:
            return float(np.max(np.abs(self._data.qpos[measured] - way.at(at_s)[: len(measured)]), initial=0.0))

        sag_rad = off_rad(0.0)
        while time_s < way.duration_s and not stop():
            if waited < _PATIENCE and off_rad(time_s) > sag_rad + _BEHIND_RAD.get(len(arms), np.inf):
                waited += 1
                if waited == _PATIENCE and loaded:
                    self.hold(arms)
                    return True
                self._data.ctrl[ids] = way.at(time_s)
                yield
                continue
            time_s += CONTROL_DT_S
            target = way.at(time_s)
            if lead and time_s < way.duration_s:
                rate = (way.at(time_s + 0.5 * CONTROL_DT_S) - way.at(time_s - 0.5 * CONTROL_DT_S)) / CONTROL_DT_S
                target = target + self._joints.lag_s[ids] * rate
            self._data.ctrl[ids] = target
            yield
        return False

    def move_both(self, goals: Sequence[BothGoal], speed: float = 1.0) -> Skill:
        """Moves both arms and the waist together in joint space through a sequence of goals."""
        ids = np.concatenate([self._joints.arms[Arm.LEFT], self._joints.arms[Arm.RIGHT], self._joints.waist])
        for goal in goals:
            row = np.concatenate([goal.arms[Arm.LEFT], goal.arms[Arm.RIGHT], goal.waist])
            ends = np.stack([self._data.ctrl[ids].copy(), row])
            way = plan(ends, ARM_SPEED_RAD_S * speed, ARM_ACCELERATION_RAD_S2 * speed**2)
            if (yield from self._follow(way, ids, arms=(Arm.LEFT, Arm.RIGHT))):
                return

    def ready_both(self) -> BothGoal:
        """Both arms in their ready postures, waist straight."""
        return BothGoal({arm: ready_posture(self._kit, arm) for arm in Arm}, np.zeros(len(self._joints.waist)), 0.0)

    def stow_both(self) -> Skill:
        """Both arms to their ready postures, waist straight."""
        yield from self.move_both([self.ready_both()])
