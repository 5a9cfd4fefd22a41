"""Episodes of the expert on sampled tasks, with exploration noise: the rows of `demos` shards.

With some probability a perturbed step is executed instead of the expert's, while the expert's choice is what is recorded
(as in DAgger), and in some episodes skills fail by chance; both lead into states that a learned planner will meet and that the
expert alone would never visit. Episodes that do not end in success are dropped as a whole, so every recorded step led, or could
have led, to the goal. Paper: planning demonstrations; what the paper takes from pretraining.

With a student, its steps are executed in place of the expert's (DAgger, Ross et al. 2011): what is recorded is what the expert
would do where a learned planner's own mistakes have led it. The student gets no say where it repeats a step that just failed or
ends the episode, in a share of the steps, and after as many steps as the task allows; the expert then finishes the episode.

Lessons are episodes with another teacher, a function of what a planner reads, at the controls: right steps, mistakes and a
student's steps, each kept with the teacher's answer whether the goals are met in the end or not. What that teacher cannot read
before its first try, how high, how far and which arm, the simulator's reach test can foresee (`foreseen`): such an answer is
one for planners that see and feel. Another stance is foreseen once between two tries of an arm.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Final, Protocol

import numpy as np

from configs.schema.collect import CollectConfig
from data.shards import encode_png
from interface.actions import ActionKind
from interface.effects import Rise
from interface.failures import FailureCode
from interface.observation import HistoryItem, Observation
from interface.steps import Action, PlanStep
from sim.expert.expert import Expert
from sim.session.session import Session
from sim.tasks.families import CATEGORIES, FAMILIES
from sim.tasks.sample import TRAIN_SEEDS, rng_for, sample_task
from sim.tasks.task import Task

#: Plays one episode of a collection with the sessions it may reuse.
Play = Callable[[CollectConfig, int, dict[tuple[str, str], Session]], "Episode"]
#: A planner that learns: the step it would take, None when its reply is no step.
Student = Callable[[Observation], PlanStep | None]


class Teacher(Protocol):
    """Names the step that should be taken; it is shown an episode's observations one after the other."""

    def __call__(self, observation: Observation) -> tuple[PlanStep, Action | None] | None:
        """The step, and the action that it works towards; None where the teacher gives up."""
        ...

    def after(self, observation: Observation, refused: HistoryItem) -> PlanStep | None:
        """The step that would follow if the one just named had been refused; None where the teacher would give up."""
        ...


#: Training seeds of one collection seed; two collections do not share tasks.
_SEEDS_PER_COLLECTION: Final = 1_000_000
#: The expert gives an episode up when it has thought about this many stances: four fifths of the time went into episodes that
#: failed in the end and were dropped.
_LOOKAHEADS: Final = 6
#: Lessons and those of a student take their tasks from here on, so that they share none with the expert's own; the steps after
#: which one ends; shares of steps that are mistakes, one drawn per lesson.
_LESSONS_FROM: Final = 700_000
_PRACTICE_FROM: Final = 800_000
_LESSON_STEPS: Final = 32
MISTAKES: Final = (0.0, 0.0, 0.1, 0.3)
#: Heights in words.
_HEIGHT_M: Final = 0.05
#: How often a drawn family is of each category. Two things for two arms are learnt last.
_CATEGORY_SHARES: Final = (0.2, 0.5, 0.3)


@dataclass(slots=True)
class Episode:
    """What came of one episode.

    Attributes:
        rows: one per step, ready for a shard.
        success: whether the goals held at the end.
        steps: steps taken.
    """

    rows: list[dict[str, Any]] = field(default_factory=list)
    success: bool = False
    steps: int = 0


def demos_of_part(config: CollectConfig, part: int) -> Iterator[dict[str, Any]]:
    """Rows of one part of a `demos` folder; the same for the same configuration, whoever computes it."""
    yield from _rows_of_part(config, part, run_episode)


def run_episode(config: CollectConfig, index: int, sessions: dict[tuple[str, str], Session] | None = None) -> Episode:
    """Plays one episode.

    Args:
        config: the collection.
        index: number of the episode; names its task, robot and every draw.
        sessions: sessions by (robot, difficulty), reused between episodes.
    """
    rng = rng_for("demos", config.seed, index)
    robot, task, session, observation = _start(config, index, rng, {} if sessions is None else sessions)
    expert = Expert(session, lookaheads=_LOOKAHEADS)
    expert.reset()
    episode = Episode()
    while not session.finished:
        target = expert.next_step()
        step, origin = target, "expert"
        if rng.random() < config.noise:
            step, origin = perturbed(target, observation, rng, expert.intent)
        episode.rows.append(_row(observation, task, robot, index, target, {"executed": step.to_text(), "origin": origin}))
        if target.actions[0].name == "Done":
            break
        observation, _ = session.step(step)
    episode.success, episode.steps = session.succeeded, len(episode.rows)
    return episode


def accepted(proposed: PlanStep | None, last: HistoryItem | None) -> PlanStep | None:
    """The student's step; None where it names none, ends the episode, or does again what has just failed.

    Args:
        proposed: what the student said.
        last: the newest entry of the log.
    """
    if proposed is None or proposed.actions[0].name == "Done":
        return None
    if last is None or all(outcome.endswith(" ok") for outcome in last.feedback.split("; ")):
        return proposed
    return None if last.step == proposed.to_text() else proposed


def _rows_of_part(config: CollectConfig, part: int, play: Play, all_kept: bool = False) -> Iterator[dict[str, Any]]:
    sessions: dict[tuple[str, str], Session] = {}
    try:
        for index in config.indices(part):
            episode = play(config, index, sessions)
            if episode.success or all_kept:
                yield from episode.rows
    finally:
        for session in sessions.values():
            session.close()


def lessons_of_part(
    config: CollectConfig, part: int, teacher: Teacher, student: Student | None = None
) -> Iterator[dict[str, Any]]:
    """Rows of one part of a `demos` folder of lessons."""
    yield from _rows_of_part(
        config, part, lambda cfg, index, sessions: run_lesson(cfg, index, sessions, teacher, student), all_kept=True
    )


def run_lesson(
    config: CollectConfig,
    index: int,
    sessions: dict[tuple[str, str], Session] | None,
    teacher: Teacher,
    student: Student | None = None,
) -> Episode:
    """Plays one lesson; the last row's target is `Done` where the goals were met.

    Args:
        config: the collection; with a student, `noise` is the share of steps that the teacher takes itself.
        index: number of the lesson; names its task, robot and every draw.
        sessions: sessions by (robot, difficulty), reused between episodes.
        teacher: names the right step.
        student: the learned planner; without one the steps are the teacher's, with mistakes.
    """
    rng = rng_for("lessons", config.seed, index)
    family = draw_family(rng)
    sessions, number = {} if sessions is None else sessions, (_LESSONS_FROM if student is None else _PRACTICE_FROM) + index
    robot, task, session, observation = _start(config, number, rng, sessions, family=family)
    session.step_limit = _LESSON_STEPS
    mistakes = float(rng.choice(MISTAKES))
    episode, foresight = Episode(), Foresight(teacher)
    done = PlanStep((Action("Done"),))
    while not session.finished:
        answer = teacher(observation)
        if answer is None:
            break
        target, intent = answer
        taught = target.to_text()
        if config.foreseen:
            target = foresight.better(session, observation, target)
        step, origin = target, "teacher"
        if student is None and rng.random() < mistakes:
            step, origin = perturbed(target, observation, rng, intent)
        if student is not None:
            own = student(observation)  # which has to see every observation
            proposed = accepted(own, observation.history[-1] if observation.history else None)
            if proposed is not None and rng.random() >= config.noise:
                step, origin = proposed, "student"
        executed = {"executed": step.to_text(), "origin": origin, "taught": taught}
        episode.rows.append(_row(observation, task, robot, number, target, executed))
        foresight.taken(step)
        observation, _ = session.step(step)
    episode.success, episode.steps = session.succeeded, len(episode.rows)
    if episode.success:
        nothing = {"executed": done.to_text(), "origin": "teacher", "taught": done.to_text()}
        episode.rows.append(_row(observation, task, robot, number, done, nothing))
    return episode


class Foresight:
    """A teacher's steps, with the simulator's reach test before each that an arm cannot reach for.

    Args:
        teacher: tells where it would go if it were refused.
    """

    def __init__(self, teacher: Teacher) -> None:
        self._teacher, self._walked = teacher, False

    def better(self, session: Session, observation: Observation, step: PlanStep) -> PlanStep:
        """What should be done in place of a step of the teacher; the step itself where it can be tried.

        Another stance is foreseen once between two tries: the next may be no better, and what is refused can be read.
        """
        found = foreseen(session, observation, step, self._teacher)
        if found is None:
            return step
        moves = found.actions[0].spec
        walks = moves.kind is ActionKind.BODY and not moves.has_effect(Rise)
        chosen = step if walks and self._walked else found
        self._walked |= walks
        return chosen

    def taken(self, step: PlanStep) -> None:
        """Takes notice of the step that was carried out."""
        self._walked &= not any(action.spec.arms for action in step.actions)


def foreseen(session: Session, observation: Observation, step: PlanStep, teacher: Teacher) -> PlanStep | None:
    """What should be done before a step that an arm cannot reach for, or in its place; None where it can be tried.

    Args:
        session: knows the reach of the arms.
        observation: what the teacher saw.
        step: its answer.
        teacher: tells where it would go if it were refused.
    """
    for action in step.actions:
        refusal = session.assess(action) if action.spec.arms and action.object_id is not None else None
        if refusal is None:
            continue
        if refusal.code in (FailureCode.BODY_TOO_HIGH, FailureCode.BODY_TOO_LOW):
            return _at_height(session, action, float(refusal.margins["height_m"]))
        if refusal.code == FailureCode.TOO_FAR:
            other = None if action.arm is None else replace(action, arm=action.arm.other)
            if other is not None and len(step.actions) == 1 and session.assess(other, diagnose=False) is None:
                return PlanStep((other,))
            codes = "; ".join(f"{one.to_text()} {refusal.code if one is action else 'ok'}" for one in step.actions)
            return teacher.after(observation, HistoryItem(step.to_text(), codes))
    return None


def _at_height(session: Session, action: Action, change_m: float) -> PlanStep | None:
    """A change of height, in steps of words, from which an action can be tried."""
    name, present = "MoveUp" if change_m > 0 else "MoveDown", session.body.posture.pelvis_height_m
    low = math.floor(abs(change_m) / _HEIGHT_M + 1e-6)
    for count in (low + 1, low, low + 2):
        amount = round(count * _HEIGHT_M, 2)
        there = present + math.copysign(amount, change_m)
        if count and session.assess(action, diagnose=False, pelvis_height_m=there) is None:
            return PlanStep((Action(name, amount=amount),))
    return None


def draw_family(rng: np.random.Generator) -> str:
    """A family of tasks: a category, then a family of it."""
    category = str(rng.choice(CATEGORIES, p=_CATEGORY_SHARES))
    return str(rng.choice([name for name, kind in FAMILIES.items() if kind.category == category]))


def _start(
    config: CollectConfig,
    index: int,
    rng: np.random.Generator,
    sessions: dict[tuple[str, str], Session],
    extra_steps: int = 0,
    family: str | None = None,
) -> tuple[str, Task, Session, Observation]:
    """Opens the episode's task, of a family where the room allows it."""
    robot = config.robots[index % len(config.robots)]
    room = config.rooms[(index // len(config.robots)) % len(config.rooms)]
    seed = TRAIN_SEEDS.start + config.seed * _SEEDS_PER_COLLECTION + index
    try:
        task = sample_task(seed, None if family else room, family, robots=(robot,))
    except ValueError:
        task = sample_task(seed, room, robots=(robot,))
    task = replace(task, time_limit=task.time_limit + extra_steps)
    difficulty = str(rng.choice(("medium", "medium", "hard"))) if rng.random() < config.chance_share else "easy"
    session = sessions.setdefault((robot, difficulty), Session(robot, difficulty, config.image_size))
    session.step_limit = task.time_limit  # what is learnt from is in time
    return robot, task, session, session.reset(task, seed=task.seed)


def perturbed(
    step: PlanStep, observation: Observation, rng: np.random.Generator, intent: Action | None = None
) -> tuple[PlanStep, str]:
    """A step that goes a little or entirely wrong, and the name of what was done to it.

    Args:
        step: the right step.
        observation: what the planner saw before it.
        rng: draws.
        intent: the arm action that the step works towards; `hasty` tries it at once, as learned planners do, so that the
            demonstrations show what follows each kind of refusal.
    """
    kinds: list[str] = ["wander", "height"]
    head = step.actions[0]
    if intent is not None and head.spec.kind is ActionKind.BODY:
        kinds += ["hasty"] * 5
    if head.amount is not None:
        kinds += ["amount"] * 2
    if head.spec.kind is ActionKind.ARM:
        kinds += ["arm"]
    if len(step.actions) == 2:
        kinds += ["half"] * 2
    if observation.known_objects:
        kinds += ["detour"] * 2
    kind = str(rng.choice(kinds))
    if kind == "hasty" and intent is not None:
        return PlanStep((intent,)), kind
    return PlanStep((_perturbation(kind, step, observation.known_objects, rng),)), kind


def _perturbation(kind: str, step: PlanStep, known: Sequence[str], rng: np.random.Generator) -> Action:
    head = step.actions[0]
    if kind == "amount":
        assert head.amount is not None
        assert head.spec.amount is not None
        low, high = head.spec.amount.low, head.spec.amount.high
        unit = 5.0 if head.spec.amount.unit == "deg" else 0.05
        factor = float(rng.choice((0.4, 0.7, 1.5, 2.0)))
        amount = float(np.clip(round(factor * head.amount / unit) * unit, max(low, unit), high))
        return Action(head.name, object_id=head.object_id, amount=round(amount, 2), bearing_deg=head.bearing_deg)
    if kind == "arm":
        assert head.arm is not None
        return Action(head.name, arm=head.arm.other, object_id=head.object_id)
    if kind == "half":
        return step.actions[int(rng.integers(2))]
    if kind == "detour":
        return Action("GoTo", object_id=str(rng.choice(sorted(known))))
    if kind == "height":
        return Action(str(rng.choice(("MoveUp", "MoveDown"))), amount=round(0.05 * float(rng.integers(1, 6)), 2))
    name = str(rng.choice(("MoveAhead", "MoveBack", "MoveLeft", "MoveRight", "RotateLeft", "RotateRight")))
    amount = 15.0 * float(rng.integers(1, 7)) if name.startswith("Rotate") else 0.1 * float(rng.integers(1, 6))
    return Action(name, amount=round(amount, 2))


def _row(
    observation: Observation, task: Task, robot: str, index: int, target: PlanStep, privileged: dict[str, Any]
) -> dict[str, Any]:
    body = observation.proprioception
    return {
        "episode": f"{task.id}_{robot}_{index}",
        "task": task.id,
        "split": task.split,
        "category": task.category,
        "robot": robot,
        "room": task.room,
        "step": observation.step,
        "time_limit": observation.time_limit,
        "instruction": observation.instruction,
        "image": encode_png(observation.image),
        "intrinsics": observation.camera.intrinsics.ravel().tolist(),
        "camera_in_pelvis": observation.camera.camera_in_pelvis.ravel().tolist(),
        "height": observation.camera.height,
        "width": observation.camera.width,
        "motion": body.motion.ravel(),
        "key_bodies": body.key_bodies_in_pelvis.ravel().tolist(),
        "visible": list(observation.visible_objects),
        "known": list(observation.known_objects),
        "history": [{"step": item.step, "feedback": item.feedback} for item in observation.history],
        "target": target.to_text(),
        "privileged": json.dumps(privileged | {"family": task.family}),
    }
