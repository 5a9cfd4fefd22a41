"""What a planner can believe about the world from its own steps and their feedback codes.

The belief is folded anew from the history at every step, so it is a function of what the observation holds. Nothing is assumed
about the start: hands are empty, doors and switches unknown. Paper: feedback of the DualTHOR action space; the belief is a
reference planner's.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final

from data.interface.bodies import Arm
from data.interface.observation import HistoryItem
from data.interface.steps import Action, ActionError

__all__ = ["UNKNOWN", "Belief", "Event"]

#: What a hand holds when a code says that it is full and nobody knows of what.
UNKNOWN: Final = "?"
_WORK: Final = {"Slice": "sliced", "Clean": "clean", "UseUp": "used_up", "Pour": "filled"}
_SWITCH: Final = {"ToggleOn": True, "ToggleOff": False}
_DOOR: Final = {"Open": True, "Close": False}
_BASE: Final = ("GoTo", "MoveAhead", "MoveBack", "MoveLeft", "MoveRight", "RotateLeft", "RotateRight")
#: Changes of pelvis height and their sign.
_LEGS: Final = {"MoveUp": 1.0, "MoveDown": -1.0}
#: Codes after which what was in the hand no longer is.
_LOST_HOLD: Final = ("Slipped", "Dropped", "PlaceMissed", "Broke")
#: Codes that say that the action will never work on the object.
_NEVER: Final = (
    "NotPickupable", "TooHeavy", "NotOpenable", "NotToggleable", "NotReceptacle", "NotSliceable", "NotUsable", "NotFillable",
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class Event:
    """One action of the history and its code, `ok` when it succeeded."""

    action: Action
    code: str

    @property
    def ok(self) -> bool:
        """Whether the action succeeded."""
        return self.code == "ok"

    def about(self, verb: str, target: str | None) -> bool:
        """Whether it was this verb on this object, with either arm."""
        return self.action.name == verb and self.action.object_id == target


@dataclass(slots=True)
class Belief:
    """The state of body and world, as far as the feedback tells.

    Attributes:
        hands: what each hand holds; furniture where it holds a door open.
        lifted: what both hands hold.
        held_in_place: objects that a hand steadies where they rest.
        doors: whether something is open.
        switches: whether something is switched on.
        at: where something was put.
        done: (`sliced` …, id) that has been brought about.
        here: what the robot went to last, None after it has stepped aside.
        visited: everything it went to.
        heavy, light: what needs both hands; what cannot be lifted with both.
        self_closing: doors that fall shut.
        unsteady: what has to be held under a tool.
        shut_away: objects in something closed.
        broken: broken objects.
        never: (verb, id) that will never work.
        fails: failures of (verb, id) since the last arm action that succeeded.
        stances: walks to an object since then.
        heights: changes of pelvis height at the present stance, metres, upwards positive.
        at_limit: directions in which the legs are at their end.
        lowered_m: how much lower the pelvis is than at the start, as far as it was asked to.
        bearing_deg: bearing that the last GoTo asked for.
        blocked: walks that were blocked since one succeeded.
        last: events of the newest step.
    """

    hands: dict[Arm, str | None] = field(default_factory=lambda: {Arm.RIGHT: None, Arm.LEFT: None})
    lifted: str | None = None
    held_in_place: set[str] = field(default_factory=set)
    doors: dict[str, bool] = field(default_factory=dict)
    switches: dict[str, bool] = field(default_factory=dict)
    at: dict[str, str] = field(default_factory=dict)
    done: set[tuple[str, str]] = field(default_factory=set)
    here: str | None = None
    visited: set[str] = field(default_factory=set)
    heavy: set[str] = field(default_factory=set)
    light: set[str] = field(default_factory=set)
    self_closing: set[str] = field(default_factory=set)
    unsteady: set[str] = field(default_factory=set)
    shut_away: set[str] = field(default_factory=set)
    broken: set[str] = field(default_factory=set)
    never: set[tuple[str, str]] = field(default_factory=set)
    fails: dict[tuple[str, str], list[Event]] = field(default_factory=dict)
    stances: dict[str, int] = field(default_factory=dict)
    heights: list[float] = field(default_factory=list)
    at_limit: set[bool] = field(default_factory=set)
    lowered_m: float = 0.0
    bearing_deg: float = 0.0
    blocked: int = 0
    last: tuple[Event, ...] = ()
    _opened: tuple[Arm, str] | None = None

    @staticmethod
    def of(history: Sequence[HistoryItem], self_closing: Sequence[str] = ()) -> Belief:
        """Folds a history.

        Args:
            history: earlier steps, oldest first; lines outside the grammar are passed over.
            self_closing: doors of which the instruction says that they fall shut.
        """
        belief = Belief(self_closing=set(self_closing))
        for item in history:
            events = []
            for outcome in item.feedback.split("; "):
                text, _, code = outcome.rpartition(" ")
                try:
                    events.append(Event(Action.parse(text), code))
                except ActionError:
                    continue
            for event in sorted(events, key=lambda event: not event.ok):  # a success forgets failures, but not its own step's
                belief._take(event)
            belief.last = tuple(events)
        return belief

    def free_arms(self) -> tuple[Arm, ...]:
        """Empty hands, the right one first."""
        return () if self.lifted is not None else tuple(arm for arm, item in self.hands.items() if item is None)

    def arm_with(self, object_id: str | None) -> Arm | None:
        """The arm that holds an object."""
        return next((arm for arm, item in self.hands.items() if item is not None and item == object_id), None)

    def holds_furniture(self) -> Arm | None:
        """The arm that holds a door open."""
        return next((arm for arm, item in self.hands.items() if item in self.self_closing), None)

    def failures(self, verb: str, target: str | None) -> list[Event]:
        """What went wrong with an action since the last success."""
        return self.fails.get((verb, target or ""), [])

    def _take(self, event: Event) -> None:
        action, target = event.action, event.action.object_id or ""
        if action.name == "GoTo":
            self.stances[target] = self.stances.get(target, 0) + 1
            self.bearing_deg = action.bearing_deg or 0.0
        if action.name in _BASE:
            self.heights.clear()
            self.blocked += event.code == "BlockedPath"
        elif action.name in _LEGS and event.code in ("ok", "HeightLimit"):  # at the limit a part of it was done
            rise_m = _LEGS[action.name] * (action.amount or 0.1)
            self.heights.append(rise_m)
            self.lowered_m -= rise_m if event.ok else 0.5 * rise_m
            self.at_limit = set() if event.ok else {rise_m > 0}
        if event.ok:
            self._succeeded(action, target)
            return
        self.fails.setdefault((action.name, target), []).append(event)
        if event.code in ("Broke", "ObjectBroken"):
            held = None if action.arm is None else self.hands[action.arm]
            self.broken.add(held or target if action.name == "Place" else target)
        self._failed(action, target, event.code)

    def _succeeded(self, action: Action, target: str) -> None:
        arm, name = action.arm, action.name
        if name == "GoTo":
            self.here = target
            self.visited.add(target)
            self.blocked = 0
        elif name.startswith("Move") and name not in _LEGS:
            self.here = None
        if name in _BASE or name in _LEGS or name == "ResetArm":
            return
        self.fails.clear()
        self.stances.clear()
        if name in ("Pick", "Hold") and arm is not None:
            self.hands[arm] = target
            self.at.pop(target, None)
            self.shut_away.discard(target)
            if name == "Hold":
                self.held_in_place.add(target)
        elif name == "Place" and arm is not None:
            self._put(self.hands[arm], target)
            self.hands[arm] = None
        elif name == "Release" and arm is not None:
            self._let_go(arm)
        elif name == "Lift":
            self.lifted = target
            self.at.pop(target, None)
        elif name == "PlaceBoth":
            self._put(self.lifted, target)
            self.lifted = None
        elif name == "Fill" and arm is not None:
            self.done.add(("filled", self.hands[arm] or ""))
        else:
            self._in_state(action, target)
        if name == "Open" and arm is not None:
            self._opened = (arm, target)
            if target in self.self_closing:
                self.hands[arm] = target

    def _put(self, item: str | None, target: str) -> None:
        if item is not None:
            self.at[item] = target

    def _let_go(self, arm: Arm) -> None:
        item = self.hands[arm]
        self.hands[arm] = None
        if item is not None:
            self.held_in_place.discard(item)
            if item in self.self_closing:
                self.doors[item] = False

    def _in_state(self, action: Action, target: str) -> None:
        """An object is in the state that an action makes."""
        if action.name in _DOOR:
            self.doors[target] = _DOOR[action.name]
        elif action.name in _SWITCH:
            self.switches[target] = _SWITCH[action.name]
        elif action.name in _WORK:
            self.done.add((_WORK[action.name], target))

    def _failed(self, action: Action, target: str, code: str) -> None:
        arm = action.arm
        if code in ("AlreadyInState", "NotDirty"):
            self._in_state(action, target)
            if action.name == "Fill" and arm is not None:
                self.done.add(("filled", self.hands[arm] or ""))
        elif code in _LOST_HOLD and action.name in ("Pick", "Place", "Lift", "PlaceBoth"):
            self.lifted = None if action.name in ("Lift", "PlaceBoth") else self.lifted
            if arm is not None:
                self.hands[arm] = None
        elif code == "HandEmpty" and arm is not None:
            self._let_go(arm)
        elif code == "HandOccupied" and arm is not None and self.hands[arm] is None:
            self.hands[arm] = self._opened[1] if self._opened is not None and self._opened[0] is arm else UNKNOWN
        elif code == "InUse" and action.name in _BASE and self._opened is not None:  # the door is still in the hand
            self.self_closing.add(self._opened[1])
            self.hands[self._opened[0]] = self._opened[1]
        elif code == "AlreadyHeld" and arm is not None and self.arm_with(target) is None:
            self.hands[arm.other] = target
        elif code == "ReceptacleClosed":
            if action.name in ("Place", "PlaceBoth"):
                self.doors[target] = False
            else:
                self.shut_away.add(target)
                if self._opened is not None:  # it has fallen shut, or was brushed
                    self.doors[self._opened[1]] = False
        elif code == "NeedsTwoHands":
            self.heavy.add(target)
        elif code == "NotLiftable":
            self.light.add(target)
        elif code == "NeedsSteadying":
            self.unsteady.add(target)
        elif code == "SourceOff":
            self.switches.clear()
        elif code in _NEVER:
            self.never.add((action.name, target))
