"""Asks, without moving anything, from which stance and pelvis height an arm action would be tried.

The robot is put there kinematically on the live world, the simulator's own reach test is asked, and the world is restored
exactly. Privileged: only the expert uses it. Paper: none; it keeps the expert's plans short.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Final

import mujoco
import numpy as np

from interface.steps import Action, PlanStep
from sim.session.session import Session
from sim.skills.locomotion import best_stance
from sim.skills.navigation import Stance
from sim.skills.registry import assess_action

#: Grid of the expert's height changes.
HEIGHT_STEP_M: Final = 0.05
_HEIGHTS: Final = 3
#: Heights and choices of arms for two actions at once that are thought through at one stance.
_TOGETHER: Final = 3
#: How far a door or a drawer is imagined open.
_PULLED_OPEN: Final = 0.95


class Lookahead:
    """Questions to one session."""

    def __init__(self, session: Session) -> None:
        """Attaches to a session."""
        self._session = session

    def stance_of(self, action: Action) -> Stance | None:
        """Where GoTo would end, None when it would be refused."""
        body = self._session.body
        assert action.object_id is not None
        bearing = np.deg2rad(action.bearing_deg) if action.bearing_deg is not None else 0.0
        found = best_stance(
            body.workspace.navigation(),
            body.posture.stance(),
            body.objects.interaction_point(action.object_id)[:2],
            body.workspace.comfortable_distance_m(),
            action.amount,
            bearing,
            body.objects.faces_rad(action.object_id),
            body.fits,
        )
        return None if found is None else found[0]

    def works(self, actions: Sequence[Action], stance: Stance) -> bool:
        """Whether one of the actions would be tried from a stance, at the present pelvis height or another one.

        Args:
            actions: the same action for different arms.
            stance: where the robot would stand.
        """
        height = self._session.body.posture.pelvis_height_m
        with self._in_thought():
            for candidate in self._heights(actions, stance, height):
                self._put(stance, candidate)
                if any(self._session.assess(action, diagnose=False) is None for action in actions):
                    return True
        return False

    def works_together(self, pairs: Sequence[tuple[Action, Action]], stance: Stance) -> bool:
        """Whether two actions would both be tried from a stance at some height, for one of some choices of arms."""
        with self._in_thought():
            hopeful = [(h, pair) for h in self.heights_m() for pair in pairs if all(self._within(a, stance, h) for a in pair)]
            for height, pair in hopeful[:_TOGETHER]:
                self._put(stance, height)
                if all(self._session.assess(action, diagnose=False) is None for action in pair):
                    return True
        return False

    def succeeds(self, step: PlanStep) -> bool:
        """Whether a step taken here and now goes well, contingencies apart: it is acted out and undone."""
        with self._session.imagining():
            return self._session.act(step, diagnose=False).success

    @contextmanager
    def _in_thought(self) -> Iterator[None]:
        """What is moved inside is where it was at the end."""
        world = self._session.world
        saved = world.save()
        try:
            yield
        finally:
            world.restore(saved)

    def _within(self, action: Action, stance: Stance, height_m: float) -> bool:
        """Whether an action's object is within the arm's envelope; where something is put is not known yet."""
        body = self._session.body
        if action.name == "Place" or action.arm is None or action.object_id is None:
            return True
        self._put(stance, body.posture.pelvis_height_m)
        return body.ik.within(action.arm, body.objects.interaction_point(action.object_id), height_m)

    def might_lead_to(self, first: Action, then: Action, stance: Stance, height_m: float) -> bool:
        """Whether it is worth acting out an action, to see whether it leads to another one; asks kinematics only.

        Args:
            first: has to be possible from there; if it opens a door or a drawer, that stands open for `then`.
            then: has to be possible after it, as far as that can be told.
            stance: where the robot would stand.
            height_m: pelvis height.
        """
        with self._in_thought():
            self._put(stance, height_m)
            if self._session.assess(first, diagnose=False) is not None:
                return False
            if first.name != "Open" or first.object_id is None:
                return True
            self._pull_open(first.object_id)
            known = {*self._session.known_objects, first.object_id, then.object_id or first.object_id}
            return assess_action(self._session.body.assuming(diagnose=False), then, frozenset(known)) is None

    def _pull_open(self, object_id: str) -> None:
        """Puts a door or a drawer wide open; what lies in a drawer comes along."""
        world = self._session.world
        obj, contents = world.objects[object_id], world.containment.contents(object_id)
        for part in obj.moving:
            frame = world.data.xpos[world.model.jnt_bodyid[part.joint_id]]
            before = frame.copy()
            world.data.qpos[part.qpos_adr] = part.range[0] + _PULLED_OPEN * (part.range[1] - part.range[0])
            mujoco.mj_kinematics(world.model, world.data)
            for name in contents:
                address = world.objects[name].qpos_adr
                world.data.qpos[address : address + 3] += frame - before
        obj.openness = _PULLED_OPEN
        mujoco.mj_kinematics(world.model, world.data)

    def leads_to(self, first: Action, then: Action, stance: Stance | None = None, height_m: float | None = None) -> bool:
        """Whether an action would be tried after another one has been acted out.

        Args:
            first: acted out in physics; undone afterwards.
            then: only asked for.
            stance: where the robot would stand, here when None.
            height_m: pelvis height, the present one when None.
        """
        session = self._session
        with session.imagining():
            if stance is not None or height_m is not None:
                base = session.body.posture.stance() if stance is None else stance
                self._put(base, session.body.posture.pelvis_height_m if height_m is None else height_m)
            if session.assess(first, diagnose=False) is not None:
                return False
            # it also looks: what was shut away is known afterwards
            _, feedback = session.step(PlanStep((first,)), diagnose=False)
            return feedback.outcomes[0].success and session.assess(then, diagnose=False) is None

    def heights_m(self) -> list[float]:
        """Pelvis heights worth trying, the present one first, then the nearest."""
        low, high = self._session.body.spec.pelvis_height_range_m
        present = self._session.body.posture.pelvis_height_m
        grid = [present + step * HEIGHT_STEP_M for step in (0, 1, -1, 2, -2, 4, -4, 6, -6, 8, -8)]
        return [height for height in grid if low - 0.001 <= height <= high + 0.001]

    def _heights(self, actions: Sequence[Action], stance: Stance, present_m: float) -> list[float]:
        """The present height and the nearest ones at which the target is within the arms' envelope."""
        body = self._session.body
        low, high = body.spec.pelvis_height_range_m
        steps = sorted(range(-8, 9), key=lambda step: (abs(step), step))
        grid = [present_m + step * HEIGHT_STEP_M for step in steps]
        grid = [height for height in grid if low - 0.001 <= height <= high + 0.001]
        first = actions[0]
        assert first.object_id is not None
        if first.arm is None or first.name == "Place":
            return grid[:_HEIGHTS]
        point = body.objects.interaction_point(first.object_id)
        self._put(stance, present_m)
        within = [h for h in grid if any(a.arm is not None and body.ik.within(a.arm, point, h) for a in actions)]
        return within[:_HEIGHTS]

    def _put(self, stance: Stance, height_m: float) -> None:
        """Moves robot and load rigidly; the legs follow the height."""
        self._session.world.grasps.put_base(stance.x, stance.y, stance.yaw_rad, height_m)
