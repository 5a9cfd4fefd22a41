"""A reference planner of rules: it reads the instruction's words and the feedback's codes, and learns nothing.

It sees what every planner sees and uses of that the words, the names and the history; neither picture nor joints. What comes
next is in `jobs`; here is how it is done: find what has not been seen, walk to it, try, and answer each failure code with the
change that its meaning suggests. When a stance does not serve, the next one is tried; what fails too often is given up.

Paper: not in its tables; added as a reference between random actions and learned planners.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Final

import numpy as np

from interface.actions import ACTIONS, ActionKind
from interface.belief import ARM_SPECIFIC, Belief
from interface.bodies import Arm
from interface.effects import Grasp
from interface.failures import FailureCode
from interface.feedback import Feedback
from interface.observation import Observation
from interface.sightings import Seen
from interface.steps import Action, PlanStep
from proprio_mllm.planners.protocol import PlannerReply, TaskInfo
from proprio_mllm.planners.scripted.instruction import TOOLS, Goal, read_goals
from proprio_mllm.planners.scripted.jobs import Job, Want, next_jobs
from proprio_mllm.planners.scripted.memory import Memory
from proprio_mllm.planners.scripted.words import Mention

#: Distances (m) and bearings (deg) of the stances that are tried in turn.
_STANCES: Final[tuple[tuple[float | None, float | None], ...]] = (
    (None, None), (None, -20.0), (None, 20.0), (0.5, None), (0.4, None), (0.6, None), (0.5, -30.0), (0.5, 30.0),
    (None, -40.0), (None, 40.0), (0.7, None), (0.5, -60.0), (0.5, 60.0), (0.7, -30.0), (0.7, 30.0),
)  # fmt: skip
#: Changes of pelvis height (m) that are tried in turn at one stance; a change back is half of that.
_RISES_M: Final = (0.1, 0.15, 0.15)
#: Ways out when a walk is blocked, in turn.
_ASIDE: Final = (("MoveBack", 0.3), ("MoveBack", 0.15), ("MoveRight", 0.25), ("MoveLeft", 0.25))
_ASIDE_NAMES: Final = ("MoveBack", "MoveRight", "MoveLeft")
#: Failures of one action after which it is given up.
_PATIENCE: Final = 16
#: Codes after which the same thing may work when it is tried again.
_BY_CHANCE: Final = (FailureCode.NOTHING_HAPPENED, FailureCode.LOCKED, FailureCode.SLIPPED, FailureCode.SPILLED)
#: Codes that a better knowledge of the world answers: what comes next is another job.
_KNOWLEDGE: Final = (
    FailureCode.ALREADY_IN_STATE,
    FailureCode.NOT_DIRTY,
    FailureCode.HAND_OCCUPIED,
    FailureCode.HAND_EMPTY,
    FailureCode.NEEDS_TWO_HANDS,
    FailureCode.NOT_LIFTABLE,
    FailureCode.RECEPTACLE_CLOSED,
    FailureCode.NEEDS_STEADYING,
    FailureCode.SOURCE_OFF,
    FailureCode.ALREADY_HELD,
    FailureCode.IN_USE,
)
#: Codes that another height of the pelvis may answer.
_HEIGHT: Final = (FailureCode.BODY_TOO_HIGH, FailureCode.BODY_TOO_LOW)
_WITH_OBJECT: Final = ("Pick", "ToggleOn", "ToggleOff", "Open", "Place")


class ScriptedPlanner:
    """Rules over words and feedback codes.

    Args:
        image_size: side of the head view it is shown and ignores, pixels.
    """

    privileged = False

    def __init__(self, image_size: int = 112) -> None:
        self.image_size = image_size
        self._memory = Memory()
        self._goals: tuple[Goal, ...] | None = None

    def reset(self, task: TaskInfo, rng: np.random.Generator) -> None:
        """Forgets the last episode; nothing is drawn."""
        self._memory = Memory()
        self._goals = None

    def step(self, observation: Observation, feedback: Feedback | None) -> PlannerReply:
        """The next step of the rules; what happened before is in the observation's history."""
        started = time.perf_counter()
        step, _ = self.decide(observation)
        return PlannerReply(step.to_text(), step, latency_s=time.perf_counter() - started)

    def decide(self, seen: Seen) -> tuple[PlanStep, Job | None]:
        """The next step, and the job that it serves; None when nothing is left that can be done."""
        if self._goals is None:
            self._goals = read_goals(seen.instruction, seen.known_objects)
        memory = self._memory
        memory.seen.known = seen.known_objects  # names are looked up before the log is read
        doors = [memory.find(goal.obj) for goal in self._goals if goal.ajar]
        memory.seen.look(seen, [door for door in doors if door is not None])
        belief = memory.belief
        jobs = next_jobs(self._wants(belief), belief, seen.known_objects)
        jobs = [job for job in jobs if not self._given_up(job, belief)]
        if not jobs:
            return PlanStep((Action("Done"),)), None
        step = self._towards(jobs, belief, seen)
        door = belief.holds_furniture()
        if door is not None and step.actions[0].spec.kind is ActionKind.BODY:  # a hand at a door keeps the robot where it is
            step = PlanStep((Action("Release", arm=door),))
        return step, None if step.actions[0].name == "Done" else jobs[0]

    def _towards(self, jobs: Sequence[Job], belief: Belief, seen: Seen) -> PlanStep:
        """The step that brings the first job forward."""
        head = jobs[0]
        freed = self._get_free(belief)
        if freed is not None:
            return PlanStep((freed,))
        if head.target is None:
            return PlanStep((self._memory.search(head.spoken),))
        if head.target == "":
            return PlanStep((head.action(head.arm),))
        steadied = belief.state.arm_with(head.target) if head.target in belief.state.in_place else None
        if steadied is not None and ACTIONS[head.verb].has_effect(Grasp):
            return PlanStep((Action("Release", arm=steadied),))
        moved = self._approach(head, belief)
        if moved is not None:
            return PlanStep((moved,))
        return self._act(head, jobs[1:], belief, seen)

    # ---- goals

    def _wants(self, belief: Belief) -> list[Want]:
        """The goals with ids; of several any, as many as are meant."""
        wants: list[Want] = []
        assert self._goals is not None
        on = {goal.obj for goal in self._goals if goal.kind == "on"}
        for goal in self._goals:
            if goal.kind == "filled" and goal.obj in on and goal.tool is None and goal.place is None:
                continue  # it is full, and only has to stay so
            tool = goal.tool or (Mention(TOOLS[goal.kind][0]) if goal.kind in TOOLS else None)
            place = None if goal.place is None else self._memory.find(goal.place)
            for index in range(goal.obj.count):
                obj = self._memory.find(goal.obj, index)
                source = None if goal.obj.place is None else self._memory.find(goal.obj.place)
                tool_id = None if tool is None else self._memory.find(tool)
                wants.append(Want(goal.kind, obj, place, tool_id, goal.obj, tool, source))
                if goal.place is not None and place is None:
                    wants[-1] = Want("held", None, None, None, goal.place, None, None)  # the place has to be found first
        broken = [want for want in wants if want.obj in belief.broken]
        return [want for want in wants if want not in broken]

    def _given_up(self, job: Job, belief: Belief) -> bool:
        failed = [event for event in belief.failures(job.verb, job.target) if event.code not in _BY_CHANCE]
        return (job.verb, job.target or "") in belief.never or len(failed) >= _PATIENCE

    # ---- the body

    def _get_free(self, belief: Belief) -> Action | None:
        """A step aside when a way is blocked, a rise of what both hands carry; None when nothing is in the way."""
        if belief.state.lifted is not None and belief.lowered_m > 0.02 and not belief.at_limit and self._just("Lift", belief):
            return Action("MoveUp", amount=max(0.05, round(min(1.0, belief.lowered_m) / 0.05) * 0.05))
        if not belief.last or belief.last[0].code != FailureCode.BLOCKED_PATH:
            return None
        walking = belief.last[0].action.name == "GoTo"
        if belief.state.lifted is not None and belief.blocked == 1:
            return Action("MoveUp", amount=_RISES_M[1])
        if walking and belief.blocked == 1:
            return None  # another stance may do
        name, amount = _ASIDE[(belief.blocked - 1) % len(_ASIDE)]
        return Action(name, amount=amount)

    @staticmethod
    def _just(verb: str, belief: Belief) -> bool:
        return any(event.ok and event.action.name == verb for event in belief.last)

    def _approach(self, job: Job, belief: Belief) -> Action | None:
        """The body action that has to come before a job; None when it can be tried from here."""
        target = job.target
        assert target is not None
        failed = belief.failures(job.verb, target)
        last = next((event for event in belief.last if event.about(job.verb, target) and not event.ok), None)
        if last is None:
            return self._walk(job, belief, failed=bool(failed))
        if last.code in _HEIGHT:
            return self._height(job, belief, up=last.code == FailureCode.BODY_TOO_LOW)
        if last.code in _BY_CHANCE:
            return None  # nothing has to change
        if last.code in _KNOWLEDGE:
            return self._walk(job, belief, failed=False)
        if (
            last.code == FailureCode.OBSTRUCTED
            and job.verb.startswith("Place")
            and not belief.heights
            and True not in belief.at_limit
        ):
            return Action("MoveUp", amount=_RISES_M[0])  # over the edge
        if last.code in ARM_SPECIFIC and last.action.arm is not None and job.arm is None:
            arms = {event.action.arm for event in failed if event.code in ARM_SPECIFIC}
            if len(arms) == 1 and len(belief.state.free_arms()) == 2:
                return None  # the other arm may
        return self._stance(job, belief)

    def _walk(self, job: Job, belief: Belief, failed: bool) -> Action | None:
        """Goes to a job's target, unless the robot is there or has just gone there as well as it can."""
        events = belief.last
        if events and events[0].about("GoTo", job.target) and not events[0].ok:
            return self._stance(job, belief)
        if events and events[0].action.name == "Release" and belief.let_shut.get(job.target or "") and job.verb != "Close":
            return self._stance(job, belief)
        if events and events[0].action.name in _ASIDE_NAMES:
            return Action("GoTo", object_id=job.target)
        near = belief.state.here == job.target if job.verb == "Lift" else self._memory.is_near(job.target or "", job.place)
        if not failed and job.target in belief.too_far:
            near = False
        return None if failed or near else Action("GoTo", object_id=job.target)

    def _height(self, job: Job, belief: Belief, up: bool) -> Action:
        """A change of pelvis height; after some at one stance, another stance."""
        done = belief.heights
        if len(done) >= len(_RISES_M) or up in belief.at_limit:
            return self._stance(job, belief)
        turned = any((rise > 0) != up for rise in done)
        amount = 0.05 if turned else _RISES_M[len(done)]
        return Action("MoveUp" if up else "MoveDown", amount=amount)

    def _stance(self, job: Job, belief: Belief) -> Action:
        target = job.target
        assert target is not None
        tried = belief.stances.get(target, 0) + belief.let_shut.get(target, 0)
        distance, bearing = _STANCES[tried % len(_STANCES)]
        return Action("GoTo", object_id=target, amount=distance, bearing_deg=bearing)

    # ---- the arms

    def _act(self, head: Job, others: Sequence[Job], belief: Belief, seen: Seen) -> PlanStep:
        """The head job, with one for the other arm beside it where both may be done from here."""
        if ACTIONS[head.verb].kind is not ActionKind.ARM:
            return PlanStep((head.action(None),))
        arm = head.arm or self._arm(head, belief)
        first = head.action(arm)
        for job in others:
            if job.target in (None, "") or job.verb not in _WITH_OBJECT or head.verb not in _WITH_OBJECT:
                continue
            if job.arm is arm or (job.arm is None and arm.other not in belief.state.free_arms()):
                continue
            if job.target == head.target and not head.verb == job.verb == "Place":
                continue
            in_view = job.target in seen.visible_objects or self._memory.is_near(job.target or "", job.place)
            if in_view and all(event.code in _HEIGHT for event in belief.failures(job.verb, job.target)):
                return PlanStep((first, job.action(arm.other)))
        return PlanStep((first,))

    def _arm(self, job: Job, belief: Belief) -> Arm:
        """The free arm on the side where the target should be; the other one after a failure that an arm can be blamed for."""
        free = belief.state.free_arms() or (Arm.RIGHT,)
        side = Arm.LEFT if belief.bearing_deg > 0 else Arm.RIGHT
        if belief.let_shut.get(job.target or "", 0) % 2:
            side = side.other
        last = next((event for event in belief.last if event.about(job.verb, job.target)), None)
        if last is not None and not last.ok and last.action.arm is not None and last.code not in _BY_CHANCE:
            side = last.action.arm.other
        return side if side in free else free[0]
