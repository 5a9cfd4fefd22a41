"""Planning exercises in words: household episodes without geometry, physics or pictures.

What to do next follows mostly from the instruction, the log and the names. A pretrained language model reads that; a small one
trained on a few thousand simulated steps does not learn what each refusal asks for. The world here holds facts only: who
stands where, which hand holds what, which door is open, how low the body has to be. Tasks are drawn from families of
`sim.tasks.families`, the expert's own job planner (`sim.expert.jobs`) names the next step, and part of the steps that
are taken are mistakes, so that every refusal is followed by what mends it. Half of the rooms are made up. Steps that only eyes
could justify (a turn towards something unseen, a change of height that nothing has called for yet) are taken, not recorded.

Rows of `exercises` shards, and of `judgements` shards, which ask whether an instruction has been carried out at a moment of
such an episode. For training without pictures; no result is ever measured here. The paper starts from a pretrained language
model instead.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np

from configs.schema.collect import CollectConfig
from data.interface.actions import ActionKind
from data.interface.bodies import Arm
from data.interface.failures import INVALID_OUTPUT, FailureCode
from data.interface.observation import HistoryItem
from data.interface.steps import Action, PlanStep
from sim.collection.students import accepted
from sim.expert.jobs import Facts, Job, plan_jobs
from sim.tasks.drafts import Draft, NoDraft, Scene
from sim.tasks.families import CATEGORIES, FAMILIES, draw, family_of
from sim.tasks.sample import UNSEEN_TYPES, rng_for, scene_of

__all__ = ["Exercise", "corrections_of_part", "exercises_of_part", "judgement", "judgements_of_part", "play", "play_alone"]

#: Earlier steps that a row keeps.
#: Families whose states the facts of this world know: no tools, liquids, heat, doors that fall shut, or any object of a type.
_FAMILIES: Final = (
    "pick", "place", "open", "close", "toggle_on", "toggle_off", "transport_two", "transport_each", "pick_and_toggle_on",
    "pick_and_toggle_off", "pick_and_open", "fetch", "fetch_hold", "stow", "stow_close", "lift", "carry", "hold_two",
    "carry_and_toggle", "carry_and_place",
)  # fmt: skip
#: Types with lids or switches of their own, which it does not know either.
_LEFT_OUT: Final = (*UNSEEN_TYPES, "Laptop", "Book", "DeskLamp", "CellPhone")
_HISTORY: Final = 8
_MAX_STEPS: Final = 24
_HEIGHT_STEP_M: Final = 0.05
#: Pelvis heights relative to upright, metres.
_LOWEST_M, _HIGHEST_M = -0.5, 0.2
#: Shares of steps that are mistakes, one drawn per episode.
_MISTAKES: Final = (0.1, 0.3, 0.5)
#: What physics says to an action that was right, with a probability: once, or every time from the same stance.
_BAD_LUCK: Final = 0.02
_AWKWARD: Final = 0.08
_MISHAPS: Final[Mapping[str, tuple[FailureCode, ...]]] = {
    "Pick": (FailureCode.GRASP_MISSED, FailureCode.OBSTRUCTED),
    "Lift": (FailureCode.GRASP_MISSED, FailureCode.OBSTRUCTED),
    "Open": (FailureCode.HANDLE_SLIPPED, FailureCode.GRASP_MISSED, FailureCode.OBSTRUCTED),
    "Close": (FailureCode.HANDLE_SLIPPED, FailureCode.GRASP_MISSED, FailureCode.OBSTRUCTED),
    "Place": (FailureCode.OBSTRUCTED,),
}
#: Sides from which to try again.
_BEARINGS_DEG: Final = (-20.0, 20.0)
#: Furniture of made-up rooms.
_SURFACES: Final = ("CounterTop", "DiningTable", "CoffeeTable", "SideTable", "Desk", "Dresser", "Shelf")
_CONTAINERS: Final = ("Fridge", "Cabinet", "Drawer", "Microwave")
_SWITCHES: Final = ("Faucet", "StoveKnob", "Microwave", "FloorLamp", "Television", "LightSwitch")
_EXTRAS: Final = ("Sofa", "GarbageCan", "Chair", "TVStand", "SinkBasin")
_FREE_ARMS: Final = (Arm.RIGHT, Arm.LEFT)
#: What a learned planner does at each of several moments (rows of `exercises` without the target); None where it names no step.
Student = Callable[[Sequence[Mapping[str, Any]]], Sequence[PlanStep | None]]


@dataclass(slots=True)
class Exercise:
    """One episode.

    Attributes:
        rows: recorded steps, ready for a shard.
        moments: what the robot knows before every step and at the end, as columns of a row without the target.
        success: whether the goals held at the end.
        codes: every outcome code that occurred.
    """

    rows: list[dict[str, Any]] = field(default_factory=list)
    moments: list[dict[str, Any]] = field(default_factory=list)
    success: bool = False
    codes: set[str] = field(default_factory=set)


def exercises_of_part(config: CollectConfig, part: int) -> Iterator[dict[str, Any]]:
    """Rows of one part of an `exercises` folder; the same for the same configuration, whoever computes it."""
    for index in config.indices(part):
        yield from play(config, index).rows


def play(config: CollectConfig, index: int) -> Exercise:
    """Plays one episode with the expert's steps and drawn mistakes.

    Args:
        config: the collection.
        index: number of the episode; names every draw.
    """
    episode = _Episode(config, index, "exercises")
    while (target := episode.ask()) is not None:
        episode.take(episode.world.mistake(target) if episode.rng.random() < episode.mistakes else target)
    return episode.close()


def corrections_of_part(config: CollectConfig, part: int, student: Student) -> Iterator[dict[str, Any]]:
    """Rows of one part of an `exercises` folder whose steps a student chose and the expert corrected.

    Args:
        config: the collection; `noise` is the share of steps that the expert takes itself, besides those in which the student
            has no step, ends the task, or does again what has just been refused.
        part: number of the part, whose episodes go side by side.
        student: the learned planner.
    """

    def chosen(episode: _Episode, target: PlanStep, proposed: PlanStep | None) -> PlanStep:
        own = episode.rng.random() >= config.noise
        return (accepted(proposed, episode.last) if own else None) or target

    episodes = [_Episode(config, index, "corrected exercises") for index in config.indices(part)]
    for episode in _side_by_side(episodes, student, chosen):
        yield from episode.rows


def play_alone(config: CollectConfig, student: Student) -> list[Exercise]:
    """Plays every episode of a collection side by side with a student that nobody helps; a reply without a step does nothing.

    Measures what a planner makes of words alone, apart from the benchmark's tasks: for choosing between training recipes.
    """
    episodes = [_Episode(config, index, "held-out exercises") for index in range(config.count)]
    return _side_by_side(episodes, student, lambda episode, target, proposed: proposed)


def _side_by_side(
    episodes: Sequence[_Episode],
    student: Student,
    choose: Callable[[_Episode, PlanStep, PlanStep | None], PlanStep | None],
) -> list[Exercise]:
    """Plays episodes to their ends, the student answering for all that still run at once."""
    running = list(episodes)
    while asked := [(episode, target) for episode in running if (target := episode.ask()) is not None]:
        proposals = student([episode.exercise.moments[-1] for episode, _ in asked])
        for (episode, target), proposed in zip(asked, proposals, strict=True):
            episode.take(choose(episode, target, proposed))
        running = [episode for episode, _ in asked]
    return [episode.close() for episode in episodes]


class _Episode:
    """An episode under way.

    Attributes:
        rng: every draw of the episode, the world's too.
        world: the facts.
        mistakes: share of steps that are mistakes.
        exercise: what has been recorded.
    """

    def __init__(self, config: CollectConfig, index: int, name: str) -> None:
        self.rng = rng_for(name, config.seed, index)
        draft, scene = _draft(config, self.rng)
        self.world = _PaperWorld(draft, scene, self.rng)
        hidden = [thing for thing in draft.objects if thing not in self.world.seen]
        instruction = draft.sentences(scene.furniture, self.rng, hidden)[0]
        self._budget = int(np.ceil(1.5 * family_of(draft.family).steps)) + 2 + int(self.rng.choice((0, 0, 5, 10)))
        self._steps = min(self._budget, _MAX_STEPS)
        self.mistakes = float(self.rng.choice(_MISTAKES))
        self.exercise = Exercise()
        self._history: list[dict[str, str]] = []
        self._task = {
            "instruction": instruction,
            "robot": config.robots[index % len(config.robots)],
            "category": family_of(draft.family).category,
            "step_budget": self._budget,
            "named": list(draft.focus.values()),
        }

    def ask(self) -> PlanStep | None:
        """Records the moment; the expert's step there, None when the episode is over."""
        number = len(self._history)
        self.exercise.moments.append(
            {
                **self._task,
                "step": number,
                "visible": list(self.world.visible),
                "known": self.world.known(),
                "history": self._history[-_HISTORY:],
            }
        )
        answer = self.world.answer() if number < self._steps else None
        if answer is None:
            return None
        target, justified = answer
        if justified:
            self.exercise.rows.append({**self.exercise.moments[-1], "target": target.to_text()})
        return target

    @property
    def last(self) -> HistoryItem | None:
        """The newest entry of the log."""
        return HistoryItem(**self._history[-1]) if self._history else None

    def take(self, step: PlanStep | None) -> None:
        """Carries a step out; None is a reply that names none."""
        if step is None:
            self._history.append({"step": "", "feedback": INVALID_OUTPUT})
            return
        outcomes = [(action, self.world.act(action)) for action in step.actions]
        self.exercise.codes |= {str(code) for _, code in outcomes}
        feedback = "; ".join(f"{action.to_text()} {code}" for action, code in outcomes)
        self._history.append({"step": step.to_text(), "feedback": feedback})

    def close(self) -> Exercise:
        """The record, with whether the goals hold."""
        self.exercise.success = self.world.answer() is None
        return self.exercise


def judgements_of_part(config: CollectConfig, part: int) -> Iterator[dict[str, Any]]:
    """Rows of one part of a `judgements` folder: one question of each episode."""
    for index in config.indices(part):
        yield judgement(config, index)


def judgement(config: CollectConfig, index: int) -> dict[str, Any]:
    """Whether the instruction has been carried out: half of the answers are yes.

    A no is about the moment before the last step, an earlier one, the end of an episode that failed, or the end of one that did
    something else.
    """
    rng = rng_for("judgements", config.seed, index)
    exercise = play(config, index)
    end = exercise.moments[-1]
    if not exercise.success:
        return {**end, "target": "no"}
    if rng.random() < 0.5:
        return {**end, "target": "yes"}
    if rng.random() < 0.2:
        other, scene = _draft(config, rng)
        instruction = other.sentences(scene.furniture, rng)[0]
        target = "no" if instruction != end["instruction"] else "yes"
        return {**end, "instruction": instruction, "named": list(other.focus.values()), "target": target}
    earlier = exercise.moments[:-1]
    if not earlier:
        return {**end, "target": "yes"}
    before = earlier[-1] if rng.random() < 0.5 else earlier[int(rng.integers(len(earlier)))]
    return {**before, "target": "no"}


def _draft(config: CollectConfig, rng: np.random.Generator) -> tuple[Draft, Scene]:
    """A task in one of the rooms or in a made-up one."""
    while True:
        scene = scene_of(str(rng.choice(config.rooms))) if rng.random() < 0.5 else _made_up(rng)
        category = str(rng.choice(CATEGORIES))
        family = str(rng.choice([name for name in _FAMILIES if FAMILIES[name].category == category]))
        try:
            return draw(family, scene, rng, without=_LEFT_OUT), scene
        except NoDraft:
            continue


def _made_up(rng: np.random.Generator) -> Scene:
    """Furniture of a room that nobody built; things of the kitchen and of the living room fit everywhere."""

    def some(types: Sequence[str], least: int, most: int) -> list[str]:
        chosen = rng.permutation(len(types))[: int(rng.integers(least, most + 1))]
        return [f"{types[i]}_{n + 1}" for i in chosen for n in range(1 + int(rng.random() < 0.35))]

    surfaces, containers = some(_SURFACES, 3, 5), some(_CONTAINERS, 1, 3)
    switches = list(dict.fromkeys(some(_SWITCHES, 1, 3) + [name for name in containers if name.startswith("Microwave")]))
    furniture = list(dict.fromkeys([*surfaces, *containers, *switches, *some(_EXTRAS, 0, 3)]))
    order = [furniture[i] for i in rng.permutation(len(furniture))]
    both = [scene_of(name) for name in ("kitchen_1", "living_room_1")]
    small = {kind: (*surfaces, *containers) for scene in both for kind in scene.small}
    big = {kind: tuple(surfaces) for scene in both for kind in scene.big}
    shut = [name for name in switches if name.startswith("Microwave") and name not in containers]
    return Scene("made_up", tuple(order), tuple(surfaces), tuple(surfaces), (*containers, *shut), tuple(switches), small, big)


class _PaperWorld:
    """Facts about one room and one robot, and what actions do to them.

    Attributes:
        seen: movable objects seen so far.
        visible: ids in view, furniture first.
    """

    def __init__(self, draft: Draft, scene: Scene, rng: np.random.Generator) -> None:
        self._draft, self._scene, self._rng = draft, scene, rng
        self._parents: dict[str, str | None] = dict(draft.objects)
        self._homes = dict(draft.objects)
        state = draft.states
        self._open = {name: bool(state.get(name, {}).get("isOpen", False)) for name in scene.containers}
        self._on = {name: bool(state.get(name, {}).get("isToggled", False)) for name in scene.switches}
        self._two_handed = frozenset(name for name in draft.objects if name.rsplit("_", 1)[0] in scene.big)
        self._held: dict[Arm, str | None] = {Arm.LEFT: None, Arm.RIGHT: None}
        self._lifted: str | None = None
        self._height_m = float(rng.choice((0.0, 0.0, -0.1, -0.2)))
        self._bands = {name: self._band() for name in scene.furniture}
        #: Whether a refusal has told the robot that its height is wrong here.
        self._told = False
        self.seen: set[str] = set()
        self.visible: list[str] = []
        self._last: Action | None = None
        #: What does not work from this stance, and how often the robot has come to this place anew.
        self._awkward: dict[Action, FailureCode] = {}
        self._approaches = 0
        self._at, self._near, self._left_first = "", set[str](), False
        focus = next(iter(draft.focus.values()))
        self._arrive(focus if focus in scene.furniture else draft.objects[focus], near=False)
        if rng.random() < 0.4:
            self._arrive(str(rng.choice(scene.furniture)), near=False)
        if rng.random() < 0.6:
            self._at = ""

    # ---- facts

    def known(self) -> list[str]:
        """Ids that actions may name: furniture, and everything seen so far."""
        return [*self._scene.furniture, *(name for name in self._draft.objects if name in self.seen)]

    def _facts(self) -> Facts:
        entries: dict[str, dict[str, Any]] = {}
        for name in (*self._scene.furniture, *self._parents):
            carrier = self._parents.get(name)
            arms = [arm.value for arm, item in self._held.items() if item == name]
            entries[name] = {
                "objectId": name,
                "parentReceptacles": [carrier] if carrier else [],
                "isPickedUp": bool(arms) or self._lifted == name,
                "heldBy": ["left", "right"] if self._lifted == name else arms,
                "openable": name in self._open,
                "isOpen": self._open.get(name, False),
                "isToggled": self._on.get(name, False),
                "pickupable": name in self._parents and name not in self._two_handed,
                "moveable": name in self._two_handed,
                "receptacle": name in self._scene.targets,
            }
        return Facts(entries, dict(self._held), self._lifted, self._two_handed, self._homes)

    def _band(self) -> tuple[float, float]:
        """Pelvis heights from which the arms reach what a piece of furniture carries."""
        middle = float(self._rng.choice((-0.05, -0.05, -0.05, -0.15, -0.3, 0.1)))
        half = float(self._rng.uniform(0.05, 0.2))
        return middle - half, middle + half

    def _place(self, name: str) -> str | None:
        return name if name in self._bands else self._parents[name]

    def _hidden(self, name: str) -> bool:
        carrier = self._parents[name]
        return carrier is None or not self._open.get(carrier, True)

    def _reaches(self, name: str) -> bool:
        return self._place(name) == self._at and (name in self._near or (name == self._at and bool(self._near)))

    def _misfit_m(self, name: str) -> float:
        """Change of height that brings an object into reach, 0 when it is."""
        low, high = self._bands[self._place(name) or ""]
        if low - 1e-6 <= self._height_m <= high + 1e-6:
            return 0.0
        gap = low - self._height_m if self._height_m < low else high - self._height_m
        amount = float(np.ceil(abs(gap) / _HEIGHT_STEP_M - 1e-6)) * _HEIGHT_STEP_M
        return float(np.copysign(amount, gap))

    def _arrive(self, place: str, near: bool = True, wanted: str = "") -> None:
        """Stands in front of a piece of furniture and looks."""
        if place != self._at:
            self._approaches = 0
            self._awkward.clear()
        self._at, self._told = place, False
        self._left_first = bool(self._rng.random() < 0.35)
        ids = self._scene.furniture
        here = ids.index(place)
        beside = [ids[i] for i in range(max(0, here - 2), min(len(ids), here + 3)) if i != here and self._rng.random() < 0.4]
        shown = {place, *beside}
        things = [name for name, carrier in self._parents.items() if carrier in shown and not self._hidden(name)]
        seen = [name for name in things if name == wanted or self._rng.random() < 0.85]
        self.seen.update(seen)
        self.visible = [*(name for name in ids if name in shown), *(name for name in self._draft.objects if name in seen)]
        self._near = set()
        if near:
            self._near = {place, *(name for name in things if name == wanted or self._rng.random() < 0.6)}

    # ---- the right step

    def answer(self) -> tuple[PlanStep, bool] | None:
        """The step to take, and whether it follows from what the robot knows; None when every goal holds."""
        jobs = plan_jobs(self._draft.goals, self._facts())
        if not jobs:
            return None
        head = jobs[0]
        if head.target in self._parents and head.target not in self.seen:
            carrier = self._parents[head.target] or self._at
            if self._at != carrier:
                return PlanStep((Action("GoTo", object_id=carrier),)), True
            turn = Action(str(self._rng.choice(("RotateLeft", "RotateRight"))), amount=15.0 * float(self._rng.integers(1, 6)))
            return PlanStep((turn,)), False
        if not self._reaches(head.target):
            return PlanStep((Action("GoTo", object_id=head.target),)), True
        misfit = self._misfit_m(head.target)
        if misfit:
            move = Action("MoveUp" if misfit > 0 else "MoveDown", amount=round(abs(misfit), 2))
            return PlanStep((move,)), self._told
        arms = [arm for arm in self._arms(head) if head.action(arm) not in self._awkward]
        if not arms:
            side = _BEARINGS_DEG[self._approaches % len(_BEARINGS_DEG)]
            return PlanStep((Action("GoTo", object_id=head.target, bearing_deg=side),)), True
        return self._with_companion(head, arms[0], jobs[1:]), True

    def _arms(self, job: Job) -> list[Arm | None]:
        """Arms that may do the job, preferred one first."""
        if job.arm is not None or job.verb in ("Lift", "PlaceBoth"):
            return [job.arm]
        free: list[Arm | None] = [arm for arm in _FREE_ARMS if self._held[arm] is None]
        return free[::-1] if self._left_first else free

    def _with_companion(self, head: Job, arm: Arm | None, others: Sequence[Job]) -> PlanStep:
        first = head.action(arm)
        for job in others:
            known = job.target not in self._parents or job.target in self.seen
            if arm is None or not known or not self._reaches(job.target) or self._misfit_m(job.target):
                continue
            if job.verb in ("Lift", "PlaceBoth") or job.arm is arm or (job.arm is None and self._held[arm.other] is not None):
                continue
            if job.action(arm.other) not in self._awkward:
                return PlanStep((first, job.action(arm.other)))
        return PlanStep((first,))

    # ---- what actions do

    def act(self, action: Action) -> str:
        """Carries an action out; returns `ok` or a failure code."""
        kind = action.spec.kind
        self._last = action
        if action.object_id is not None and action.object_id not in self.known():
            return FailureCode.OBJECT_NOT_KNOWN
        if kind is ActionKind.BODY:
            return self._move(action)
        refusal = self._refusal(action)
        if refusal:
            return refusal
        target = action.object_id or ""
        if not self._reaches(target):
            return FailureCode.TOO_FAR
        misfit = self._misfit_m(target)
        if misfit:
            self._told = True
            return FailureCode.BODY_TOO_LOW if misfit > 0 else FailureCode.BODY_TOO_HIGH
        if action in self._awkward:
            return self._awkward[action]
        if self._rng.random() < _BAD_LUCK:
            return FailureCode.NOTHING_HAPPENED
        codes = _MISHAPS.get(action.name, ())
        if codes and self._rng.random() < _AWKWARD:
            self._awkward[action] = codes[int(self._rng.integers(len(codes)))]
            return self._awkward[action]
        self._awkward.clear()
        self._change(action)
        return "ok"

    def _move(self, action: Action) -> str:
        target = action.object_id
        if action.name == "GoTo":
            place = self._place(target or "")
            if place is None:
                return FailureCode.ALREADY_HELD
            if place == self._at and self._awkward and (action.bearing_deg or action.amount):  # the plain stance is the old one
                self._approaches += 1
                self._awkward.clear()
            self._arrive(place, wanted=target or "")
        elif action.name in ("MoveUp", "MoveDown"):
            change = (action.amount or 0.0) * (1 if action.name == "MoveUp" else -1)
            if not _LOWEST_M <= self._height_m + change <= _HIGHEST_M:
                return FailureCode.HEIGHT_LIMIT
            self._height_m += change
            self._told = False
            self._awkward.clear()
        else:
            self._look_around()
        return "ok"

    def _look_around(self) -> None:
        """After a turn or a step the stance is another one; what stands here comes into view."""
        self._awkward.clear()
        things = [name for name, carrier in self._parents.items() if carrier == self._at and not self._hidden(name)]
        self.seen.update(things)
        self.visible += [name for name in things if name not in self.visible]
        if self._rng.random() < 0.7:
            self._near = set()

    def _refusal(self, action: Action) -> str:
        """The logical preconditions, in the order of `sim.skills.checks`."""
        target, verb, arm = action.object_id or "", action.name, action.arm
        holding = [item for item in self._held.values() if item is not None]
        if verb in ("Place", "PlaceBoth"):
            if verb == "Place" and self._lifted:
                return FailureCode.BOTH_HANDS_BUSY
            if (self._lifted if verb == "PlaceBoth" else self._held[arm or Arm.LEFT]) is None:
                return FailureCode.HAND_EMPTY
            if target not in (*self._scene.surfaces, *self._scene.containers):
                return FailureCode.NOT_RECEPTACLE
            return FailureCode.RECEPTACLE_CLOSED if not self._open.get(target, True) else ""
        if self._lifted:
            return FailureCode.BOTH_HANDS_BUSY
        if (arm is not None and self._held[arm] is not None) or (verb == "Lift" and holding):
            return FailureCode.HAND_OCCUPIED
        if verb == "Pick" and target in holding:
            return FailureCode.ALREADY_HELD
        if verb == "Pick" and target not in self._parents:
            return FailureCode.NOT_PICKUPABLE
        if verb == "Pick" and target in self._two_handed:
            return FailureCode.NEEDS_TWO_HANDS
        if verb == "Lift" and target not in self._two_handed:
            return FailureCode.NOT_LIFTABLE
        if verb in ("Pick", "Lift"):
            return FailureCode.RECEPTACLE_CLOSED if self._hidden(target) else ""
        table = self._open if verb in ("Open", "Close") else self._on
        if target not in table:
            return FailureCode.NOT_OPENABLE if table is self._open else FailureCode.NOT_TOGGLEABLE
        return FailureCode.ALREADY_IN_STATE if table[target] == (verb in ("Open", "ToggleOn")) else ""

    def _change(self, action: Action) -> None:
        target, verb, arm = action.object_id or "", action.name, action.arm
        if verb == "Pick" and arm is not None:
            self._held[arm], self._parents[target] = target, None
        elif verb == "Lift":
            self._lifted, self._parents[target] = target, None
        elif verb == "Place" and arm is not None:
            self._put(self._held[arm] or "", target)
            self._held[arm] = None
        elif verb == "PlaceBoth":
            self._put(self._lifted or "", target)
            self._lifted = None
        elif verb in ("Open", "Close"):
            self._open[target] = verb == "Open"
            if verb == "Open":
                inside = [name for name, carrier in self._parents.items() if carrier == target and self._rng.random() < 0.8]
                self.seen.update(inside)
                self.visible += [name for name in inside if name not in self.visible]
                self._near |= {name for name in inside if self._rng.random() < 0.7}
        else:
            self._on[target] = verb == "ToggleOn"

    def _put(self, thing: str, place: str) -> None:
        self._parents[thing] = place
        self._near.add(thing)

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
        jobs = plan_jobs(self._draft.goals, self._facts())
        job = jobs[int(self._rng.integers(len(jobs)))]
        return job.action(None if job.verb in ("Lift", "PlaceBoth") else (job.arm or self._any_arm()))

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
        """Something that the task names, although it may be done already."""
        name = self._pick_one(list(self._draft.focus.values()))
        verbs = ["GoTo"]
        if name in self._open:
            verbs += ["Open", "Close"]
        if name in self._on:
            verbs += ["ToggleOn", "ToggleOff"]
        if name in self._parents:
            verbs += ["Lift"] if name in self._two_handed else ["Pick", "Pick"]
        verb = self._pick_one(verbs)
        return Action(verb, arm=None if verb in ("GoTo", "Lift") else self._any_arm(), object_id=name)

    def _repeat(self, head: Action) -> Action:
        return self._last or self._again(head)

    def _detour(self, head: Action) -> Action:
        return Action("GoTo", object_id=self._pick_one(self.known()))

    def _fidget(self, head: Action) -> Action:
        if self._rng.random() < 0.5:
            amount = round(_HEIGHT_STEP_M * float(self._rng.integers(1, 6)), 2)
            return Action(self._pick_one(("MoveUp", "MoveDown")), amount=amount)
        name = self._pick_one(("MoveAhead", "MoveBack", "MoveLeft", "MoveRight", "RotateLeft", "RotateRight"))
        unit = 15.0 if name.startswith("Rotate") else 0.1
        return Action(name, amount=round(unit * float(self._rng.integers(1, 6)), 2))
