"""What is left to do: from goals and object states to an ordered list of arm jobs.

Pure functions over facts, no physics: the expert (`sim.expert.expert`) asks here what comes next and decides itself where to
stand. Order is canonical, so that demonstrations are regular: switches and doors that the goal asks for, then work with tools
and liquids, then small objects (pick all that the hands can take, then put them down), then doors to close, then things that
take two hands, then what has to stay in the hands at the end. A door that falls shut is held open by one hand while the other
one reaches through it, and what would roll away under a tool is held by one hand while the other one works.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

from interface.actions import ACTIONS, ActionKind, bringing_about
from interface.bodies import Arm
from interface.effects import Condition
from interface.facts import Facts, ObjectFacts
from interface.steps import Action
from sim.tasks.predicates import Predicate

_NEGATION: Final = {"open": "closed", "closed": "open", "toggled_on": "toggled_off", "toggled_off": "toggled_on"}
#: What a hand has to hold to bring a state about, and the action that does.
_TOOL_WORK: Final = {
    kind: (spec.tool, spec.name)
    for kind, state in (("sliced", (Condition.SLICED, True)), ("clean", (Condition.DIRTY, False)))
    for spec in bringing_about(*state)
    if spec.tool is not None
}


@dataclass(frozen=True, slots=True)
class Job:
    """One arm action still to be done.

    Attributes:
        verb: name of an arm or two-arm action of the grammar.
        target: the action's object, empty for actions without one.
        arm: the arm that has to do it, None when any free arm may (or both do).
        then: what the other arm does next from the same place, None when the robot may walk in between.
    """

    verb: str
    target: str
    arm: Arm | None = None
    then: Job | None = None

    def action(self, arm: Arm | None) -> Action:
        """The grammar's action, done by `arm` (ignored for two-arm actions)."""
        one = arm if ACTIONS[self.verb].kind is ActionKind.ARM else None
        return Action(self.verb, arm=one, object_id=self.target or None)


@dataclass(frozen=True, slots=True)
class Setting:
    """What decides what comes next.

    Attributes:
        facts: the world.
        homes: where each object stood at the start, to put strays back.
        arms: arms that can be used, the preferred one first.
    """

    facts: Facts
    homes: Mapping[str, str]
    arms: tuple[Arm, ...] = (Arm.RIGHT, Arm.LEFT)

    @property
    def objects(self) -> Mapping[str, ObjectFacts]:
        """The world's objects."""
        return self.facts.objects

    def made_for(self, use: str) -> list[str]:
        """Tools for a use of the table of actions, `cutter` or `wiper`."""
        return [name for name, item in self.objects.items() if getattr(item.can, use)]

    def free_arms(self) -> tuple[Arm, ...]:
        """Usable arms with an empty hand, the preferred one first."""
        return () if self.facts.lifted is not None else tuple(arm for arm in self.arms if self.facts.held[arm] is None)

    def in_place(self, object_id: str) -> bool:
        """Whether a held object still rests where it was, as Hold leaves it, or is furniture."""
        item = self.objects[object_id]
        return bool(item.carriers) or not item.can.movable


def pending_leaves(goals: Sequence[Predicate], objects: Mapping[str, ObjectFacts]) -> list[Predicate]:
    """The leaf conditions that still have to be made true, in goal order.

    Of an `or` the first operand is taken, of a `count` or an `exists` as many as are missing.

    Raises:
        ValueError: on a `not` that names no state to bring about.
    """
    leaves: list[Predicate] = []
    for goal in goals:
        if goal.holds(objects):
            continue
        if goal.kind == "and":
            leaves += pending_leaves(goal.of, objects)
        elif goal.kind == "or":
            leaves += pending_leaves(goal.of[:1], objects)
        elif goal.kind in ("count", "exists"):
            operands = goal.candidates(objects) if goal.kind == "exists" else goal.of
            missing = goal.at_least - sum(operand.holds(objects) for operand in operands)
            leaves += pending_leaves([operand for operand in operands if not operand.holds(objects)][:missing], objects)
        elif goal.kind == "not":
            operand = goal.of[0]
            if operand.kind not in _NEGATION:
                raise ValueError(f"no way to bring about not {operand.kind!r}; allowed: {', '.join(_NEGATION)}")
            leaves.append(Predicate(_NEGATION[operand.kind], operand.object_id))  # type: ignore[arg-type]
        else:
            leaves.append(goal)
    return leaves


def plan_jobs(goals: Sequence[Predicate], at: Setting) -> list[Job]:
    """Jobs that can be done now; the first one has priority, the others may run beside it on the other arm.

    Returns:
        An empty list when all goals hold.
    """
    leaves = pending_leaves(goals, at.objects)
    if not leaves:
        return []
    if at.facts.lifted is not None:
        return [_put_down_lifted(leaves, at)]
    through = _through_held_door(leaves, at)
    if through:
        return through
    moves = [leaf for leaf in leaves if leaf.kind in ("on", "in")]
    heavy = [leaf for leaf in moves if at.objects[leaf.object_id].two_handed]
    light = [leaf for leaf in moves if not at.objects[leaf.object_id].two_handed]
    strays = _strays(goals, leaves, light, at)
    if strays:
        return strays
    work = _work_jobs(leaves, at)
    if work:
        return work
    free = bool(at.free_arms())
    jobs: list[Job] = []
    if free:
        jobs += [Job("ToggleOn", leaf.object_id) for leaf in leaves if leaf.kind == "toggled_on"]
        jobs += [Job("ToggleOff", leaf.object_id) for leaf in leaves if leaf.kind == "toggled_off"]
        jobs += [Job("Open", leaf.object_id) for leaf in leaves if leaf.kind == "open"]
    jobs += _light_jobs(light, at)
    if free and not light:
        jobs += [Job("Close", leaf.object_id) for leaf in leaves if leaf.kind == "closed"]
    if jobs:
        return _with_picks(jobs, leaves, at)
    for leaf in heavy:
        if at.objects[leaf.receptacle_id].shut:
            return [Job("Open", leaf.receptacle_id)]
        return [Job("Lift", leaf.object_id)]
    picks = _held_jobs(leaves, at)
    return (
        picks
        or [Job("Lift", leaf.object_id) for leaf in leaves if leaf.kind == "lifted"]
        or [Job("ResetArm", "", at.arms[0]) for leaf in leaves if leaf.kind == "cooked"]  # it takes time
    )


def _all_leaves(goals: Sequence[Predicate]) -> list[Predicate]:
    return [leaf for goal in goals for leaf in (_all_leaves(goal.of) if goal.of else [goal])]


def _strays(goals: Sequence[Predicate], leaves: Sequence[Predicate], light: Sequence[Predicate], at: Setting) -> list[Job]:
    """Putting away, or letting go of, what no goal wants in a hand."""
    kept = {goal.object_id for goal in _all_leaves(goals) if goal.kind == "held"} | {leaf.object_id for leaf in light}
    if any(leaf.kind == "filled" for leaf in leaves):  # the vessel, and what it may be filled from
        kept |= {leaf.object_id for leaf in leaves if leaf.kind == "filled"}
        kept |= {item for item in at.facts.held.values() if item is not None and at.objects[item].filled}
    for leaf in leaves:
        if leaf.kind in _TOOL_WORK:
            kept |= {leaf.object_id, *at.made_for(_TOOL_WORK[leaf.kind][0])}
    for arm, item in at.facts.held.items():
        if item is None or item in kept:
            continue
        if at.in_place(item):
            return [Job("Release", "", arm)]
        return _through_door(Job("Place", at.homes[item], arm), at)
    return []


def _through_held_door(leaves: Sequence[Predicate], at: Setting) -> list[Job]:
    """What is left to do through a door that a hand holds open; letting go of it when nothing is."""
    for arm, door in at.facts.held.items():
        if door is None or not at.objects[door].self_closing:
            continue
        for leaf in leaves:
            bearer = at.facts.arm_with(leaf.object_id)
            if leaf.kind in ("on", "in") and leaf.receptacle_id == door and bearer is not None:
                return [Job("Place", door, bearer)]
            inside = door in at.objects[leaf.object_id].carriers
            if leaf.kind in ("held", "on", "in") and leaf.receptacle_id != door and inside and at.free_arms():
                return [Job("Pick", leaf.object_id)]
        return [Job("Release", "", arm)]
    return []


def _put_down_lifted(leaves: Sequence[Predicate], at: Setting) -> Job:
    for leaf in leaves:
        if leaf.kind in ("on", "in") and leaf.object_id == at.facts.lifted:
            return Job("PlaceBoth", leaf.receptacle_id)
    home = at.homes.get(at.facts.lifted or "")
    open_places = (name for name, item in at.objects.items() if item.can.receptacle and not item.can.movable
                   and not item.shut)  # fmt: skip
    return Job("PlaceBoth", home if home is not None else next(open_places))


def _through_door(job: Job, at: Setting) -> list[Job]:
    """The job, or the opening of the receptacle that it needs first."""
    door = job.target if job.verb == "Place" and at.objects[job.target].shut else None
    if job.verb == "Pick":
        door = at.facts.shut_around(job.target)
    if door is None or not at.free_arms():
        return [job]
    return [Job("Open", door, then=job if at.objects[door].self_closing else None)]


# ---- tools, liquids, heat


def _work_jobs(leaves: Sequence[Predicate], at: Setting) -> list[Job]:
    """The next step towards the first state that takes a tool, a vessel or heat."""
    for leaf in leaves:
        if leaf.kind in _TOOL_WORK:
            return _tool_jobs(leaf, at)
        if leaf.kind == "filled":
            return _fill_jobs(leaf.object_id, at)
        if leaf.kind == "used_up" and at.free_arms():
            return [Job("UseUp", leaf.object_id)]
        if leaf.kind == "cooked":
            job = _heat_job(leaf.object_id, at)
            if job is not None:
                return [job]
    return []


def _tool_jobs(leaf: Predicate, at: Setting) -> list[Job]:
    use, verb = _TOOL_WORK[leaf.kind]
    tools = at.made_for(use)
    arm = next((arm for arm, item in at.facts.held.items() if item in tools), None)
    if arm is None:
        return _through_door(Job("Pick", tools[0]), at) if tools else []
    work = Job(verb, leaf.object_id, arm)
    if at.objects[leaf.object_id].can.unsteady and at.facts.arm_with(leaf.object_id) is None:
        return [Job("Hold", leaf.object_id, arm.other, then=work)]
    return [work]


def _fill_jobs(vessel: str, at: Setting) -> list[Job]:
    """Filling a vessel: from another one that holds a liquid, else at an outlet."""
    bearer = at.facts.arm_with(vessel)
    full = [
        name
        for name, item in at.objects.items()
        if name != vessel and item.filled and item.can.pickupable and not item.two_handed
    ]
    if full and bearer is None:
        arm = at.facts.arm_with(full[0])
        return [Job("Pick", full[0])] if arm is None else [Job("Pour", vessel, arm)]
    outlets = [name for name, item in at.objects.items() if item.can.toggleable and item.outlet == name]
    if not outlets:
        return []
    if bearer is None:
        return _through_door(Job("Pick", vessel), at)
    outlet = outlets[0]
    if not at.objects[outlet].on and at.free_arms():
        return [Job("ToggleOn", outlet)]
    return [Job("Fill", outlet, bearer)]


def _heat_job(food: str, at: Setting) -> Job | None:
    """Closing and switching on what the food lies in or on; None while it is on no heat source, or when it is being heated."""
    for place in at.objects[food].carriers:
        item = at.objects[place]
        if not item.can.heat_source or at.objects[food].picked_up:
            continue
        if item.open:
            return Job("Close", place)
        if not item.on:
            return Job("ToggleOn", item.switch or place)
    return None


# ---- carrying


def _light_jobs(light: Sequence[Predicate], at: Setting) -> list[Job]:
    """Carrying small objects: fill the hands first, but keep one free for a door that is still closed."""
    arm_of = {item: arm for arm, item in at.facts.held.items() if item is not None}
    waiting = [leaf for leaf in light if leaf.object_id not in arm_of]
    in_hand = [leaf for leaf in light if leaf.object_id in arm_of]
    door_ahead = any(at.objects[leaf.receptacle_id].shut for leaf in in_hand)
    if waiting and at.free_arms() and not door_ahead:
        closed = [leaf.receptacle_id for leaf in waiting if at.objects[leaf.receptacle_id].shut]
        ajar = [door for door in closed if not at.objects[door].self_closing]
        if ajar and not in_hand and (len(waiting) > 1 or len(at.arms) == 1):
            return [Job("Open", ajar[0])]  # nothing is free for the door later
        room = 1 if closed else len(at.free_arms())
        jobs = [job for leaf in waiting for job in _through_door(Job("Pick", leaf.object_id), at)]
        return list(dict.fromkeys(jobs))[:room]
    places = [job for leaf in in_hand for job in _through_door(Job("Place", leaf.receptacle_id, arm_of[leaf.object_id]), at)]
    return list(dict.fromkeys(places))


def _held_jobs(leaves: Sequence[Predicate], at: Setting) -> list[Job]:
    jobs = [job for leaf in leaves if leaf.kind == "held" for job in _through_door(Job("Pick", leaf.object_id), at)]
    return list(dict.fromkeys(jobs))


def _with_picks(jobs: list[Job], leaves: Sequence[Predicate], at: Setting) -> list[Job]:
    """Adds picking up as a possible companion of a switch or a door, when both hands are free for it."""
    if len(jobs) == 1 and len(at.free_arms()) == 2 and jobs[0].verb in ("Open", "Close", "ToggleOn", "ToggleOff"):
        return jobs + [job for job in _held_jobs(leaves, at) if job.verb == "Pick"][:1]
    return jobs
