"""The world as the table of actions changes it: what one knows after some actions have succeeded, without looking.

The text world, the planners' beliefs and the questions about a log all fold actions into this state.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, field

from interface.actions import ACTIONS, given_amount
from interface.bodies import Arm
from interface.effects import Become, Condition, Effect, Grasp, HoldOpen, LetGo, PutDown, Rise, Walk
from interface.facts import Call
from interface.observation import HistoryItem
from interface.steps import Action, ActionError


@dataclass(frozen=True, slots=True)
class Event:
    """One action of a log and its failure code, `ok` when it succeeded."""

    action: Action
    code: str

    @property
    def ok(self) -> bool:
        """Whether the action succeeded."""
        return self.code == "ok"

    def about(self, verb: str, target: str | None) -> bool:
        """Whether it was this verb on this object, with either arm."""
        return self.action.name == verb and self.action.object_id == target


def events_of(history: Sequence[HistoryItem]) -> Iterator[tuple[Event, ...]]:
    """The events of each step of a log, oldest first; what is outside the grammar is passed over."""
    for item in history:
        events: list[Event] = []
        for outcome in item.feedback.split(";"):
            text, _, code = outcome.strip().rpartition(" ")
            try:
                events.append(Event(Action.parse(text), code))
            except ActionError:
                continue
        yield tuple(events)


@dataclass(slots=True)
class SymbolicState:
    """Who holds what, what stands on what, and the states of objects, as far as known.

    Attributes:
        held: what each hand holds by itself; furniture where it holds a door open.
        lifted: what both hands hold together.
        in_place: objects that a hand steadies where they rest.
        at: receptacle by object.
        conditions: by state, which objects are known to be in it or not.
        here: what the robot went to last, None after it has moved away.
        rise_m: change of pelvis height since the start, metres, upwards positive.
        self_closing: doors and drawers that fall shut.
    """

    held: dict[Arm, str | None] = field(default_factory=lambda: {Arm.RIGHT: None, Arm.LEFT: None})
    lifted: str | None = None
    in_place: set[str] = field(default_factory=set)
    at: dict[str, str] = field(default_factory=dict)
    conditions: dict[Condition, dict[str, bool]] = field(default_factory=lambda: {one: {} for one in Condition})
    here: str | None = None
    rise_m: float = 0.0
    self_closing: Collection[str] = ()

    def free_arms(self) -> tuple[Arm, ...]:
        """Empty hands, the right one first."""
        return () if self.lifted is not None else tuple(arm for arm, item in self.held.items() if item is None)

    def arm_with(self, object_id: str | None) -> Arm | None:
        """The arm that holds an object."""
        return next((arm for arm, item in self.held.items() if item is not None and item == object_id), None)

    def holds(self, object_id: str) -> bool:
        """Whether an object is held up, by one hand or both; what is steadied where it rests is not."""
        return bool(self.holders(object_id)) and object_id not in self.in_place

    def holders(self, object_id: str) -> tuple[str, ...]:
        """The arms that hold an object, at furniture its door."""
        return tuple(arm.value for arm in Arm if object_id in (self.held[arm], self.lifted))

    def is_in(self, condition: Condition, object_id: str) -> bool | None:
        """Whether an object is in a state, None when that is not known."""
        return self.conditions[condition].get(object_id)

    def succeed(self, call: Call) -> None:
        """Carries out the effects of an action that succeeded."""
        for effect in ACTIONS[call.name].effects:
            self._carry_out(effect, call)

    def settle(self, call: Call) -> None:
        """The states that an action makes hold already, as `AlreadyInState` tells."""
        for effect in ACTIONS[call.name].effects:
            if isinstance(effect, Become):
                self._carry_out(effect, call)

    def let_go(self, arm: Arm) -> None:
        """A hand lets go; a door with a spring falls shut, or nearly so: nobody tells."""
        item, self.held[arm] = self.held[arm], None
        if item is not None:
            self.in_place.discard(item)
            if item in self.self_closing:
                self.conditions[Condition.OPEN].pop(item, None)

    def _carry_out(self, effect: Effect, call: Call) -> None:
        target = call.object_id or ""
        match effect:
            case Become(condition, value, of):
                item = target if of == "target" else self._in_hands(call)
                if item and value is None:
                    self.conditions[condition].pop(item, None)
                elif item and value is not None:
                    self.conditions[condition][item] = value
            case Grasp(in_place):
                self._grasp(call, target, in_place)
            case HoldOpen() if target in self.self_closing and call.arm is not None:
                self.held[call.arm] = target
            case PutDown():
                item = self._in_hands(call)
                if item is not None:
                    self.at[item] = target
                self._empty(call)
            case LetGo() if call.arm is not None:
                if self.lifted is not None:  # the other hand alone still has it
                    self.held[call.arm.other], self.lifted = self.lifted, None
                else:
                    self.let_go(call.arm)
            case Walk(to_target):
                self.here = target if to_target else None
            case Rise(sign):
                self.rise_m += sign * given_amount(call)
            case _:
                pass

    def _grasp(self, call: Call, target: str, in_place: bool) -> None:
        if call.arm is None:
            self.lifted = target
        else:
            self.held[call.arm] = target
        if in_place:
            self.in_place.add(target)
        else:
            self.in_place.discard(target)
            self.at.pop(target, None)

    def _in_hands(self, call: Call) -> str | None:
        return self.lifted if call.arm is None else self.held[call.arm]

    def _empty(self, call: Call) -> None:
        item = self._in_hands(call)
        if call.arm is None:
            self.lifted = None
        else:
            self.held[call.arm] = None
        self.in_place.discard(item or "")
