"""A planner that makes one known mistake: the privileged expert with a fault injected, for validating the failure types.

A cause belongs to one of the paper's failure types by what the planner does wrong, not by the codes that come of it:

- navigation: it is not where it has to be (leaves the approach out, walks elsewhere, stops short, steps back, walks blindly);
- body adjustment: its pelvis is not at the height that the action takes (never changes it, changes it the wrong way, crouches
  or stretches where that hurts, asks for more than the legs have);
- logical: it does the wrong thing (another object or receptacle, a wrong order, an occupied hand, one hand for two, ends too
  early, lets go, never lets go, no action at all).

Until the fault strikes, and where it believes in other goals all along, the planner is the expert. Once it has struck, the
planner repeats its mistake until the budget is used up or, when it gives up, for a few steps and then says Done.

`mattered` tells whether the mistake was made where it matters: an arm that is farther from its object than it is long, a
height at which the reach test refuses what it allows at another one, mistaken goals that were all met. That decides which
episodes count in a validation, so it must not look at failure codes or types.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np

from interface.actions import ActionKind
from interface.bodies import Arm
from interface.failures import FailureCategory
from interface.feedback import Feedback
from interface.observation import Observation
from interface.steps import Action, PlanStep
from proprio_mllm.planners.protocol import PlannerReply, TaskInfo, parse_reply
from sim.expert.expert import Expert
from sim.session.session import Session
from sim.tasks.predicates import Predicate
from sim.tasks.task import Task
from sim.world.facts import world_facts

#: Farther from its object's outline than this, no arm of either robot reaches it.
_OUT_OF_REACH_M: Final = 1.1
#: Steps after which a planner that gives up says Done.
_PATIENCE: Final = 4
#: Mistaken steps before a late slip.
_LATE: Final = 2
_HEIGHT_CHANGES: Final = ("MoveUp", "MoveDown")
_OPPOSITE: Final = {"Open": "Close", "Close": "Open", "ToggleOn": "ToggleOff", "ToggleOff": "ToggleOn"}

#: What a planner that has gone wrong replies, step after step.
Script = Iterator[str]


@dataclass(frozen=True, slots=True)
class Moment:
    """What a fault sees before a step.

    Attributes:
        session: the running episode.
        proposed: the step that the expert would take.
        intent: the arm action that it works towards.
        task: the task as it is, not as the planner believes.
        acted: arm actions that have succeeded so far.
        rng: of the episode.
    """

    session: Session
    proposed: PlanStep
    intent: Action | None
    task: Task
    acted: int
    rng: np.random.Generator

    @property
    def walk(self) -> Action | None:
        """The walk that is proposed on the way to a known target, if any."""
        action = self.proposed.actions[0]
        return action if action.name == "GoTo" and self.intent is not None else None

    @property
    def arm_action(self) -> Action | None:
        """The first arm or two-arm action that is proposed, if any."""
        action = self.proposed.actions[0]
        return action if action.spec.kind in (ActionKind.ARM, ActionKind.TWO_ARM) else None

    def distance_m(self, action: Action) -> float:
        """From the robot to the outline of an action's object, horizontally."""
        assert action.object_id is not None
        world = self.session.world
        return world.servos.distance_to(world.poses.bounds(action.object_id))

    def refused_at(self, action: Action, pelvis_height_m: float) -> bool:
        """Whether the arm would not try an action with the pelvis at another height, at this stance."""
        return self.session.assess(action, pelvis_height_m=pelvis_height_m) is not None

    @property
    def heights_m(self) -> tuple[float, float]:
        """Lowest and highest pelvis height."""
        return self.session.body.spec.pelvis_height_range_m


@dataclass(frozen=True, slots=True)
class Cause:
    """A mistake with a known type.

    Attributes:
        category: the type it belongs to.
        strikes: the script once the fault strikes, None as long as the expert goes on. None for a planner that only believes.
        believes: the goals it works towards, None where the mistake cannot be made with this task.
        fits: whether a task could meet the fault, from the actions of the expert's certificate; a coarse filter.
        done: whether the script ends with the planner's own Done, whatever its temper.
        invalid: whether its replies are outside the grammar.
    """

    category: FailureCategory
    strikes: Callable[[Moment], Script | None] | None = None
    believes: Callable[[Task, np.random.Generator], tuple[Predicate, ...] | None] | None = None
    fits: Callable[[Task, tuple[str, ...]], bool] = lambda _task, _verbs: True
    done: bool = False
    invalid: bool = False


def _forever(*texts: str) -> Script:
    while True:
        yield from texts


# ---- navigation


def _stays_away(now: Moment) -> Script | None:
    """Leaves the approach out and reaches for what is far away."""
    if now.walk is None or now.intent is None or now.distance_m(now.intent) < _OUT_OF_REACH_M:
        return None
    return _forever(now.intent.to_text())


def _wrong_place(now: Moment) -> Script | None:
    """Walks to another piece of furniture, far from the target, and acts from there."""
    if now.walk is None or now.intent is None:
        return None
    world = now.session.world
    target = np.asarray(now.session.body.objects.interaction_point(now.intent.object_id or ""))[:2]
    away = [
        name
        for name in sorted(world.objects)
        if not world.objects[name].movable
        and float(np.linalg.norm(np.asarray(now.session.body.objects.interaction_point(name))[:2] - target)) > 2.5
    ]
    if not away:
        return None
    return _forever(f"GoTo({now.rng.choice(away)})", now.intent.to_text())


def _stops_short(now: Moment) -> Script | None:
    """Walks towards the target and stops well before it."""
    if now.walk is None or now.intent is None or now.distance_m(now.intent) < _OUT_OF_REACH_M:
        return None
    distance_m = round(float(now.rng.uniform(1.6, 2.0)), 2)
    return _forever(f"GoTo({now.intent.object_id}, {distance_m:g})", now.intent.to_text())


def _steps_back(now: Moment) -> Script | None:
    """Steps back from where the arm would have reached."""
    if now.arm_action is None or now.arm_action.object_id is None:
        return None
    return _forever(f"MoveBack({round(float(now.rng.uniform(0.8, 1.2)), 2):g})", now.arm_action.to_text())


def _walks_blindly(now: Moment) -> Script | None:
    """Walks straight ahead, whatever stands there, instead of around it."""
    return None if now.walk is None else _forever("MoveAhead(5)")


# ---- body adjustment


def _useful_change(now: Moment) -> float | None:
    """Pelvis height after the proposed change where that makes the intended action possible, None otherwise."""
    change = now.proposed.actions[0]
    if change.name not in _HEIGHT_CHANGES or now.intent is None or change.amount is None:
        return None
    height_m = now.session.body.posture.pelvis_height_m + (change.amount if change.name == "MoveUp" else -change.amount)
    needed = now.session.assess(now.intent) is not None and not now.refused_at(now.intent, height_m)
    return height_m if needed else None


def _never_bends(now: Moment) -> Script | None:
    """Leaves out the change of height that the arm needs."""
    if _useful_change(now) is None or now.intent is None:
        return None
    return _forever(now.intent.to_text())


def _wrong_way(now: Moment) -> Script | None:
    """Moves up where it should move down, and the other way round."""
    if _useful_change(now) is None or now.intent is None:
        return None
    low, high = now.heights_m
    present, up = now.session.body.posture.pelvis_height_m, now.proposed.actions[0].name == "MoveDown"
    room = high - present if up else present - low
    if room < 0.02 or not now.refused_at(now.intent, high if up else low):
        return _forever(f"{'MoveUp' if up else 'MoveDown'}(0.3)", now.intent.to_text())
    return _then(f"{'MoveUp' if up else 'MoveDown'}({np.floor(100 * room) / 100:g})", now.intent.to_text())


def _then(first: str, again: str) -> Script:
    yield first
    yield from _forever(again)


def _to_the_end(now: Moment, low_end: bool) -> tuple[Action, float] | None:
    """The proposed arm action and the way to the end of the legs' range, where the arm does not do it from that end."""
    action = now.arm_action
    low, high = now.heights_m
    present = now.session.body.posture.pelvis_height_m
    room = present - low if low_end else high - present
    if action is None or action.object_id is None or room < 0.05 or not now.refused_at(action, low if low_end else high):
        return None
    return action, float(np.floor(100 * room) / 100)


def _crouches(now: Moment) -> Script | None:
    """Crouches before an action that was in reach."""
    found = _to_the_end(now, low_end=True)
    return None if found is None else _then(f"MoveDown({found[1]:g})", found[0].to_text())


def _stretches(now: Moment) -> Script | None:
    """Stands up before an action that was in reach."""
    found = _to_the_end(now, low_end=False)
    return None if found is None else _then(f"MoveUp({found[1]:g})", found[0].to_text())


def _overdoes(now: Moment) -> Script | None:
    """Asks for more height than the legs have, time and again, and acts from there."""
    for low_end, verb in ((True, "MoveDown"), (False, "MoveUp")):
        found = _to_the_end(now, low_end)
        if found is not None:
            return _forever(f"{verb}(1)", found[0].to_text())
    return None


# ---- logical


def _swapped(goal: Predicate, field: str, old: str, new: str) -> Predicate:
    operands = tuple(_swapped(operand, field, old, new) for operand in goal.of)
    value = new if getattr(goal, field) == old else getattr(goal, field)
    return dataclasses.replace(goal, of=operands, **{field: value})


def _wrong_object(task: Task, rng: np.random.Generator) -> tuple[Predicate, ...] | None:
    """Takes another small object of the scene for the one that is meant."""
    named = {name for goal in task.goals for name in goal.object_ids()}
    moved = [goal.object_id for goal in task.goals if goal.kind in ("on", "in", "held")]
    placed = {placement.object_id for placement in task.placements}
    others = sorted(placed - named)
    if not others or not moved or moved[0] not in placed:
        return None
    other = str(rng.choice(others))
    return tuple(_swapped(goal, "object_id", moved[0], other) for goal in task.goals)


def _wrong_receptacle(task: Task, rng: np.random.Generator) -> tuple[Predicate, ...] | None:
    """Takes another place for the one that is meant; one that carries something at the start, so things can stand there."""
    goal = next((goal for goal in task.goals if goal.kind in ("on", "in")), None)
    if goal is None:
        return None
    placed = {placement.object_id for placement in task.placements}
    own = {placement.receptacle for placement in task.placements if placement.object_id == goal.object_id}
    others = sorted({placement.receptacle for placement in task.placements} - own - placed - {goal.receptacle_id})
    if not others:
        return None
    other = str(rng.choice(others))
    return tuple(_swapped(each, "receptacle_id", goal.receptacle_id, other) for each in task.goals)


def _forgotten_goal(task: Task, rng: np.random.Generator) -> tuple[Predicate, ...] | None:
    """Works towards all goals but one."""
    if len(task.goals) < 2:
        return None
    left_out = int(rng.integers(len(task.goals)))
    return tuple(goal for number, goal in enumerate(task.goals) if number != left_out)


def _stops_early(now: Moment) -> Script | None:
    """Thinks after its first arm action that all is done."""
    return _forever("Done()") if now.acted else None


def _forgets_to_open(now: Moment) -> Script | None:
    """Reaches into, or puts something into, a receptacle that it has not opened."""
    door = next((action for action in now.proposed.actions if action.name == "Open"), None)
    if door is None or any(goal.kind == "open" and goal.object_id == door.object_id for goal in now.task.goals):
        return None
    held = now.session.body.hands.held
    loaded = next((arm for arm in (Arm.RIGHT, Arm.LEFT) if held[arm] is not None), None)
    if loaded is not None:
        return _forever(Action("Place", loaded, door.object_id).to_text())
    parents = now.session.world.containment.all_parents()
    inside = [name for name in sorted(now.session.world.objects) if door.object_id in parents.get(name, ())]
    wanted = {name for goal in now.task.goals for name in goal.object_ids()}
    target = next((name for name in inside if name in wanted), None)
    return None if target is None else _forever(Action("Pick", door.arm, target).to_text())


def _full_hand(now: Moment) -> Script | None:
    """Uses the hand that already holds something."""
    action = now.arm_action
    if action is None or action.name not in ("Pick", "Open", "Close", "ToggleOn", "ToggleOff"):
        return None
    held = now.session.body.hands.held
    full = next((arm for arm in (Arm.RIGHT, Arm.LEFT) if held[arm] is not None), None)
    return None if full is None else _forever(dataclasses.replace(action, arm=full).to_text())


def _one_hand(now: Moment) -> Script | None:
    """Takes with one hand what needs two."""
    action = now.arm_action
    if action is None or action.name != "Lift":
        return None
    return _forever(Action("Pick", Arm.RIGHT, action.object_id).to_text(), Action("Pick", Arm.LEFT, action.object_id).to_text())


def _opposite(now: Moment) -> Script | None:
    """Closes what should be opened, switches on what should be off, and so on."""
    action = now.arm_action
    if action is None or action.name not in _OPPOSITE:
        return None
    return _forever(dataclasses.replace(action, name=_OPPOSITE[action.name]).to_text())


def _lets_go(now: Moment) -> Script | None:
    """Drops what it has just taken, and thinks that all is done."""
    held = now.session.body.hands.held
    arm = next((arm for arm in (Arm.RIGHT, Arm.LEFT) if held[arm] is not None), None)
    if arm is None or now.session.body.hands.lifted is not None:
        return None
    return iter((Action("Release", arm).to_text(), *["Done()"] * 50))


def _never_lets_go(now: Moment) -> Script | None:
    """Brings its load to the right place and walks around there with it."""
    action = now.arm_action
    if action is None or action.name not in ("Place", "PlaceBoth"):
        return None
    return _forever(f"GoTo({action.object_id})", "RotateLeft(15)")


def _babbles(now: Moment) -> Script | None:
    """Writes sentences instead of actions."""
    action = now.arm_action
    return None if action is None else _forever(f"I would now use {action.name} on the {action.object_id}.")


_NAV, _BODY, _LOGIC = FailureCategory.NAVIGATION, FailureCategory.BODY_ADJUSTMENT, FailureCategory.LOGICAL


def _has(*verbs: str) -> Callable[[Task, tuple[str, ...]], bool]:
    return lambda _task, plan: any(verb in plan for verb in verbs)


def _acts_twice(_task: Task, plan: tuple[str, ...]) -> bool:
    moves = ("GoTo", "MoveAhead", "MoveBack", "MoveLeft", "MoveRight", "RotateLeft", "RotateRight", *_HEIGHT_CHANGES)
    return sum(verb not in moves for verb in plan) >= 2


#: Every cause by name.
CAUSES: Final[Mapping[str, Cause]] = {
    "stays away": Cause(_NAV, _stays_away, fits=_has("GoTo")),
    "goes elsewhere": Cause(_NAV, _wrong_place, fits=_has("GoTo")),
    "stops short": Cause(_NAV, _stops_short, fits=_has("GoTo")),
    "steps back": Cause(_NAV, _steps_back),
    "walks blindly": Cause(_NAV, _walks_blindly, fits=_has("GoTo")),
    "never bends": Cause(_BODY, _never_bends, fits=_has(*_HEIGHT_CHANGES)),
    "bends the wrong way": Cause(_BODY, _wrong_way, fits=_has(*_HEIGHT_CHANGES)),
    "crouches": Cause(_BODY, _crouches),
    "stretches": Cause(_BODY, _stretches),
    "overdoes it": Cause(_BODY, _overdoes),
    "wrong object": Cause(_LOGIC, believes=_wrong_object, done=True),
    "wrong receptacle": Cause(_LOGIC, believes=_wrong_receptacle, done=True),
    "forgets a goal": Cause(_LOGIC, believes=_forgotten_goal, done=True),
    "stops early": Cause(_LOGIC, _stops_early, fits=_acts_twice, done=True),
    "forgets to open": Cause(_LOGIC, _forgets_to_open, fits=_has("Open")),
    "full hand": Cause(_LOGIC, _full_hand, fits=lambda task, plan: "Pick" in plan and _acts_twice(task, plan)),
    "one hand": Cause(_LOGIC, _one_hand, fits=_has("Lift")),
    "opposite action": Cause(_LOGIC, _opposite, fits=_has(*_OPPOSITE)),
    "lets go": Cause(_LOGIC, _lets_go, fits=lambda task, plan: "Pick" in plan and _acts_twice(task, plan), done=True),
    "never lets go": Cause(_LOGIC, _never_lets_go, fits=_has("Place", "PlaceBoth")),
    "babbles": Cause(_LOGIC, _babbles, invalid=True),
}


# ---- slips: passing failures of another kind, that the planner gets over


def _bumps(now: Moment) -> str | None:
    return "MoveAhead(5)" if now.walk is not None else None


def _reaches_too_soon(now: Moment) -> str | None:
    return now.intent.to_text() if now.walk is not None and now.intent is not None else None


def _puts_down_nothing(now: Moment) -> str | None:
    if now.intent is None or any(now.session.body.hands.held.values()):
        return None
    return f"Place(right, {now.intent.object_id})"


def _overstretches(_now: Moment) -> str | None:
    return "MoveUp(1)"


def _stammers(_now: Moment) -> str | None:
    return "Well, let me think."


#: What a planner may get wrong once, besides its fault, by name; None where the moment does not allow it.
SLIPS: Final[Mapping[str, Callable[[Moment], str | None]]] = {
    "bumps": _bumps,
    "reaches too soon": _reaches_too_soon,
    "puts down nothing": _puts_down_nothing,
    "overstretches": _overstretches,
    "stammers": _stammers,
}
#: Those that leave the robot where it stands, so that they change nothing about a mistake that is being made.
LATE_SLIPS: Final = ("puts down nothing", "overstretches", "stammers")


class FaultyPlanner:
    """The expert with a fault.

    Args:
        task: the task it is given.
        cause: a key of `CAUSES`.
        gives_up: whether it says Done after a few mistaken steps, instead of going on until the budget is used up.
        slip: a key of `SLIPS` for a passing failure, None for none.
        late: whether the slip comes amid the mistake instead of before it.
        after: arm actions that succeed before the fault may strike.

    Attributes:
        mattered: whether the mistake was made where it matters.
        slipped: whether the slip happened.
    """

    privileged = True
    image_size = 0

    def __init__(
        self, task: Task, cause: str, gives_up: bool = False, slip: str | None = None, late: bool = False, after: int = 0
    ) -> None:
        self._task, self._cause = task, CAUSES[cause]
        self._gives_up, self._slip, self._late, self._after = gives_up, slip, late, after
        self._expert: Expert | None = None
        self._session: Session | None = None
        self._script: Script | None = None
        self._scripted = 0
        self._acted = 0
        self._believed: tuple[Predicate, ...] | None = None
        self.mattered = self.slipped = False

    def attach(self, session: Session) -> None:
        """Takes the session of the coming episode."""
        self._session, self._expert = session, Expert(session)

    def reset(self, task: TaskInfo, rng: np.random.Generator) -> None:
        """Starts the episode; draws what it believes.

        Raises:
            RuntimeError: when no session was attached.
        """
        del task
        if self._expert is None:
            raise RuntimeError("a faulty planner acts in a session: attach(session) before reset, got none")
        self._expert.reset()
        self._rng = rng
        self._script, self._scripted, self._acted = None, 0, 0
        self._believed = None if self._cause.believes is None else self._cause.believes(self._task, rng)
        self.mattered = self.slipped = False

    def step(self, observation: Observation, feedback: Feedback | None) -> PlannerReply:
        """The expert's step, the slip, or the next step of the mistake."""
        del observation
        if feedback is not None:
            kinds = (ActionKind.ARM, ActionKind.TWO_ARM)
            self._acted += sum(outcome.success and outcome.action.spec.kind in kinds for outcome in feedback.outcomes)
        due = self._slip is not None and not self.slipped and (not self._late or self._scripted == _LATE)
        now = self._moment() if self._script is None or due else None
        if due and now is not None and self._slip is not None:
            text = SLIPS[self._slip](now)
            if text is not None:
                self.slipped = True
                return parse_reply(text)
        if self._script is None:
            assert now is not None
            if self._cause.strikes is not None and self._acted >= self._after:
                self._script = self._cause.strikes(now)
            if self._script is None:
                if self._believed is not None and now.proposed.actions[0].name == "Done":
                    self.mattered = self._satisfied()
                return parse_reply(now.proposed.to_text())
            self.mattered = True
        self._scripted += 1
        if self._gives_up and self._scripted > _PATIENCE:
            return parse_reply("Done()")
        reply = parse_reply(next(self._script))
        if self._cause.category is FailureCategory.NAVIGATION and reply.step is not None:
            self.mattered = self.mattered and self._is_away(reply.step.actions[0])
        return reply

    def _satisfied(self) -> bool:
        """Whether all holds that the planner believes in: it is done, and not stuck for a reason of its own."""
        assert self._session is not None and self._believed is not None
        objects = world_facts(self._session.world).objects
        return all(goal.holds(objects) for goal in self._believed)

    def _is_away(self, action: Action) -> bool:
        """Whether what an arm is about to reach for is out of every arm's reach; walks are no attempt."""
        assert self._session is not None
        if action.spec.kind is ActionKind.BODY or action.object_id is None:
            return True
        world = self._session.world
        return world.servos.distance_to(world.poses.bounds(action.object_id)) >= _OUT_OF_REACH_M

    def _moment(self) -> Moment:
        """What the expert proposes, with the goals that this planner believes in."""
        session, expert = self._session, self._expert
        assert session is not None and expert is not None
        task = session.task
        if self._believed is not None:
            session.task = dataclasses.replace(self._task, goals=self._believed)
        try:
            proposed = expert.next_step()
        finally:
            session.task = task
        return Moment(session, proposed, expert.intent, self._task, self._acted, self._rng)
