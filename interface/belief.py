"""What a planner can believe about the world from its own steps and their feedback codes.

The belief is folded anew from the history at every step, so it is a function of what the observation holds. Nothing is assumed
about the start: hands are empty, doors and switches unknown. Paper: feedback of the DualTHOR action space; the belief is a
reference planner's.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final

from interface.actions import ACTIONS, ActionKind, first_refusal
from interface.bodies import Arm
from interface.effects import Become, Condition, Grasp, HoldOpen, LetGo, PutDown, Rise, Turn, Walk
from interface.facts import Affordances, Call, Facts, ObjectFacts, Objects
from interface.failures import FailureCode
from interface.observation import HistoryItem
from interface.steps import Action
from interface.symbolic import Event, SymbolicState, events_of

#: What a hand holds when a code says that it is full and nobody knows of what.
UNKNOWN: Final = "?"
#: Codes after which the other arm may do what one could not.
ARM_SPECIFIC: Final = (FailureCode.OBSTRUCTED, FailureCode.GRASP_MISSED, FailureCode.HANDLE_SLIPPED)
#: Codes after which what was in the hand no longer is.
_LOST_HOLD: Final = (FailureCode.SLIPPED, FailureCode.DROPPED, FailureCode.PLACE_MISSED, FailureCode.BROKE)
#: Codes that say that the action will never work on the object.
_NEVER: Final = (
    FailureCode.NOT_PICKUPABLE,
    FailureCode.TOO_HEAVY,
    FailureCode.NOT_OPENABLE,
    FailureCode.NOT_TOGGLEABLE,
    FailureCode.NOT_RECEPTACLE,
    FailureCode.NOT_SLICEABLE,
    FailureCode.NOT_USABLE,
    FailureCode.NOT_FILLABLE,
)
#: Walks to one thing after which an arm has to try something before the next: where no stance helps, none of them tells why.
ENOUGH_WALKS: Final = 3
#: Kinds of goals that are met for good, as states.
_DONE: Final = {
    "sliced": (Condition.SLICED, True),
    "clean": (Condition.DIRTY, False),
    "used_up": (Condition.USED_UP, True),
    "filled": (Condition.FILLED, True),
}
#: What can be done with what is movable or not, and liftable or not, as far as one can know.
_CAN: Final = {
    (movable, liftable): Affordances(movable=movable, liftable=liftable)
    for movable in (False, True)
    for liftable in (False, True)
}


@dataclass(slots=True)
class Belief:
    """The state of body and world, as far as the feedback tells.

    Attributes:
        state: what the actions that succeeded have made of the world.
        visited: everything it went to.
        heavy, light: what needs both hands; what cannot be lifted with both.
        unsteady: what has to be held under a tool.
        shut_away: objects in something closed.
        broken: broken objects.
        never: (verb, id) that will never work, and why.
        fails: failures of (verb, id) since the last arm action that succeeded.
        stances: walks to an object since then.
        untried: walks that reached an object since an arm last tried anything.
        heights: changes of pelvis height at the present stance, metres, upwards positive.
        at_limit: directions in which the legs are at their end.
        lowered_m: how much lower the pelvis is than at the start, as far as it was asked to.
        bearing_deg: bearing that the last GoTo asked for.
        blocked: walks that were blocked since one succeeded.
        too_far: what was out of reach from the present stance.
        let_shut: how often a door that falls shut was let go of, by door.
        last: events of the newest step.
    """

    state: SymbolicState = field(default_factory=SymbolicState)
    visited: set[str] = field(default_factory=set)
    heavy: set[str] = field(default_factory=set)
    light: set[str] = field(default_factory=set)
    unsteady: set[str] = field(default_factory=set)
    shut_away: set[str] = field(default_factory=set)
    broken: set[str] = field(default_factory=set)
    never: dict[tuple[str, str], FailureCode] = field(default_factory=dict)
    fails: dict[tuple[str, str], list[Event]] = field(default_factory=dict)
    stances: dict[str, int] = field(default_factory=dict)
    untried: dict[str, int] = field(default_factory=dict)
    heights: list[float] = field(default_factory=list)
    at_limit: set[bool] = field(default_factory=set)
    lowered_m: float = 0.0
    bearing_deg: float = 0.0
    blocked: int = 0
    too_far: set[str] = field(default_factory=set)
    let_shut: dict[str, int] = field(default_factory=dict)
    last: tuple[Event, ...] = ()
    _opened: tuple[Arm, str] | None = None

    @staticmethod
    def of(history: Sequence[HistoryItem], self_closing: Sequence[str] = ()) -> Belief:
        """Folds a history.

        Args:
            history: earlier steps, oldest first; lines outside the grammar are passed over.
            self_closing: doors of which the instruction says that they fall shut.
        """
        belief = Belief(SymbolicState(self_closing=set(self_closing)))
        belief.state.conditions[Condition.OPEN] |= dict.fromkeys(self_closing, False)
        for events in events_of(history):
            for event in sorted(events, key=lambda event: not event.ok):  # a success forgets failures, but not its own step's
                belief._take(event)
            belief.last = events
        return belief

    @property
    def failed(self) -> Event | None:
        """What went wrong in the newest step, None when nothing did."""
        return next((event for event in self.last if not event.ok), None)

    def walked_enough(self, action: Action) -> bool:
        """Whether an action walks on where walks alone have not helped."""
        return action.spec.has_effect(Walk) and self.untried.get(self.state.here or "", 0) >= ENOUGH_WALKS

    def holds_furniture(self) -> Arm | None:
        """The arm that holds a door open."""
        return next((arm for arm, item in self.state.held.items() if item in self.state.self_closing), None)

    def done(self, kind: str, object_id: str) -> bool:
        """Whether an object is known to have been sliced, cleaned, used up or filled; whether food is done nobody tells."""
        if kind not in _DONE:
            return False
        condition, value = _DONE[kind]
        return self.state.is_in(condition, object_id) is value

    def refusal(self, call: Call) -> FailureCode | None:
        """The code with which an action is bound to be refused, None where nothing is known against it."""
        if call.object_id is not None and (call.name, call.object_id) in self.never:
            return self.never[call.name, call.object_id]
        arm, door = self._opened or (None, None)  # whether it falls shut is not always told
        spec = ACTIONS[call.name]
        if (spec.has_effect(LetGo) and call.arm is arm) or (spec.has_effect(HoldOpen) and call.object_id == door):
            return None
        found = first_refusal(call, self.facts())
        return None if found is None else found.code

    def facts(self) -> Facts:
        """What is known as facts; of anything one can do what nothing is known against."""
        return Facts(Objects((), self._facts_of), self.state.held, self.state.lifted)

    def _facts_of(self, name: str) -> ObjectFacts:
        state = self.state
        opened, place = state.is_in(Condition.OPEN, name), state.at.get(name)
        return ObjectFacts(
            object_id=name,
            can=_CAN[name not in state.self_closing, name not in self.light],
            holders=state.holders(name),
            carriers=() if place is None else (place,),
            two_handed=name in self.heavy,
            openness=0.5 if opened is None else float(opened),
            on=state.is_in(Condition.ON, name),
            fill=0.5,
            dirty=state.is_in(Condition.DIRTY, name) is not False,
            sliced=state.is_in(Condition.SLICED, name) is True,
            used_up=state.is_in(Condition.USED_UP, name) is True,
            broken=name in self.broken,
            outlet=name,
        )

    def failures(self, verb: str, target: str | None) -> list[Event]:
        """What went wrong with an action since the last success."""
        return self.fails.get((verb, target or ""), [])

    def _take(self, event: Event) -> None:
        action, target = event.action, event.action.object_id or ""
        if action.spec.arms:
            self.untried.clear()
        if action.spec.has_effect(Walk, Turn):
            if action.object_id is not None:
                self.stances[target] = self.stances.get(target, 0) + 1
                self.bearing_deg = action.bearing_deg or 0.0
            self.heights.clear()
            self.too_far.clear()
            self.blocked += event.code == FailureCode.BLOCKED_PATH
        elif action.spec.has_effect(Rise) and event.code in ("ok", FailureCode.HEIGHT_LIMIT):  # at the limit a part was done
            rise_m = sum(effect.sign for effect in action.spec.effects if isinstance(effect, Rise)) * action.given_amount
            self.heights.append(rise_m)
            self.lowered_m -= rise_m if event.ok else 0.5 * rise_m
            self.at_limit = set() if event.ok else {rise_m > 0}
        if event.ok:
            self._succeeded(action, target)
            return
        self.fails.setdefault((action.name, target), []).append(event)
        if event.code in (FailureCode.BROKE, FailureCode.OBJECT_BROKEN):
            held = None if action.arm is None else self.state.held[action.arm]
            of_tool = any(isinstance(effect, Become) and effect.of == "tool" for effect in action.spec.effects)
            self.broken.add(held or target if of_tool or action.spec.has_effect(PutDown) else target)
        self._failed(action, target, event.code)

    def _succeeded(self, action: Action, target: str) -> None:
        held = None if action.arm is None else self.state.held[action.arm]
        if action.spec.has_effect(LetGo) and held is not None and held in self.state.self_closing:
            self.let_shut[held] = self.let_shut.get(held, 0) + 1
        self.state.succeed(action)
        if action.spec.has_effect(Walk, Turn) and action.object_id is not None:
            self.visited.add(target)
            self.untried[target] = self.untried.get(target, 0) + 1
            self.blocked = 0
        if action.spec.kind is ActionKind.BODY or not action.spec.effects:
            return
        self.fails.clear()
        self.stances.clear()
        if action.spec.has_effect(Grasp):
            self.shut_away.discard(target)
        if action.spec.has_effect(HoldOpen) and action.arm is not None:
            self._opened = (action.arm, target)

    def _failed(self, action: Action, target: str, code: str) -> None:
        arm, state = action.arm, self.state
        if code in (FailureCode.ALREADY_IN_STATE, FailureCode.NOT_DIRTY):
            state.settle(action)
        elif code == FailureCode.TOO_FAR:
            self.too_far.add(target)
        elif code in _LOST_HOLD and action.spec.has_effect(Grasp, PutDown):
            state.lifted = None if arm is None else state.lifted
            if arm is not None:
                state.held[arm] = None
        elif code == FailureCode.HAND_EMPTY and arm is not None:
            state.let_go(arm)
        elif code == FailureCode.HAND_OCCUPIED and arm is not None and state.held[arm] is None:
            state.held[arm] = self._opened[1] if self._opened is not None and self._opened[0] is arm else UNKNOWN
        elif code == FailureCode.IN_USE and action.spec.has_effect(Walk, Turn) and self._opened is not None:
            state.self_closing = {*state.self_closing, self._opened[1]}  # the door is still in the hand
            state.held[self._opened[0]] = self._opened[1]
        elif code == FailureCode.ALREADY_HELD and arm is not None and state.arm_with(target) is None:
            state.held[arm.other] = target
        elif code == FailureCode.RECEPTACLE_CLOSED:
            if action.spec.has_effect(PutDown):
                state.conditions[Condition.OPEN][target] = False
            else:
                self.shut_away.add(target)
                if self._opened is not None:  # it has fallen shut, or was brushed
                    state.conditions[Condition.OPEN][self._opened[1]] = False
        elif code == FailureCode.NEEDS_TWO_HANDS:
            self.heavy.add(target)
        elif code == FailureCode.NOT_LIFTABLE:
            self.light.add(target)
        elif code == FailureCode.NEEDS_STEADYING:
            self.unsteady.add(target)
        elif code == FailureCode.SOURCE_OFF:
            state.conditions[Condition.ON].clear()
        elif code in _NEVER:
            self.never[action.name, target] = FailureCode(code)
