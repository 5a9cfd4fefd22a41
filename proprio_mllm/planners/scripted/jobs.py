"""What comes next: from goals and a belief to an ordered list of arm jobs.

The order is that of a person with two hands: switches and doors that are asked for, work with tools and liquids, small things
(pick what the hands can take, then put it down), doors to close, what takes both hands, and last what has to stay in a hand.
Paper: not in it; part of a reference planner of this project.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, TypeGuard

from interface.actions import ACTIONS, ActionKind, bringing_about
from interface.belief import Belief
from interface.bodies import Arm
from interface.effects import Condition
from interface.failures import FailureCode
from interface.steps import Action
from proprio_mllm.planners.scripted.words import Mention, type_of

#: Types that take both hands, as far as one can know.
_BIG: Final = ("houseplant", "box", "laundryhamper", "pot", "microwave", "television")
#: Types that are shut when nobody says otherwise.
_SHUT: Final = ("cabinet", "drawer", "fridge", "microwave")
#: The action that brings a goal about, by the goal's kind.
_CHANGES: Final = {
    kind: next(bringing_about(condition, value)).name
    for kind, (condition, value) in {
        "open": (Condition.OPEN, True),
        "closed": (Condition.OPEN, False),
        "toggled_on": (Condition.ON, True),
        "toggled_off": (Condition.ON, False),
    }.items()
}
_TOOL_VERBS: Final = {
    kind: next(bringing_about(condition, value)).name
    for kind, (condition, value) in {"sliced": (Condition.SLICED, True), "clean": (Condition.DIRTY, False)}.items()
}


@dataclass(frozen=True, slots=True)
class Want:
    """A goal whose words have been matched with ids.

    Attributes:
        kind: as `Goal.kind`.
        obj, place, tool: ids, None for what has not been seen.
        spoken_obj, spoken_tool: what the instruction says of thing and tool.
        source: where the thing is said to be.
    """

    kind: str
    obj: str | None
    place: str | None = None
    tool: str | None = None
    spoken_obj: Mention | None = None
    spoken_tool: Mention | None = None
    source: str | None = None


@dataclass(frozen=True, slots=True)
class Job:
    """One arm action still to be done.

    Attributes:
        verb: name of an arm or two-arm action.
        target: its object, None when that has to be found first; empty for actions without one.
        arm: the arm that has to do it, None when any free one may, or both do.
        spoken: what to look for when the target is None.
        place: where the target is said to be.
    """

    verb: str
    target: str | None
    arm: Arm | None = None
    spoken: Mention | None = None
    place: str | None = None

    def action(self, arm: Arm | None) -> Action:
        """The grammar's action, done by `arm`."""
        one = arm if ACTIONS[self.verb].kind is ActionKind.ARM else None
        return Action(self.verb, arm=one, object_id=self.target or None)


def holds(want: Want, belief: Belief) -> bool:
    """Whether a want is fulfilled, as far as one can know."""
    obj = want.obj
    if obj is None:
        return False
    if want.kind == "held":
        return belief.state.arm_with(obj) is not None and obj not in belief.state.in_place
    if want.kind == "lifted":
        return belief.state.lifted == obj
    if want.kind == "on":
        return want.place is not None and belief.state.at.get(obj) == want.place
    if want.kind in ("open", "closed"):
        return belief.state.is_in(Condition.OPEN, obj) is (want.kind == "open")
    if want.kind in ("toggled_on", "toggled_off"):
        return belief.state.is_in(Condition.ON, obj) is (want.kind == "toggled_on")
    return belief.done(want.kind, obj)


def next_jobs(wants: Sequence[Want], belief: Belief, known: Sequence[str]) -> list[Job]:
    """Jobs that can be done now; the first one has priority, the others may run beside it on the other arm.

    Returns:
        An empty list when every want is fulfilled, or nothing can be done for the rest.
    """
    pending = [want for want in wants if not holds(want, belief)]
    if not pending:
        return []
    if belief.state.lifted is not None:
        return [_set_down(pending, belief)]
    through = _through_held_door(pending, belief)
    if through:
        return through
    work = [job for want in pending for job in _work(want, belief, known)][:1]
    if work:
        return _with_free_hand(work, wants, belief)
    moves = [want for want in pending if want.kind == "on"]
    light = [want for want in moves if not _is_heavy(want.obj, want.spoken_obj, belief)]
    held = [want for want in pending if want.kind in ("held", "lifted")]
    jobs = [_change(want) for want in pending if want.kind in ("toggled_on", "toggled_off")]
    opening = [_change(want) for want in pending if want.kind == "open"]  # open doors are in the way: rather late
    if len(held) != 1 or held[0].kind == "lifted" or len(belief.state.free_arms()) < 2:
        jobs += opening
    jobs += _carry(light, belief)
    if not moves:
        behind = {want.source for want in held}
        jobs += [_change(want) for want in pending if want.kind == "closed" and want.obj not in behind]
    jobs = jobs or _heavy([want for want in moves if want not in light], belief)
    if not jobs or (len(jobs) == 1 and jobs[0].verb in ("ToggleOn", "ToggleOff", "Open", "Pick")):
        jobs = jobs + [job for want in held for job in _hold(want, belief)]
    jobs += [job for job in opening if job not in jobs]
    return _with_free_hand(list(dict.fromkeys(jobs)), wants, belief)


def _change(want: Want) -> Job:
    """Bringing about a state of a door or switch."""
    return Job(_CHANGES[want.kind], want.obj, None, want.spoken_obj, want.source)


def _is_heavy(obj: str | None, spoken: Mention | None, belief: Belief) -> bool:
    if obj in belief.heavy or obj in belief.light:
        return obj in belief.heavy
    name = type_of(obj) if obj is not None else "" if spoken is None else spoken.name
    return name in _BIG


def _is_shut(place: str | None, belief: Belief) -> TypeGuard[str]:
    if place in belief.state.self_closing:  # no hand holds it: that was seen to before
        return True
    return place is not None and not belief.state.conditions[Condition.OPEN].get(place, type_of(place) not in _SHUT)


def _opening(door: str, belief: Belief) -> Job:
    """Opening a door; one that falls shut and has not quite done so is closed first."""
    ajar = door in belief.state.self_closing and belief.state.is_in(Condition.OPEN, door)
    return Job("Close" if ajar else "Open", door)


def _pick(obj: str | None, spoken: Mention | None, source: str | None, belief: Belief) -> Job:
    """Taking a thing, or the opening of what it is in."""
    place = belief.state.at.get(obj or "", source)
    if _is_shut(place, belief) and ("Open", place) not in belief.never:
        return _opening(place, belief)
    return Job("Pick", obj, None, spoken, place)


def _set_down(pending: Sequence[Want], belief: Belief) -> Job:
    lifted = belief.state.lifted
    for want in pending:
        if want.kind == "on" and want.obj == lifted and want.place is not None:
            return Job("PlaceBoth", want.place)
    return Job("PlaceBoth", belief.state.here if belief.state.here != lifted else None)


def _through_held_door(pending: Sequence[Want], belief: Belief) -> list[Job]:
    """What is left to do through a door that a hand holds open; letting go of it when nothing is."""
    arm = belief.holds_furniture()
    if arm is None:
        return []
    door = belief.state.held[arm]
    other = belief.state.held[arm.other]
    for want in pending:
        if want.kind == "on" and want.place == door and want.obj == other and other is not None:
            return [Job("Place", door, arm.other)]
        if want.kind in ("held", "on") and want.source == door and want.place != door and other is None:
            return [Job("Pick", want.obj, arm.other, want.spoken_obj, door)]
    return [Job("Release", "", arm)]


def _work(want: Want, belief: Belief, known: Sequence[str]) -> list[Job]:
    """The next step towards a state that takes a tool, a vessel or heat."""
    if want.kind in _TOOL_VERBS:
        verb, arm = _TOOL_VERBS[want.kind], belief.state.arm_with(want.tool)
        if arm is None:
            return [_pick(want.tool, want.spoken_tool, None, belief)]
        hangs = any(event.about(verb, want.obj) and event.code == FailureCode.NEEDS_STEADYING for event in belief.last)
        if hangs and belief.state.held[arm.other] == want.obj:  # carried off what it rested on: it has to rest again
            return [Job("Release", "", arm.other)]
        if want.obj in belief.unsteady and want.obj not in belief.state.in_place:
            return [Job("Hold", want.obj, arm.other, want.spoken_obj)]
        return [Job(verb, want.obj, arm, want.spoken_obj, want.source)]
    if want.kind == "used_up":
        return [Job("UseUp", want.obj, None, want.spoken_obj, want.source)]
    if want.kind == "filled":
        return _fill(want, belief, known)
    if want.kind == "cooked" and want.place is not None and belief.state.at.get(want.obj or "") == want.place:
        if belief.state.is_in(Condition.OPEN, want.place) is not False and type_of(want.place) in _SHUT:
            return [Job("Close", want.place)]
        return [Job("ResetArm", "", Arm.RIGHT) if belief.state.is_in(Condition.ON, want.place) else Job("ToggleOn", want.place)]
    return []


def _fill(want: Want, belief: Belief, known: Sequence[str]) -> list[Job]:
    if want.spoken_tool is not None:
        arm = belief.state.arm_with(want.tool)
        if arm is None:
            return [_pick(want.tool, want.spoken_tool, None, belief)]
        return [Job("Pour", want.obj, arm, want.spoken_obj, want.source)]
    bearer = belief.state.arm_with(want.obj)
    if bearer is None:
        return [_pick(want.obj, want.spoken_obj, want.source, belief)]
    taps = [name for name in known if type_of(name) in ("faucet", "coffeemachine")]
    source = want.place or next(iter(taps), None)
    if source is None:
        return []
    if type_of(source) in ("sinkbasin", "bathtubbasin"):
        taps = [name for name in taps if type_of(name) == "faucet" and ("ToggleOn", name) not in belief.never]
    else:
        taps = [source]
    running = [tap for tap in taps if belief.state.is_in(Condition.ON, tap)]
    if not running and taps:
        return [Job("ToggleOn", taps[min(len(belief.failures("Fill", source)), len(taps) - 1)])]
    return [Job("Fill", source, bearer)]


def _carry(light: Sequence[Want], belief: Belief) -> list[Job]:
    """Carrying small things: the hands are filled first, but one stays free for a door that is still shut.

    What is where it belongs already is put down before more is taken.
    """
    in_hand = [want for want in light if belief.state.arm_with(want.obj) is not None]
    waiting = [want for want in light if want not in in_hand]
    if in_hand:  # what may be anywhere is not searched with full hands
        waiting = [want for want in waiting if want.obj is not None or want.source is not None]
    free = belief.state.free_arms()
    door_ahead = any(_is_shut(want.place, belief) for want in in_hand)
    if waiting and free and not door_ahead:
        shut = [want.place for want in waiting if _is_shut(want.place, belief)]
        ajar = [door for door in shut if door not in belief.state.self_closing]
        if ajar and not in_hand and len(waiting) > 1:
            return [Job("Open", ajar[0])]
        room = 1 if shut else len(free)
        here = [want for want in in_hand if want.place == belief.state.here is not None]
        arrived = [Job("Place", want.place, belief.state.arm_with(want.obj)) for want in here]
        return arrived + list(dict.fromkeys(_pick(w.obj, w.spoken_obj, w.source, belief) for w in waiting))[:room]
    jobs = []
    for want in in_hand:
        if _is_shut(want.place, belief) and free:
            jobs.append(_opening(want.place, belief))
        else:
            jobs.append(Job("Place", want.place, belief.state.arm_with(want.obj)))
    return jobs


def _heavy(moves: Sequence[Want], belief: Belief) -> list[Job]:
    for want in moves:
        if _is_shut(want.place, belief):
            return [_opening(want.place, belief)]
        return [Job("Lift", want.obj, None, want.spoken_obj, want.source)]
    return []


def _hold(want: Want, belief: Belief) -> list[Job]:
    if want.kind == "lifted" or _is_heavy(want.obj, want.spoken_obj, belief):
        if want.obj in belief.light:
            return [_pick(want.obj, want.spoken_obj, want.source, belief)]
        return [Job("Lift", want.obj, None, want.spoken_obj, want.source)]
    return [_pick(want.obj, want.spoken_obj, want.source, belief)]


def _with_free_hand(jobs: list[Job], wants: Sequence[Want], belief: Belief) -> list[Job]:
    """The jobs, or first the freeing of a hand that they need."""
    if not jobs:
        return jobs
    head = jobs[0]
    both = head.verb == "Lift"
    needed = head.arm if head.arm is not None and head.verb in ("Hold", "Pick") else None
    if head.arm is not None and needed is None:
        return jobs
    free = belief.state.free_arms()
    if (len(free) == 2) if both else (needed in free if needed is not None else bool(free)):
        return jobs
    tools = {want.tool for want in wants if want.tool is not None and not holds(want, belief)}
    kept = {want.obj for want in wants if want.kind == "held"} | tools | {head.target}
    arms = [arm for arm, item in belief.state.held.items() if item is not None and (needed is None or arm is needed)]
    arms.sort(key=lambda arm: belief.state.held[arm] in kept)
    for arm in arms:
        item = belief.state.held[arm]
        if item in belief.state.in_place or item in belief.state.self_closing:
            return [Job("Release", "", arm)]
        spot = next((want.place for want in wants if want.kind == "on" and want.obj == item), None)
        return [Job("Place", spot or belief.state.here, arm)]
    return jobs
