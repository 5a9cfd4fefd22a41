"""The text world: a robot among facts, where what an action does is what the table of actions says.

Preconditions and effects come from `interface.actions`, so every action is there with its failure codes. What the table
does not know is drawn here, because it follows from geometry in the simulator: what one stands at, which things there are near
enough, from which pelvis heights the arms reach a piece of furniture, what comes into view, and what now and then does not work
from a stance.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import Final

import numpy as np

from interface.actions import ACTIONS, ActionKind, exclude_each_other, first_refusal
from interface.bodies import Arm
from interface.effects import Condition, PutDown
from interface.failures import FailureCode
from interface.steps import Action, PlanStep
from robots.spec import RobotSpec
from sim.collection.text_facts import TextFacts
from sim.expert.jobs import Setting, plan_jobs
from sim.session.contingency import CODES, Contingency, load_contingency, subject_of
from sim.tasks.drafts import Draft, Scene

_HEIGHT_STEP_M: Final = 0.05
#: Pelvis heights relative to upright, metres: those at the start, the lowest ones of a robot in its room, the highest one.
_STARTS_M: Final = (0.0, -0.05, -0.1, -0.2, -0.3)
_LOWEST_M: Final = (-0.25, -0.35, -0.5)
_HIGHEST_M: Final = 0.0
#: Difficulties of episodes, with the share that has each.
_DIFFICULTIES: Final = {"easy": 0.5, "natural": 0.2, "medium": 0.2, "hard": 0.1}
#: How often physics says the same to an action that was right, every time from the same stance.
_AWKWARD: Final = 0.08
#: How often what one has walked to is still out of reach: arms that are solved apart from the waist do not lean. Some things
#: lie so that it is nearly always: how many of them, and how often then. These and the next figures were measured with the
#: teacher's steps.
_FAR: Final = {"whole_body": 0.04, "per_arm": 0.22}
_AWKWARD_PLACE: Final = {"whole_body": 0.06, "per_arm": 0.1}
_FAR_THERE: Final = 0.75
#: How often the other things there are in reach too, and how often nothing is after a turn or a step.
_BESIDE: Final = {"whole_body": 0.85, "per_arm": 0.5}
_AWAY: Final = {"whole_body": 0.25, "per_arm": 0.9}
#: How often a walk, a turn or a step aside is blocked, and how often a walk to a chosen distance has no free end.
_BLOCKED: Final = {"GoTo": 0.025, "RotateLeft": 0.05, "RotateRight": 0.05}
_BLOCKED_STEP: Final = 0.2
_NO_POSE: Final = 0.04
#: How often each thing in front is seen on arrival, and with each further look that shows more of it.
_AT_ONCE: Final = 0.75
_LOOK: Final = {"MoveUp": 0.6, "MoveDown": 0.1}
_LOOK_ASIDE: Final = 0.4
#: How often a door with a spring does not fall quite shut.
_AJAR: Final = {"whole_body": 0.05, "per_arm": 0.5}
#: How far, up and down, the pelvis may be from the height at which a piece of furniture is reached best, metres.
_BAND_M: Final = {"whole_body": (0.05, 0.2), "per_arm": (0.15, 0.4)}
#: Codes that come back from the same stance every time.
_MISHAPS: Final = (
    FailureCode.GRASP_MISSED,
    FailureCode.OBSTRUCTED,
    FailureCode.HANDLE_SLIPPED,
    FailureCode.TOOL_MISSED,
    FailureCode.POUR_MISSED,
    FailureCode.RECEPTACLE_FULL,
)
_FREE_ARMS: Final = (Arm.RIGHT, Arm.LEFT)
_MOVES: Final = tuple(name for name, spec in ACTIONS.items() if spec.kind is ActionKind.BODY and not spec.takes_object)
_LEGS: Final = ("MoveUp", "MoveDown")
#: The rules of chance, read once: an episode takes less time than their file.
_rules = functools.cache(load_contingency)


def feedback_text(outcomes: Sequence[tuple[Action, str]]) -> str:
    """What a log says of a step that `TextWorld.take` carried out."""
    return "; ".join(f"{action.to_text()} {code}" for action, code in outcomes)


class TextWorld:
    """Facts about one room and one robot, where the robot stands, and what it sees.

    Attributes:
        facts: objects and hands.
        seen: movable objects seen so far.
        visible: ids in view, furniture first.
    """

    def __init__(self, draft: Draft, scene: Scene, robot: RobotSpec, rng: np.random.Generator) -> None:
        self._draft, self._scene, self._rng, self._solver = draft, scene, rng, robot.solver
        self.facts = TextFacts(draft, scene, robot)
        difficulty = str(rng.choice(list(_DIFFICULTIES), p=list(_DIFFICULTIES.values())))
        self._contingency = Contingency(_rules(), difficulty, 0)
        self._height_m = float(rng.choice(_STARTS_M))
        self._lowest_m = float(rng.choice(_LOWEST_M))
        self._bands = {name: self._band() for name in scene.furniture}
        self.seen: set[str] = set()
        self.visible: list[str] = []
        self._last: Action | None = None
        #: What does not work from this stance.
        self._awkward: dict[Action, FailureCode] = {}
        self._at, self._front, self._near = "", "", set[str]()
        far = _FAR[self._solver]
        hard = {name: rng.random() < _AWKWARD_PLACE[self._solver] for name in (*scene.furniture, *draft.objects)}
        self._far = {name: _FAR_THERE if is_hard else far for name, is_hard in hard.items()}
        focus = next(iter(draft.focus.values()))
        there = rng.random() < 0.45
        self._arrive(
            (focus if focus in scene.furniture else draft.objects[focus]) if there else str(rng.choice(scene.furniture)),
            near=False,
        )
        if rng.random() < 0.6:
            self._at = ""

    # ---- facts

    def known(self) -> list[str]:
        """Ids that actions may name: furniture, and everything seen so far."""
        return [*self._scene.furniture, *(name for name in self.facts.objs if name in self.seen)]

    def _band(self) -> tuple[float, float]:
        """Pelvis heights from which the arms reach what a piece of furniture carries."""
        middle = float(self._rng.choice((-0.05, -0.05, -0.05, -0.1, -0.2, -0.35)))
        half = float(self._rng.uniform(*_BAND_M[self._solver]))
        return middle - half, middle + half

    def _place(self, name: str) -> str | None:
        """The furniture that an object is on, in or a part of; None when it is in a hand."""
        if name in self._bands:
            return name
        return next((carrier for carrier in self.facts.carriers(name) if carrier in self._bands), None)

    def _standing_at(self, place: str) -> list[str]:
        """What is open to view on or in a piece of furniture."""
        return [name for name in self.facts.objs if self._place(name) == place and not self.facts.hidden(name)]

    def _reaches(self, name: str) -> bool:
        place = self._place(name)
        if place is None:
            return True  # a hand has it
        return place == self._at and (name in self._near or (name == self._at and bool(self._near)))

    def _misfit_m(self, name: str) -> float:
        """Change of height that brings an object into reach, 0 when it is."""
        place = self._place(name)
        if place is None:
            return 0.0
        low, high = self._bands[place]
        if low - 1e-6 <= self._height_m <= high + 1e-6:
            return 0.0
        gap = low - self._height_m if self._height_m < low else high - self._height_m
        amount = float(np.ceil(abs(gap) / _HEIGHT_STEP_M - 1e-6)) * _HEIGHT_STEP_M
        return float(np.copysign(amount, gap))

    def _arrive(self, place: str, near: bool = True, wanted: str = "") -> None:
        """Stands in front of a piece of furniture and looks."""
        if place != self._at:
            self._awkward.clear()
        self._at = self._front = place
        ids = self._scene.furniture
        here = ids.index(place)
        beside = [ids[i] for i in range(max(0, here - 2), min(len(ids), here + 3)) if i != here and self._rng.random() < 0.4]
        shown = {place, *beside}
        objs = [name for name in self.facts.objs if self._place(name) in shown and not self.facts.hidden(name)]
        seen = [name for name in objs if name == wanted or self._rng.random() < _AT_ONCE]
        self.seen.update(seen)
        self.visible = [*(name for name in ids if name in shown), *(name for name in self.facts.objs if name in seen)]
        self._near = set()
        if near:
            self._near = {
                name
                for name in objs
                if self._rng.random() < (1.0 - self._far[name] if name == wanted else _BESIDE[self._solver])
            }
            if wanted != place or self._rng.random() >= self._far[place]:
                self._near.add(place)

    def done(self) -> bool:
        """Whether every goal holds."""
        return not plan_jobs(self._draft.goals, Setting(self.facts.now(), self.facts.homes))

    # ---- what actions do

    def take(self, step: PlanStep) -> list[tuple[Action, str]]:
        """Carries a step out; each action with `ok` or its failure code."""
        if len(step.actions) == 2 and exclude_each_other(*step.actions):
            return [(action, FailureCode.ARM_CONFLICT) for action in step.actions]
        return [(action, self._act(action)) for action in step.actions]

    def _act(self, action: Action) -> str:
        self._last = action
        target = action.object_id or ""
        if target and target not in self.known():
            return FailureCode.OBJECT_NOT_KNOWN
        refusal = first_refusal(action, self.facts.now())
        if refusal is not None:
            return refusal.code
        if action.spec.kind is ActionKind.BODY:
            return self._move(action)
        if target and (code := self._physics(action, target)):
            return code
        self._awkward.clear()
        self._change(action)
        return "ok"

    def _physics(self, action: Action, target: str) -> str:
        """What only moving tells; empty when it works."""
        if not self._reaches(target):
            return FailureCode.TOO_FAR
        misfit = self._misfit_m(target)
        if misfit:
            return FailureCode.BODY_TOO_LOW if misfit > 0 else FailureCode.BODY_TOO_HIGH
        if action in self._awkward:
            return self._awkward[action]
        codes = [code for code in _MISHAPS if code in action.spec.meets]
        if codes and self._rng.random() < _AWKWARD:
            self._awkward[action] = codes[int(self._rng.integers(len(codes)))]
            return self._awkward[action]
        return self._chance(action)

    def _chance(self, action: Action) -> str:
        """What chance makes of an action that would work; empty when nothing."""
        subject = subject_of(action, self._held(action))
        item = self.facts.object(subject)
        state = {"isFilledWithLiquid": item.fill > 0.0, "isToggled": item.on, "isDirty": item.dirty, "isBroken": item.broken}
        shares = self._contingency.distribution(action.name, subject.rpartition("_")[0], state)
        outcome = str(self._rng.choice(list(shares), p=list(shares.values())))
        if outcome in ("spilled", "broken"):
            self.facts.harm(subject, breaks=outcome == "broken")
        if outcome == "broken" and action.spec.has_effect(PutDown):  # it lies where it was to stand
            self._change(action)
        return CODES.get(outcome, "")

    def _held(self, action: Action) -> str | None:
        state = self.facts.state
        return state.lifted if action.arm is None else state.held[action.arm]

    def _move(self, action: Action) -> str:
        target = action.object_id
        if target is not None:
            place = self._place(target)
            if place is None or (action.amount is not None and self._rng.random() < _NO_POSE):
                return FailureCode.NO_FREE_POSE
            if self._rng.random() < _BLOCKED[action.name]:
                return FailureCode.BLOCKED_PATH
            if place == self._at and self._awkward and (action.bearing_deg or action.amount):  # the plain stance is the old one
                self._awkward.clear()
            self._arrive(place, wanted=target)
        elif action.name in _LEGS:
            change = action.given_amount * (1 if action.name == "MoveUp" else -1)
            if not self._lowest_m <= self._height_m + change <= _HIGHEST_M:
                self._height_m = _HIGHEST_M if change > 0 else self._lowest_m
                self._awkward.clear()
                return FailureCode.HEIGHT_LIMIT
            self._height_m += change
            self._awkward.clear()
            self._look(_LOOK[action.name])
        elif self._rng.random() < _BLOCKED.get(action.name, _BLOCKED_STEP):
            return FailureCode.BLOCKED_PATH
        else:
            self._look_around()
        self.facts.succeed(action, self._at)
        return "ok"

    def _look_around(self) -> None:
        """After a turn or a step the stance is another one."""
        self._awkward.clear()
        self._look(_LOOK_ASIDE)
        if self._rng.random() < _AWAY[self._solver]:
            self._near = set()

    def _look(self, share: float) -> None:
        """Some of what stands in front comes into view."""
        objs = [name for name in self._standing_at(self._front) if self._rng.random() < share]
        self.seen.update(objs)
        self.visible += [name for name in objs if name not in self.visible]

    def _change(self, action: Action) -> None:
        target = action.object_id or ""
        state, held = self.facts.state, self._held(action)
        shut = self.facts.hidden
        before = {name for name in self.facts.objs if shut(name)}
        self.facts.succeed(action, self._at or self._scene.surfaces[0])
        if action.spec.has_effect(PutDown) and held is not None:
            self._near.add(held)
        if held is not None and state.is_in(Condition.OPEN, held) is None:  # a door that was let go of
            state.conditions[Condition.OPEN][held] = bool(self._rng.random() < _AJAR[self._solver])
        if state.is_in(Condition.OPEN, target):
            inside = [name for name in self.facts.objs if name in before and not shut(name) and self._rng.random() < 0.8]
            self.seen.update(inside)
            self.visible += [name for name in inside if name not in self.visible]
            self._near |= {name for name in inside if self._rng.random() < 0.7}

    # ---- mistakes

    def mistake(self, target: PlanStep) -> PlanStep:
        """A step that a learner might take instead; it may happen to be a right one."""
        head = target.actions[0]
        kinds = [
            self._hasty, self._hasty, self._other_arm, self._misplace, self._again, self._again, self._repeat, self._detour,
            self._fidget,
        ]  # fmt: skip
        make: Callable[[Action], Action] = kinds[int(self._rng.integers(len(kinds)))]
        return PlanStep((make(head),))

    def _pick_one(self, ids: Sequence[str]) -> str:
        return ids[int(self._rng.integers(len(ids)))]

    def _any_arm(self) -> Arm:
        return _FREE_ARMS[int(self._rng.integers(2))]

    def _hasty(self, head: Action) -> Action:
        """What the step works towards, before it can be done; of what is not known yet, too."""
        jobs = plan_jobs(self._draft.goals, Setting(self.facts.now(), self.facts.homes))
        job = jobs[int(self._rng.integers(len(jobs)))]
        return job.action(job.arm or self._any_arm())

    def _other_arm(self, head: Action) -> Action:
        if head.arm is None:
            return self._hasty(head)
        return Action(head.name, arm=head.arm.other, object_id=head.object_id)

    def _misplace(self, head: Action) -> Action:
        """Puts down what is or is not in a hand, where it belongs or not."""
        wanted = [goal.receptacle_id for goal in self._draft.goals if goal.receptacle_id] or list(self._scene.targets)
        place = self._pick_one(wanted if self._rng.random() < 0.7 else list(self._scene.targets))
        if self._rng.random() < 0.2:
            return Action("PlaceBoth", object_id=place)
        return Action("Place", arm=self._any_arm(), object_id=place)

    def _again(self, head: Action) -> Action:
        """Something that suits a thing that the task names, although it may be done already."""
        item = self.facts.object(self._pick_one(list(self._draft.focus.values())))
        suits = {
            "GoTo": True, "Open": item.can.openable, "Close": item.can.openable,
            "ToggleOn": item.can.toggleable, "ToggleOff": item.can.toggleable,
            "Pick": item.can.pickupable, "Hold": item.can.pickupable, "Lift": item.can.movable and item.two_handed,
            "Slice": item.can.sliceable,
            "Clean": item.soiled, "UseUp": item.can.consumable, "Pour": item.can.fillable and item.can.movable,
            "Fill": item.outlet is not None,
        }  # fmt: skip
        others = (spec for spec in ACTIONS.values() if spec.takes_object and spec.tool is None and not spec.has_effect(PutDown))
        suits |= {spec.name: True for spec in others if spec.name not in suits}
        verb = self._pick_one([name for name, fits in suits.items() if fits])
        arm = self._any_arm() if ACTIONS[verb].kind is ActionKind.ARM else None
        return Action(verb, arm=arm, object_id=item.object_id)

    def _repeat(self, head: Action) -> Action:
        return self._last or self._again(head)

    def _detour(self, head: Action) -> Action:
        return Action("GoTo", object_id=self._pick_one(self.known()))

    def _fidget(self, head: Action) -> Action:
        """A move that serves nothing, or an arm that lets go or comes to rest."""
        draw = self._rng.random()
        if draw < 0.15:
            return Action(self._pick_one(("Release", "ResetArm")), arm=self._any_arm())
        name = self._pick_one(_LEGS if draw < 0.55 else [move for move in _MOVES if move not in _LEGS])
        amount = ACTIONS[name].amounts[0]
        unit = {"m": _HEIGHT_STEP_M if name in _LEGS else 0.1, "deg": 15.0}[amount.unit]
        return Action(name, amount=round(unit * float(self._rng.integers(1, 6)), 2))
