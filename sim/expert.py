"""The privileged expert: a planner that may look at the simulator's state. It certifies tasks and gives demonstrations.

What comes next follows from goals and object states (`sim.tasks.jobs`); where to stand and how low follows from a trial of the
arm action on the simulator's own reach test, without moving anything (`sim.rehearsal`). The style is canonical on purpose, so
that a small model can imitate it: GoTo, then MoveDown or MoveUp where the arm needs it, then the arm action, on both arms
at once where both can reach. The expert re-plans from the current state at every step, so failures and perturbations need no
special case. It is marked privileged in every table; learned planners never see what it sees.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from data.records import Action, Arm, PlanStep
from sim.failures import FailureCode, SkillFailure
from sim.navigation import wrap_angle
from sim.rehearsal import HEIGHT_STEP_M, Place, Rehearsal
from sim.session import Session
from sim.tasks.jobs import Facts, Job, plan_jobs
from sim.tasks.predicates import Predicate

__all__ = ["Expert"]

#: Distances (m) and bearings (deg) that GoTo tries in turn when its own choice of stance does not serve.
_STANCES: Final[tuple[tuple[float | None, float | None], ...]] = (
    (None, None), (0.5, None), (0.4, None), (0.6, None), (None, 20.0), (None, -20.0), (0.5, 30.0), (0.5, -30.0), (0.7, None),
)  # fmt: skip
_PATIENCE: Final = 4
#: Stances that are tried in thought before the first walk; more before the next ones.
_REHEARSED: Final = 4
#: Objects lower than this lie on the floor.
_FLOOR_M: Final = 0.35
_TURN_STEP_DEG: Final = 15.0
#: Names of actions that change the stance.
_MOVES: Final = ("GoTo", "Move", "Rotate")
#: Codes of failures that the physics, not bad luck, decided.
_FRUITLESS: Final = tuple(
    code.value
    for code in (
        FailureCode.GRASP_MISSED,
        FailureCode.DROPPED,
        FailureCode.HANDLE_SLIPPED,
        FailureCode.PLACE_MISSED,
        FailureCode.OBSTRUCTED,
    )
)
_WRONG_HEIGHT: Final = (FailureCode.BODY_TOO_HIGH, FailureCode.BODY_TOO_LOW)


class Expert:
    """Plans one step at a time for a session.

    Attributes:
        privileged: always True; tables mark the planner with it.
    """

    privileged: Final = True

    def __init__(self, session: Session) -> None:
        """Attaches to a session that has been reset with a task."""
        self._session = session
        self._attempts: dict[str, int] = {}
        self._fruitless: list[tuple[str, Place]] = []
        self._rehearsal = Rehearsal(session)
        self._homes: dict[str, str] = {}

    def reset(self) -> None:
        """Forgets earlier attempts; call after the session's reset."""
        self._attempts.clear()
        self._fruitless.clear()
        self._homes = {placement.object_id: placement.receptacle for placement in self._session.task.placements or ()}

    @property
    def _goals(self) -> list[Predicate]:
        return [goal for goal in self._session.task.goals if isinstance(goal, Predicate)]

    def facts(self) -> Facts:
        """What the planner reads from the simulator."""
        session = self._session
        objects = {entry["objectId"]: entry for entry in session.world.metadata()["objects"]}
        body = session.body
        two_handed = frozenset(name for name in session.world.objects if session.world.needs_two_hands(name))
        held = {arm: body.held[arm] for arm in Arm}
        return Facts(objects, held, body.lifted, two_handed, self._homes)

    def next_step(self) -> PlanStep:
        """The step to take from the current state; Done when every goal holds."""
        facts = self.facts()
        jobs = plan_jobs(self._goals, facts)
        if not jobs:
            return _single(Action("Done"))
        self._learn()
        head = jobs[0]
        if self._lost(head, facts):
            return _single(Action("Done"))
        verdicts: list[SkillFailure | None] = []
        for arm in self._arms(head, facts):
            action = head.action(arm)
            verdict = self._session.assess(action)
            verdicts.append(verdict)
            if verdict is not None:
                self._fruitless.append((action.to_text(), self._rehearsal.here()))
            elif not self._failed_at(action, self._rehearsal.here()):
                return self._with_companion(head, arm, jobs[1:], facts)
        return _single(self._approach(head, verdicts, facts))

    def _lost(self, job: Job, facts: Facts) -> bool:
        """Whether the job's object lies on the floor, where neither robot reaches, or is broken."""
        entry = facts.objects[job.target]
        if not self._session.world.objects[job.target].movable or entry["isPickedUp"]:
            return False
        return bool(entry["isBroken"]) or (not entry["parentReceptacles"] and entry["center"]["z"] < _FLOOR_M)

    def _learn(self) -> None:
        """Remembers what failed in the physics from where: trying it again from there would fail again."""
        history = self._session.history
        if not history:
            return
        for outcome in history[-1].feedback.split("; "):
            text, _, code = outcome.rpartition(" ")
            if code in _FRUITLESS:
                self._fruitless.append((text, self._rehearsal.here()))
            elif code == "ok" and not text.startswith(_MOVES):
                self._attempts.clear()
                self._fruitless.clear()

    def _failed_at(self, action: Action, place: Place) -> bool:
        """Whether the action has already failed in the physics from (about) there."""
        text = action.to_text()
        return any(text == other and place.near(there) for other, there in self._fruitless)

    def step(self, observation: object = None, feedback: object = None) -> PlanStep:
        """The planner interface; what it is shown does not matter to it."""
        return self.next_step()

    def _arms(self, job: Job, facts: Facts) -> tuple[Arm | None, ...]:
        """Arms that may do the job, preferred one first: the one on the target's side, the right one straight ahead."""
        if job.arm is not None:
            return (job.arm,)
        if job.verb in ("Lift", "PlaceBoth"):
            return (None,)
        free = facts.free_arms()
        if len(free) == 2 and self._bearing_rad(job.target) > np.deg2rad(8.0):
            return (Arm.LEFT, Arm.RIGHT)
        return free

    def _with_companion(self, head: Job, arm: Arm | None, others: Sequence[Job], facts: Facts) -> PlanStep:
        """The step for `head`, with a job for the other arm beside it where that is possible right now."""
        if arm is None:
            return _single(head.action(None))
        for job in others:
            pairs = [(arm, arm.other)]
            if head.arm is None and job.arm is None and len(facts.free_arms()) == 2:
                pairs.append((arm.other, arm))
                if self._bearing_rad(head.target) < self._bearing_rad(job.target) and arm is Arm.LEFT:
                    pairs.reverse()
            for mine, other in pairs:
                if job.verb in ("Lift", "PlaceBoth") or job.arm not in (None, other) or head.arm not in (None, mine):
                    continue
                if job.arm is None and other not in facts.free_arms():
                    continue
                first, second = head.action(mine), job.action(other)
                if all(self._session.assess(action) is None for action in (first, second)):
                    return PlanStep((first, second))
        return _single(head.action(arm))

    def _approach(self, job: Job, verdicts: Sequence[SkillFailure | None], facts: Facts) -> Action:
        """The body action that brings an unreachable target into reach."""
        target, known = job.target, self._session.known_objects
        if target not in known:
            carrier = next((c for c in facts.objects[target]["parentReceptacles"] or () if c in known), None)
            attempt = self._attempts.get(f"find {target}", 0)
            self._attempts[f"find {target}"] = attempt + 1
            if attempt == 0 and carrier is not None:
                return Action("GoTo", object_id=carrier)
            return self._look_for(target, attempt)
        arms = self._arms(job, facts)
        wrong = next((v for v in verdicts if v is not None and v.code in _WRONG_HEIGHT), None)
        if wrong is not None or None in verdicts:
            height = self._rehearsal.height_for(job, arms, None, self._failed_at)
            if height is not None:
                return self._height_change(height - self._session.body.pelvis_height_m)
        attempt = self._attempts.get(target, 0)
        self._attempts[target] = attempt + 1
        if attempt > _PATIENCE:
            return Action("Done")
        for distance, bearing in _STANCES[: _REHEARSED * (attempt + 1)]:
            action = Action("GoTo", object_id=target, amount=distance, bearing_deg=bearing)
            stance = self._rehearsal.stance_of(action)
            if stance is None or (attempt and self._rehearsal.is_here(stance)):
                continue
            if self._rehearsal.height_for(job, arms, stance, self._failed_at) is not None:
                return action
        distance, bearing = _STANCES[attempt % len(_STANCES)]
        return Action("GoTo", object_id=target, amount=distance, bearing_deg=bearing)

    def _look_for(self, target: str, attempt: int) -> Action:
        """Turns towards an object that is near but not yet seen; backs off when it should be in view already."""
        bearing_deg = float(np.rad2deg(self._bearing_rad(target)))
        if abs(bearing_deg) > 10.0 and attempt % 2 == 1:
            amount = float(np.clip(round(abs(bearing_deg) / _TURN_STEP_DEG), 1, 12)) * _TURN_STEP_DEG
            return Action("RotateLeft" if bearing_deg > 0 else "RotateRight", amount=amount)
        return Action("MoveBack", amount=0.3) if attempt % 3 else Action("MoveDown", amount=0.2)

    def _height_change(self, height_m: float) -> Action:
        """The change of pelvis height on the grid."""
        steps = max(1, round(abs(height_m) / HEIGHT_STEP_M))
        return Action("MoveUp" if height_m > 0 else "MoveDown", amount=round(steps * HEIGHT_STEP_M, 2))

    def _bearing_rad(self, object_id: str) -> float:
        base = self._session.body.base()
        delta = self._session.body.world_position(object_id)[:2] - base.position
        return wrap_angle(float(np.arctan2(delta[1], delta[0])) - base.yaw_rad)


def _single(action: Action) -> PlanStep:
    return PlanStep((action,))
