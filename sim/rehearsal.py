"""Asks, without moving anything, whether an arm action would be tried from another stance or at another pelvis height.

The robot is put there kinematically on the live world, the simulator's own reach test is asked, and the world is restored
exactly.
Privileged: only the expert uses it. Paper: none; it makes the feasibility certificates of tasks cheap.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

import mujoco
import numpy as np

from data.records import Action, Arm
from sim.failures import FailureCode, SkillFailure
from sim.navigation import Stance, wrap_angle
from sim.session import Session
from sim.skills.locomotion import best_stance
from sim.tasks.jobs import Job

__all__ = ["HEIGHT_STEP_M", "Place", "Rehearsal"]

HEIGHT_STEP_M: Final = 0.05
_MAX_HEIGHTS: Final = 5
_NEAR_M: Final = 0.03
_NEAR_RAD: Final = np.deg2rad(4.0)


@dataclass(frozen=True, slots=True)
class Place:
    """Where the robot stands and how high its pelvis is."""

    stance: Stance
    height_m: float

    def near(self, other: Place) -> bool:
        """Whether two places differ by less than the servos' and the grid's tolerance."""
        gap = float(np.linalg.norm(self.stance.position - other.stance.position))
        turn = abs(wrap_angle(self.stance.yaw_rad - other.stance.yaw_rad))
        return gap < _NEAR_M and turn < _NEAR_RAD and abs(self.height_m - other.height_m) < 0.5 * HEIGHT_STEP_M


class Rehearsal:
    """Questions to one session."""

    def __init__(self, session: Session) -> None:
        self._session = session

    def here(self) -> Place:
        """Where the robot is."""
        body = self._session.body
        return Place(body.commanded_base(), body.pelvis_height_m)

    def is_here(self, stance: Stance) -> bool:
        """Whether the robot already stands there."""
        here = self.here()
        return Place(stance, here.height_m).near(here)

    def stance_of(self, action: Action) -> Stance | None:
        """Where GoTo would end, None when it would be refused."""
        body = self._session.body
        assert action.object_id is not None
        bearing = np.deg2rad(action.bearing_deg) if action.bearing_deg is not None else 0.0
        found = best_stance(
            body.navigation(),
            body.commanded_base(),
            body.interaction_point(action.object_id)[:2],
            body.comfortable_distance_m(),
            action.amount,
            bearing,
            body.faces_rad(action.object_id),
        )
        return None if found is None else found[0]

    def height_for(
        self,
        job: Job,
        arms: Sequence[Arm | None],
        stance: Stance | None,
        failed: Callable[[Action, Place], bool],
    ) -> float | None:
        """The pelvis height nearest to the present one at which some arm would do the job.

        Args:
            job: what is to be done.
            arms: arms that may do it.
            stance: from where; None is here.
            failed: whether an action is known to fail from a place.

        Returns:
            A height on the grid of changes from the present one, None when there is none.
        """
        here = self.here()
        where = here.stance if stance is None else stance
        saved = self._session.world.save()
        queue, tried = [0], set[int]()
        try:
            while queue and len(tried) < _MAX_HEIGHTS:
                steps = queue.pop(0)
                height = self._height(here.height_m, steps)
                if height is None or steps in tried:
                    continue
                tried.add(steps)
                place = Place(where, height)
                self._put(place)
                hints: list[int] = []
                for arm in arms:
                    action = job.action(arm)
                    verdict = None if failed(action, place) else self._session.assess(action)
                    if verdict is None and not failed(action, place):
                        return height
                    hints += self._hints(verdict, steps)
                queue = hints + queue
        finally:
            self._session.world.restore(saved)
        return None

    @staticmethod
    def _hints(verdict: SkillFailure | None, steps: int) -> list[int]:
        """Heights worth trying after a refusal, as steps of change from the present one."""
        if verdict is not None and verdict.code is FailureCode.TOO_FAR:
            return []
        if verdict is not None and "height_m" in verdict.margins:
            change = verdict.margins["height_m"] / HEIGHT_STEP_M
            first = steps + int(np.sign(change) * np.ceil(abs(change) - 1e-6))
            return [first, first + int(np.sign(change))]
        return [steps - 1, steps + 1, steps - 2, steps + 2]

    def _height(self, present_m: float, steps: int) -> float | None:
        """The height that so many steps of MoveUp (positive) or MoveDown lead to, None beyond the legs' range."""
        low, high = self._session.body.spec.pelvis_height_range_m
        height = present_m + steps * HEIGHT_STEP_M
        return float(np.clip(height, low, high)) if low - 0.004 <= height <= high + 0.004 else None

    def _put(self, place: Place) -> None:
        """Moves robot and load rigidly; the legs follow the height."""
        world, body = self._session.world, self._session.body
        model, data = world.model, world.data
        names = {arm: world.held(arm.value) for arm in Arm}
        loads = {name: arm for arm, name in names.items() if name is not None and world.objects[name].movable}
        hands = {arm: world.grasp_pose(arm.value) for arm in loads.values()}
        poses = {name: world.pose(name) for name in loads}
        body.command_base(place.stance.x, place.stance.y, place.stance.yaw_rad)
        body.command_height(place.height_m)
        for joint in (*body.spec.leg_joints, "base_x", "base_y", "base_z", "base_yaw", "base_pitch"):
            data.qpos[model.joint(joint).qposadr[0]] = data.ctrl[model.actuator(joint).id]
        mujoco.mj_kinematics(model, data)
        for name, arm in loads.items():
            pose = world.grasp_pose(arm.value) @ np.linalg.inv(hands[arm]) @ poses[name]
            adr = world.objects[name].qpos_adr
            data.qpos[adr : adr + 3] = pose[:3, 3]
            mujoco.mju_mat2Quat(data.qpos[adr + 3 : adr + 7], pose[:3, :3].ravel())
        mujoco.mj_kinematics(model, data)
