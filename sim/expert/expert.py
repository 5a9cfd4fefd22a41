"""The privileged expert: a planner that may look at the simulator's state. It certifies tasks and gives demonstrations.

What comes next follows from goals and object states (`sim.expert.jobs`); whether an arm can do it from here, and how much lower
or higher the pelvis would have to be, from the simulator's own reach test (`Session.assess`), which moves nothing. A load of
both hands is put down in thought first, since it is lost when it falls. The style is canonical on purpose, so that a small
model can imitate it: GoTo, then MoveDown or MoveUp where the arm needs it, then the arm action, on both arms at once where both
can reach. The expert re-plans from the current state at every step, so failures and perturbations need no special case; when
something else than its step was done, it forgets having proposed it, so that the same state gets the same step. It is marked
privileged in every table; learned planners never see what it sees.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from interface.actions import ACTIONS
from interface.bodies import Arm
from interface.effects import PutDown
from interface.failures import FailureCode
from interface.steps import Action, PlanStep
from sim.expert.jobs import Job, Setting, plan_jobs
from sim.expert.lookahead import HEIGHT_STEP_M, Lookahead
from sim.session.session import Session
from sim.skills.failures import SkillFailure
from sim.skills.navigation import Stance, wrap_angle
from sim.skills.registry import excludes
from sim.tasks.predicates import Predicate
from sim.world.facts import world_facts

#: Distances (m) and bearings (deg) that GoTo tries in turn when its own choice of stance does not serve.
_STANCES: Final[tuple[tuple[float | None, float | None], ...]] = (
    (None, None), (None, -20.0), (None, 20.0), (0.5, None), (0.4, None), (0.6, None), (0.5, -30.0), (0.5, 30.0),
)  # fmt: skip
_TURN_STEP_DEG: Final = 15.0
#: Stances that are tried in thought before each walk, and walks before the expert gives up.
_LOOKED_AHEAD: Final = 4
_PATIENCE: Final = 5
#: Changes of height that are tried at one stance before another stance is.
_HEIGHT_TRIALS: Final = 2
#: Ways of doing one thing after the other that are acted out in thought before the expert gives up.
_ACTED_OUT: Final = 12
#: Height above a surface at which a load is carried towards it.
_OVER_EDGE_M: Final = 0.04
#: Step back from what a walk ran into, and how often that helps.
_BACK_M: Final = 0.2
_RETREATS: Final = 2
#: Looks around for an object that should be near, before giving up.
_LOOKS: Final = 6
#: Objects lower than this lie on the floor, out of reach.
_FLOOR_M: Final = 0.35
#: Targets that are farther apart than this are not for both arms at once.
_TOGETHER_M: Final = 0.9
#: Farther away than this, an arm need not be asked.
_FAR_M: Final = 1.1
#: Names of actions that change the stance or the height.
_MOVES: Final = ("GoTo", "Move", "Rotate")
#: Failures that the physics, not a contingency, decided: the same action from the same place would fail again.
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


@dataclass(frozen=True, slots=True)
class _Place:
    """Where the robot stands and how high its pelvis is."""

    stance: Stance
    height_m: float

    def near(self, other: _Place) -> bool:
        """Whether two places differ by less than the servos' and the grid's tolerance."""
        gap = float(np.linalg.norm(self.stance.position - other.stance.position))
        turn = abs(wrap_angle(self.stance.yaw_rad - other.stance.yaw_rad))
        return gap < 0.03 and turn < 0.07 and abs(self.height_m - other.height_m) < 0.5 * HEIGHT_STEP_M


@dataclass(frozen=True, slots=True)
class _Refusal:
    """An action that does not work from a place: `verdict` says why it cannot be reached, None that the physics decided."""

    action: str
    place: _Place
    verdict: SkillFailure | None


@dataclass(slots=True)
class _Memory:
    """What earlier attempts taught.

    Attributes:
        attempts: how often a way was tried.
        refusals: what does not work from where.
        gone: stances tried, by target.
        looked_ahead: stances tried in thought.
        barren: what was tried in thought from where, in vain.
    """

    attempts: dict[str, int] = field(default_factory=dict)
    refusals: list[_Refusal] = field(default_factory=list)
    gone: dict[str, set[str]] = field(default_factory=dict)
    looked_ahead: int = 0
    barren: list[tuple[str, _Place]] = field(default_factory=list)

    def copy(self) -> _Memory:
        gone = {target: set(tried) for target, tried in self.gone.items()}
        return _Memory(dict(self.attempts), list(self.refusals), gone, self.looked_ahead, list(self.barren))


class Expert:
    """Plans one step at a time for a session.

    Attributes:
        privileged: always True; tables mark the planner with it.
        intent: the arm action that the newest step works towards, None before the first step and when there is none.
    """

    privileged: Final = True

    def __init__(self, session: Session, lookaheads: int | None = None, arms: Sequence[Arm] = (Arm.RIGHT, Arm.LEFT)) -> None:
        """Attaches to a session.

        Args:
            session: the robot in its world.
            lookaheads: stances it may try in thought in an episode before it gives up; no limit when None.
            arms: the arms it uses; with one of them it shows what a one-armed robot could do.
        """
        self._session = session
        self._lookaheads = lookaheads
        self._usable = tuple(arms)
        self._memory, self._before = _Memory(), _Memory()
        self._homes: dict[str, str] = {}
        self._proposed = ""
        self.intent: Action | None = None
        self._lookahead = Lookahead(session)

    def reset(self) -> None:
        """Forgets earlier attempts; call after the session's reset."""
        self._memory, self._before = _Memory(), _Memory()
        self._proposed = ""
        self._homes = {placement.object_id: placement.receptacle for placement in self._session.task.placements or ()}

    def setting(self) -> Setting:
        """What the job planner reads."""
        return Setting(world_facts(self._session.world), self._homes, self._usable)

    def step(self, observation: object = None, feedback: object = None) -> PlanStep:
        """The planner interface; what it is shown does not matter to it."""
        del observation, feedback
        return self.next_step()

    def next_step(self) -> PlanStep:
        """The step to take from the current state; Done when every goal holds, or when nothing more can be done."""
        step = self._plan()
        self._proposed = step.to_text()
        return step

    def _plan(self) -> PlanStep:
        at = self.setting()
        goals = [goal for goal in self._session.task.goals if isinstance(goal, Predicate)]
        jobs = plan_jobs(goals, at)
        self.intent = None
        if not jobs or self._lost(jobs[0], at):
            return _single(Action("Done"))
        self._learn()
        head = jobs[0]
        if not head.target:
            return _single(head.action(head.arm))
        if self._takes_unusable(head):
            return _single(Action("Done"))
        if head.target not in self._session.known_objects:
            return _single(self._find(head.target, at))
        arms = self._arms(head, at)
        if not arms:  # the hands are full of what has to stay in them
            return _single(Action("Done"))
        self.intent = head.action(arms[0])
        verdicts: list[SkillFailure] = []
        for arm in arms:
            action = head.action(arm)
            refusal = self._refused_here(action)
            if refusal is None:
                verdict = self._session.assess(action)
                if verdict is None and self._leads_on(head, arm):
                    step = self._with_companion(head, arm, jobs[1:], at)
                    if self._lasts(step):
                        return step
                refusal = _Refusal(action.to_text(), self._here(), verdict)
                self._memory.refusals.append(refusal)
            if refusal.verdict is not None:
                verdicts.append(refusal.verdict)
        together = self._approach_together(head, jobs[1:], at)
        return _single(together or self._approach(head, verdicts, at))

    def _takes_unusable(self, job: Job) -> bool:
        """Whether a job takes an arm that is disabled."""
        if job.arm is not None:
            return job.arm not in self._usable
        return ACTIONS[job.verb].arms == 2 and len(self._usable) < 2

    # ---- memory

    def _here(self) -> _Place:
        return _Place(self._session.body.posture.stance(), self._session.body.posture.pelvis_height_m)

    def _refused_here(self, action: Action) -> _Refusal | None:
        """Why an action does not work from here; what the physics decided weighs more than what was thought."""
        text, here = action.to_text(), self._here()
        found = [refusal for refusal in self._memory.refusals if text == refusal.action and here.near(refusal.place)]
        return next((refusal for refusal in found if refusal.verdict is None), found[0] if found else None)

    def _learn(self) -> None:
        """Remembers what failed in the physics from where; a success changes the scene and makes all of it moot."""
        if not self._session.history:
            return
        other = self._session.history[-1].step != self._proposed
        if other:  # what was proposed was not done
            self._memory = self._before.copy()
        for outcome in self._session.history[-1].feedback.split("; "):
            text, _, code = outcome.rpartition(" ")
            if code in _FRUITLESS:
                self._memory.refusals.append(_Refusal(text, self._here(), None))
            elif code == "ok" and not text.startswith(_MOVES):
                self._memory = _Memory(looked_ahead=self._memory.looked_ahead)
            elif code == "ok" and other:  # the robot was moved: every stance is as good as new
                self._memory.attempts.clear()
                self._memory.gone.clear()
        self._before = self._memory.copy()

    def _count(self, what: str) -> int:
        """How often this has been tried before; counts one more."""
        self._memory.attempts[what] = self._memory.attempts.get(what, 0) + 1
        return self._memory.attempts[what] - 1

    def _lost(self, job: Job, at: Setting) -> bool:
        """Whether the job's object lies on the floor, where neither robot reaches, or is broken."""
        if not job.target:
            return False
        item = at.objects[job.target]
        if not item.can.movable or item.picked_up:
            return False
        low, high = self._session.world.poses.bounds(job.target)
        return item.broken or (not item.carriers and float(low[2] + high[2]) / 2.0 < _FLOOR_M)

    # ---- arms

    def _arms(self, job: Job, at: Setting) -> tuple[Arm | None, ...]:
        """Arms that may do the job, preferred one first: the one on the target's side, the right one straight ahead."""
        if job.arm is not None:
            return (job.arm,)
        if ACTIONS[job.verb].arms == 2:
            return (None,)
        free = at.free_arms()
        if len(free) == 2 and self._bearing_rad(job.target) > np.deg2rad(8.0):
            return (Arm.LEFT, Arm.RIGHT)
        return free

    def _with_companion(self, head: Job, arm: Arm | None, others: Sequence[Job], at: Setting) -> PlanStep:
        """The step for `head`, with a job for the other arm beside it where that is possible right now."""
        if arm is None or head.then is not None:
            return _single(head.action(arm))
        for job in others:
            if ACTIONS[job.verb].arms == 2 or job.then is not None or not job.target:
                continue
            if job.target not in self._session.known_objects or self._is_far(job.target):
                continue
            pairs = [(arm, arm.other)]
            if head.arm is None and job.arm is None and len(at.free_arms()) == 2:
                pairs.append((arm.other, arm))
                left_first = self._bearing_rad(head.target) > self._bearing_rad(job.target)
                pairs.sort(key=lambda pair: (pair[0] is Arm.LEFT) != left_first)
            for mine, other in pairs:
                if job.arm not in (None, other) or (job.arm is None and other not in at.free_arms()):
                    continue
                first, second = head.action(mine), job.action(other)
                if any(self._refused_here(action) for action in (first, second)):
                    continue
                if all(self._session.assess(action) is None for action in (second, first)) and not self._excluded(
                    first, second
                ):
                    return PlanStep((first, second))
        return _single(head.action(arm))

    def _excluded(self, first: Action, second: Action) -> bool:
        """Whether two actions that are possible alone exclude each other: one would walk away from the other."""
        return excludes(self._session.body, PlanStep((first, second)), frozenset(self._session.known_objects))

    # ---- the body

    def _follow_up(self, job: Job, arm: Arm | None) -> Action | None:
        """What the other arm does after a job that makes it possible, None when nothing has to follow."""
        if job.then is None or arm is None:
            return None
        return job.then.action(job.then.arm or arm.other)

    def _leads_on(self, job: Job, arm: Arm | None) -> bool:
        """Whether what has to follow a job can be done from here as well."""
        following = self._follow_up(job, arm)
        if following is None:
            return True
        return following.arm in self._usable and self._lookahead.leads_to(job.action(arm), following)

    def _lasts(self, step: PlanStep) -> bool:
        """Whether what both hands put down stays there; it is put down in thought first, since it is lost when it falls."""
        both = any(action.spec.arms == 2 and action.spec.has_effect(PutDown) for action in step.actions)
        return not both or self._lookahead.succeeds(step)

    def _approach_for_two(self, job: Job, at: Setting) -> Action:
        """The body action towards a place from where one arm can do a job and the other what follows it."""
        pairs = [(job.action(arm), self._follow_up(job, arm)) for arm in self._arms(job, at)]
        pairs = [(first, then) for first, then in pairs if then is not None and then.arm in self._usable]
        if not pairs or self._count(f"stance {job.target}") >= _PATIENCE:
            return Action("Done")
        present, *heights = self._lookahead.heights_m()
        tried = self._memory.gone.setdefault(job.target, set())
        trials = 0
        for option, stance in self._stances_for_two(job.target, tried):
            for height in (present, *heights) if option is not None else heights:
                for first, then in pairs:
                    if not self._lookahead.might_lead_to(first, then, stance, height):
                        continue
                    trials += 1
                    if self._lookahead.leads_to(first, then, stance, height):
                        tried.add("" if option is None else option.to_text())
                        return self._height_change(height - present) if option is None else option
                    if trials >= _ACTED_OUT:
                        return Action("Done")
        return Action("Done")

    def _stances_for_two(self, target: str, tried: Collection[str]) -> Iterator[tuple[Action | None, Stance]]:
        """Where two arms might work on a target: here, without an action, then where walks would end."""
        yield None, self._session.body.posture.stance()
        for distance, bearing in _STANCES:
            option = Action("GoTo", object_id=target, amount=distance, bearing_deg=bearing)
            stance = None if option.to_text() in tried else self._lookahead.stance_of(option)
            if stance is not None:
                yield option, stance

    def _approach_together(self, head: Job, others: Sequence[Job], at: Setting) -> Action | None:
        """A walk to where both arms can work at once, None when there is nothing for the other arm or no such place.

        It is thought about once for every pair of targets.
        """
        partner = next((job for job in others if self._goes_with(head, job)), None)
        if partner is None or head.then is not None or self._count(f"together {head.target} {partner.target}"):
            return None
        pairs = [
            (head.action(arm), partner.action(arm.other))
            for arm in self._usable
            if head.arm in (None, arm) and partner.arm in (None, arm.other) and arm.other in self._usable
        ]
        for target in dict.fromkeys((head.target, partner.target)):
            for distance, bearing in _STANCES[:3]:
                option = Action("GoTo", object_id=target, amount=distance, bearing_deg=bearing)
                stance = self._lookahead.stance_of(option)
                if stance is not None and self._lookahead.works_together(pairs, stance):
                    return option
        return None

    def _stuck(self) -> bool:
        """Whether the last walk ended at an obstacle and there is room to step back from it."""
        history, body = self._session.history, self._session.body
        if not history or not history[-1].feedback.endswith(FailureCode.BLOCKED_PATH.value):
            return False
        base = body.posture.stance()
        behind = base.position - _BACK_M * np.array([np.cos(base.yaw_rad), np.sin(base.yaw_rad)])
        return (
            not history[-1].step.startswith("Move")
            and body.workspace.navigation().free_travel(base.position, behind) > 0.9 * _BACK_M
        )

    def _goes_with(self, head: Job, other: Job) -> bool:
        """Whether two jobs might be done at once, by one arm each."""
        arm_jobs = head.arm is None or other.arm is None or head.arm is not other.arm
        if (
            not other.target
            or other.then is not None
            or not arm_jobs
            or ACTIONS[head.verb].arms == 2
            or ACTIONS[other.verb].arms == 2
        ):
            return False
        if other.target not in self._session.known_objects:
            return False
        body = self._session.body
        gap = body.objects.interaction_point(head.target)[:2] - body.objects.interaction_point(other.target)[:2]
        return len(self._usable) == 2 and float(np.hypot(*gap)) < _TOGETHER_M

    def _approach(self, job: Job, verdicts: Sequence[SkillFailure], at: Setting) -> Action:
        """The body action that brings a known target into reach."""
        at_door = next((arm for arm, item in at.facts.held.items() if item is not None and at.in_place(item)), None)
        if at_door is not None:  # a hand that holds something where it is keeps the robot there
            return Action("Release", arm=at_door)
        if self._stuck() and self._count("back off") < _RETREATS:
            return Action("MoveBack", amount=_BACK_M)
        if job.then is not None:
            return self._approach_for_two(job, at)
        target = job.target
        wrong = next((verdict for verdict in verdicts if verdict.code in _WRONG_HEIGHT), None)
        if wrong is not None and self._count(f"height {target}") < _HEIGHT_TRIALS:
            return self._height_change(wrong.margins["height_m"])
        self._memory.attempts.pop(f"height {target}", None)
        rise_m = self._rise_m(job)
        if rise_m > 0.02:
            return self._height_change(rise_m)
        attempt = self._count(f"stance {target}")
        if attempt >= _PATIENCE:
            return Action("Done")
        actions = [job.action(arm) for arm in self._arms(job, at)]
        options = [Action("GoTo", object_id=target, amount=d, bearing_deg=b) for d, b in _STANCES]
        tried = self._memory.gone.setdefault(target, set())
        fresh = [option for option in options if option.to_text() not in tried]
        looked, what = 0, " or ".join(action.to_text() for action in actions)
        for option in fresh:
            if looked == _LOOKED_AHEAD:
                break
            if self._lookaheads is not None and self._memory.looked_ahead >= self._lookaheads:
                return Action("Done")
            stance = self._lookahead.stance_of(option)
            if stance is None:
                continue
            place = _Place(stance, self._session.body.posture.pelvis_height_m)
            if any(what == known and place.near(other) for known, other in self._memory.barren):
                continue
            looked += 1
            self._memory.looked_ahead += 1
            if self._lookahead.works(actions, stance):
                tried.add(option.to_text())
                return option
            self._memory.barren.append((what, place))
        option = fresh[0] if fresh else options[0]
        tried.add(option.to_text())
        return option

    def _rise_m(self, job: Job) -> float:
        """How much higher a load has to be carried so as not to run into the furniture it is brought to."""
        world, body = self._session.world, self._session.body
        load = body.hands.lifted or (None if job.arm is None else body.hands.held[job.arm])
        obj = world.objects[job.target]
        if not job.verb.startswith("Place") or load is None or (obj.type.encloses and not obj.type.lidded):
            return 0.0
        spot = world.containment.free_spot(job.target, 0.03)
        if spot is None:
            return 0.0
        missing = float(spot[2]) + _OVER_EDGE_M - float(world.poses.bounds(load)[0][2])
        return min(missing, body.spec.pelvis_height_range_m[1] - body.posture.pelvis_height_m)

    def _height_change(self, height_m: float) -> Action:
        """The change of pelvis height, rounded away from zero to the grid, as far as the legs go."""
        low, high = self._session.body.spec.pelvis_height_range_m
        present = self._session.body.posture.pelvis_height_m
        room = high - present if height_m > 0 else present - low
        steps = max(1, int(np.ceil(abs(height_m) / HEIGHT_STEP_M - 0.1)))
        amount = max(0.01, round(min(steps * HEIGHT_STEP_M, room), 2))
        return Action("MoveUp" if height_m > 0 else "MoveDown", amount=amount)

    def _find(self, target: str, at: Setting) -> Action:
        """Goes to where an object is that the robot has not seen yet, and looks around there."""
        known = self._session.known_objects
        carrier = next((c for c in at.objects[target].carriers if c in known), None)
        attempt = self._count(f"find {target}")
        if attempt == 0 and carrier is not None:
            return Action("GoTo", object_id=carrier)
        if attempt > _LOOKS:
            return Action("Done")
        bearing_deg = float(np.rad2deg(self._bearing_rad(target)))
        if abs(bearing_deg) > 10.0 and attempt % 2 == 1:
            amount = float(np.clip(round(abs(bearing_deg) / _TURN_STEP_DEG), 1, 12)) * _TURN_STEP_DEG
            return Action("RotateLeft" if bearing_deg > 0 else "RotateRight", amount=amount)
        return Action("MoveBack", amount=0.3) if attempt % 3 else Action("MoveUp", amount=0.2)

    def _bearing_rad(self, object_id: str) -> float:
        base = self._session.body.base.measured()
        delta = self._session.body.objects.interaction_point(object_id)[:2] - base.position
        return wrap_angle(float(np.arctan2(delta[1], delta[0])) - base.yaw_rad)

    def _is_far(self, object_id: str) -> bool:
        world = self._session.world
        return world.servos.distance_to(world.poses.bounds(object_id)) > _FAR_M


def _single(action: Action) -> PlanStep:
    return PlanStep((action,))
