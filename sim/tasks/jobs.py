"""What is left to do: from goals and object states to an ordered list of arm jobs.

Pure functions over metadata, no physics: the expert (`sim.expert`) asks here what comes next and decides itself where to stand.
Order is canonical, so that demonstrations are regular: switches and doors that the goal asks for, then small objects (pick all
that the hands can take, then put them down), then doors to close, then things that take two hands, then what has to stay in the
hands at the end.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

from data.records import ACTIONS, Action, ActionKind, Arm
from sim.tasks.predicates import Predicate

__all__ = ["Facts", "Job", "pending_leaves", "plan_jobs"]

_NEGATION: Final = {"open": "closed", "closed": "open", "toggled_on": "toggled_off", "toggled_off": "toggled_on"}


@dataclass(frozen=True, slots=True)
class Job:
    """One arm action still to be done.

    Attributes:
        verb: name of an arm or two-arm action of the grammar.
        target: the action's object.
        arm: the arm that has to do it, None when any free arm may (or both do).
    """

    verb: str
    target: str
    arm: Arm | None = None

    def action(self, arm: Arm | None) -> Action:
        """The grammar's action, done by `arm` (ignored for two-arm actions)."""
        return Action(self.verb, arm=arm if ACTIONS[self.verb].kind is ActionKind.ARM else None, object_id=self.target)


@dataclass(frozen=True, slots=True)
class Facts:
    """The states that decide what comes next.

    Attributes:
        objects: AI2-THOR metadata by object id.
        held: object in each hand, None for an empty one; a lifted object is in `lifted`, not here.
        lifted: object in both hands.
        two_handed: ids that need both hands.
        homes: where each object stood at the start, to put strays back.
        uncovered: ids that open but shut nothing away: a closed one is in nobody's way.
    """

    objects: Mapping[str, Mapping[str, Any]]
    held: Mapping[Arm, str | None]
    lifted: str | None
    two_handed: frozenset[str]
    homes: Mapping[str, str]
    uncovered: frozenset[str] = frozenset()

    def closed_carrier(self, object_id: str) -> str | None:
        """The closed receptacle around an object, if any."""
        for carrier in self.objects[object_id]["parentReceptacles"] or ():
            if self.is_closed(carrier):
                return carrier
        return None

    def is_closed(self, object_id: str) -> bool:
        """Whether the object is closed and its contents are out of reach."""
        entry = self.objects[object_id]
        return bool(entry["openable"]) and not entry["isOpen"] and object_id not in self.uncovered

    def free_arms(self) -> tuple[Arm, ...]:
        """Empty hands, the right one first."""
        return () if self.lifted else tuple(arm for arm in (Arm.RIGHT, Arm.LEFT) if self.held[arm] is None)


def pending_leaves(goals: Sequence[Predicate], objects: Mapping[str, Mapping[str, Any]]) -> list[Predicate]:
    """The leaf conditions that still have to be made true, in goal order.

    Of an `or` the first operand is taken, of a `count` as many as are missing.

    Raises:
        ValueError: on a `not` that names no state to bring about.
    """
    metadata = {"objects": list(objects.values())}
    leaves: list[Predicate] = []
    for goal in goals:
        if goal.holds(metadata):
            continue
        if goal.kind == "and":
            leaves += pending_leaves(goal.of, objects)
        elif goal.kind == "or":
            leaves += pending_leaves(goal.of[:1], objects)
        elif goal.kind == "count":
            missing = goal.at_least - sum(operand.holds(metadata) for operand in goal.of)
            leaves += pending_leaves([operand for operand in goal.of if not operand.holds(metadata)][:missing], objects)
        elif goal.kind == "not":
            operand = goal.of[0]
            if operand.kind not in _NEGATION:
                raise ValueError(f"no way to bring about not {operand.kind!r}; allowed: {', '.join(_NEGATION)}")
            leaves.append(Predicate(_NEGATION[operand.kind], operand.object_id))  # type: ignore[arg-type]
        else:
            leaves.append(goal)
    return leaves


def plan_jobs(goals: Sequence[Predicate], facts: Facts) -> list[Job]:
    """Jobs that can be done now; the first one has priority, the others may run beside it on the other arm.

    Returns:
        An empty list when all goals hold.
    """
    leaves = pending_leaves(goals, facts.objects)
    if not leaves:
        return []
    if facts.lifted is not None:
        return [_put_down_lifted(leaves, facts)]
    moves = [leaf for leaf in leaves if leaf.kind in ("on", "in")]
    heavy = [leaf for leaf in moves if leaf.object_id in facts.two_handed]
    light = [leaf for leaf in moves if leaf.object_id not in facts.two_handed]
    kept = {goal.object_id for goal in _all_leaves(goals) if goal.kind == "held"} | {leaf.object_id for leaf in light}
    strays = [arm for arm, item in facts.held.items() if item is not None and item not in kept]
    if strays:
        item = facts.held[strays[0]]
        return _through_door(Job("Place", facts.homes[item or ""], strays[0]), facts)
    free = bool(facts.free_arms())
    jobs: list[Job] = []
    if free:
        jobs += [Job("ToggleOn", leaf.object_id) for leaf in leaves if leaf.kind == "toggled_on"]
        jobs += [Job("ToggleOff", leaf.object_id) for leaf in leaves if leaf.kind == "toggled_off"]
        jobs += [Job("Open", leaf.object_id) for leaf in leaves if leaf.kind == "open"]
    jobs += _light_jobs(light, facts)
    if free and not light:
        jobs += [Job("Close", leaf.object_id) for leaf in leaves if leaf.kind == "closed"]
    if jobs:
        return _with_picks(jobs, leaves, facts)
    for leaf in heavy:
        if facts.is_closed(leaf.receptacle_id):
            return [Job("Open", leaf.receptacle_id)]
        return [Job("Lift", leaf.object_id)]
    picks = _held_jobs(leaves, facts)
    return picks or [Job("Lift", leaf.object_id) for leaf in leaves if leaf.kind == "lifted"]


def _all_leaves(goals: Sequence[Predicate]) -> list[Predicate]:
    return [leaf for goal in goals for leaf in (_all_leaves(goal.of) if goal.of else [goal])]


def _put_down_lifted(leaves: Sequence[Predicate], facts: Facts) -> Job:
    for leaf in leaves:
        if leaf.kind in ("on", "in") and leaf.object_id == facts.lifted:
            return Job("PlaceBoth", leaf.receptacle_id)
    home = facts.homes.get(facts.lifted or "")
    open_places = (name for name, entry in facts.objects.items() if entry["receptacle"] and not entry["moveable"]
                   and not entry["pickupable"] and not facts.is_closed(name))  # fmt: skip
    return Job("PlaceBoth", home if home is not None else next(open_places))


def _through_door(job: Job, facts: Facts) -> list[Job]:
    """The job, or the opening of the receptacle that it needs first."""
    door = job.target if job.verb == "Place" and facts.is_closed(job.target) else None
    if job.verb == "Pick":
        door = facts.closed_carrier(job.target)
    return [job] if door is None or not facts.free_arms() else [Job("Open", door)]


def _light_jobs(light: Sequence[Predicate], facts: Facts) -> list[Job]:
    """Carrying small objects: fill the hands first, but keep one free for a door that is still closed."""
    arm_of = {item: arm for arm, item in facts.held.items() if item is not None}
    waiting = [leaf for leaf in light if leaf.object_id not in arm_of]
    in_hand = [leaf for leaf in light if leaf.object_id in arm_of]
    door_ahead = any(facts.is_closed(leaf.receptacle_id) for leaf in in_hand)
    if waiting and facts.free_arms() and not door_ahead:
        jobs = [job for leaf in waiting for job in _through_door(Job("Pick", leaf.object_id), facts)]
        return list(dict.fromkeys(jobs))[: 2 if len(facts.free_arms()) == 2 else 1]
    places = [job for leaf in in_hand for job in _through_door(Job("Place", leaf.receptacle_id, arm_of[leaf.object_id]), facts)]
    return list(dict.fromkeys(places))


def _held_jobs(leaves: Sequence[Predicate], facts: Facts) -> list[Job]:
    jobs = [job for leaf in leaves if leaf.kind == "held" for job in _through_door(Job("Pick", leaf.object_id), facts)]
    return list(dict.fromkeys(jobs))


def _with_picks(jobs: list[Job], leaves: Sequence[Predicate], facts: Facts) -> list[Job]:
    """Adds picking up as a possible companion of a switch or a door, when both hands are free for it."""
    if len(jobs) == 1 and len(facts.free_arms()) == 2 and jobs[0].verb in ("Open", "Close", "ToggleOn", "ToggleOff"):
        return jobs + [job for job in _held_jobs(leaves, facts) if job.verb == "Pick"][:1]
    return jobs
