"""An episode in words: what a planner reads and writes as one append-only sequence.

    prefix   robot, instruction, furniture and what else is known at the start
    log      per step: the actions as they were taken, their codes, what came into view
    now      before an answer, and seen by that answer alone: the hands, where the robot stands, what is in view, where things
             are or were last seen, the states of doors and switches, what was tried from here; `why` asks for reflection
    answer   after `why`, of what type the failure is and what changes; the sub-goal (verb and thing); where a model says where
             things are (`model.places`), the place of that thing if it is in view; then the step

Ids and instructions share their words (`DiningTable_1` is `dining table _1`), so that a thing is named by copying, not by
remembering. Nothing is in these words that an `Observation` does not hold; `now` is computed from the log by the table of
effects (`interface.belief`).

The paper does not publish its prompts; the wording is ours.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from interface.actions import ACTIONS, ActionKind
from interface.belief import ARM_SPECIFIC, UNKNOWN, Belief
from interface.bodies import Arm
from interface.effects import Condition, Rise
from interface.failures import FAILED, FAILURES, FailureCategory, FailureCode
from interface.observation import HistoryItem
from interface.sightings import Seen, Sightings
from interface.steps import Action, PlanStep
from interface.symbolic import Event, events_of
from proprio_mllm.model.geometry import arm_length_m, floor_m, shoulders

Words = tuple[str, ...]

#: Ends an answer.
END: Final = "."
#: Numbers at the end of ids.
ID_NUMBERS: Final = tuple(f"_{number}" for number in range(1, 17))
#: What a reflection names: the paper's failure type, or chance where none is known, and what the next step changes.
CAUSES: Final = (*(str(one).partition("_")[0] for one in FailureCategory), "chance")
CHANGES: Final = ("height", "stance", "arm", "place", "again", "other", "end")
#: Words of the sequence that are neither of the instruction nor of the grammar of actions.
MARKERS: Final = (
    END, "&", "room", "see", "did", "now", "do", "unseen", "done", "auto", "left", "right", "both", "empty", "unknown",
    "at", "away", "on", "from", "open", "closed", "off", "sliced", "clean", "dirty", "used", "filled", "drained", "steady",
    "fail", "tried", "far", "up", "down", "top", "bottom", "low", "blocked", "many", "bent", "s", "ok", "why", "so",
    *CAUSES, *CHANGES,
)  # fmt: skip
#: Steps of the numbers of a place: degrees; metres or arm lengths, up to the last that is said.
_PLACE_DEG, _PLACE_STEP, _PLACE_FAR = 10, 0.1, 2.0
_TYPE_WORD: Final = re.compile(r"[A-Z]+(?=[A-Z][a-z])|[A-Z]?[a-z0-9]+|[A-Z]+")
_TEXT_WORD: Final = re.compile(r"[a-z0-9]+|[,.;:]")
_STATES: Final[Mapping[Condition, tuple[str, str]]] = {
    Condition.OPEN: ("open", "closed"),
    Condition.ON: ("on", "off"),
    Condition.SLICED: ("sliced", ""),
    Condition.DIRTY: ("dirty", "clean"),
    Condition.USED_UP: ("used", ""),
    Condition.FILLED: ("filled", "drained"),
}
_MOST: Final = 16


@dataclass(frozen=True, slots=True)
class WordTurn:
    """One decision of an episode.

    Attributes:
        now: what stands before the answer.
        answer: what is learnt; empty where nothing is.
        taken: what the log says of the step that was taken, right or wrong.
        tries: whether an arm would be tried here by all that words tell, so that what is seen decides.
    """

    now: Words
    answer: Words
    taken: Words
    tries: bool = False


@dataclass(frozen=True, slots=True)
class WordEpisode:
    """An episode to learn from."""

    prefix: Words
    turns: tuple[WordTurn, ...]


def id_words(object_id: str) -> Words:
    """`DiningTable_1` as `dining`, `table`, `_1`."""
    name, _, number = object_id.rpartition("_")
    return (*name_words(name or object_id), f"_{number}")


def name_words(name: str) -> Words:
    """A type's name as an id has it: `DiningTable` as `dining`, `table`."""
    return tuple(word.lower() for word in _TYPE_WORD.findall(name))


def text_words(text: str) -> Words:
    """An instruction in lower case, punctuation apart."""
    return tuple(_TEXT_WORD.findall(text.lower()))


def number_words() -> Words:
    """Every number that answers and states use: counts, metres in steps of 5 cm, degrees in steps of 5."""
    counts = [str(count) for count in range(1, _MOST + 1)]
    metres = [f"{step * 0.05:.2f}" for step in range(1, 41)]
    degrees = [f"{angle}d" for angle in range(-180, 181, 5)]
    return (*counts, *metres, *degrees)


def _metres(value: float) -> str:
    return f"{min(max(round(value / 0.05), 1), 40) * 0.05:.2f}"


def _degrees(value: float) -> str:
    return f"{min(max(round(value / 5.0), -36), 36) * 5}d"


def place_words(center: NDArray[np.floating], key_bodies: NDArray[np.floating]) -> Words:
    """Where a thing is, from the robot's own body.

    Bearing, positive to the left, and distance from the pelvis in the floor plane; height above the floor; distance from the
    left and from the right shoulder in arm lengths, and elevation as the shoulders see it.

    Args:
        center: (3,) pelvis heading frame, metres.
        key_bodies: (K, 3) the robot's own bodies in that frame.
    """
    from_pelvis, arm_m = np.asarray(center, dtype=np.float64), arm_length_m(key_bodies)
    from_shoulders = from_pelvis - shoulders(key_bodies)
    reaches = np.linalg.norm(from_shoulders, axis=1) / arm_m
    metres = (math.hypot(*from_pelvis[:2]), float(from_pelvis[2]) - floor_m(key_bodies))
    x, y, z = from_shoulders.mean(axis=0)
    return (
        "at",
        _angle(*from_pelvis[:2]),
        *(_upto(value, "m") for value in metres),
        *(_upto(float(value), "arm") for value in reaches),
        _angle(math.hypot(x, y), z),
    )


def _angle(x: float, y: float) -> str:
    return f"{round(math.degrees(math.atan2(y, x)) / _PLACE_DEG) * _PLACE_DEG}deg"


def _upto(value: float, unit: str) -> str:
    return f"{min(max(round(value / _PLACE_STEP), 1) * _PLACE_STEP, _PLACE_FAR):.1f}{unit}"


#: The values that a place may have, in order: angles, metres, arm lengths. No other part of an episode has these words.
PLACE_SCALES: Final = (
    (_ANGLES := tuple(f"{angle}deg" for angle in range(-180, 181, _PLACE_DEG))),
    *(
        tuple(_upto(step * _PLACE_STEP, unit) for step in range(1, round(_PLACE_FAR / _PLACE_STEP) + 1))
        for unit in ("m", "arm")
    ),
)
#: The words that a place may have, one after the other.
PLACES: Final = (
    ("at",),
    _ANGLES,
    *[PLACE_SCALES[1]] * 2,
    *[PLACE_SCALES[2]] * 2,
    _ANGLES[len(_ANGLES) // 4 : -(len(_ANGLES) // 4)],
)


def _count(value: int) -> str:
    return str(min(value, _MOST))


# ---- what is read


def prefix_words(seen: Seen) -> Words:
    """The start of an episode: its first observation."""
    listed = [word for name in seen.known_objects for word in id_words(name)]
    return (seen.robot, *text_words(seen.instruction), "room", *listed)


def log_words(steps: Sequence[HistoryItem], new: Sequence[str]) -> Words:
    """A step with its codes, or none, and what came into view after it."""
    words: list[str] = []
    for events in events_of(steps):
        words.append("did")
        for event in events:
            words += [*_action_words(event.action), "fail" if event.code == FAILED else event.code]
    if new:
        words += ["see", *(word for name in new for word in id_words(name))]
    return tuple(words)


def state_words(sightings: Sightings, reflects: bool = False) -> Words:
    """The block before an answer.

    Args:
        sightings: what is known.
        reflects: whether a failure is reflected on in the answer.
    """
    belief, state = sightings.belief, sightings.belief.state
    words = ["now"]
    if state.lifted is not None:
        words += ["both", *_thing(state.lifted)]
    else:
        for arm in (Arm.LEFT, Arm.RIGHT):
            item = state.held[arm]
            words += [arm.value, *(("empty",) if item is None else _thing(item))]
            words += ["steady"] if item in state.in_place else []
    words += ["away"] if state.here is None else ["at", *id_words(state.here)]
    words += ["see", *(word for name in sightings.visible for word in id_words(name))]
    for name, place in state.at.items():
        words += [*id_words(name), "on", *id_words(place)]
    held = {state.lifted, *state.held.values()}
    for name, place in sightings.found_at.items():
        if place is not None and name not in state.at and name not in held and name not in sightings.visible:
            words += [*id_words(name), "from", *id_words(place)]
    for condition, names in _STATES.items():
        for name, value in state.conditions[condition].items():
            if word := names[0] if value else names[1]:
                words += [word, *id_words(name)]
    return (*words, *_tried(belief), *(("why",) if reflects and belief.failed is not None else ()), "do")


def _thing(name: str) -> Words:
    return ("unknown",) if name == UNKNOWN else id_words(name)


def _tried(belief: Belief) -> list[str]:
    """What was tried from here without success."""
    words: list[str] = []
    for (verb, target), events in belief.fails.items():
        arms = {event.action.arm for event in events if event.code in ARM_SPECIFIC and event.action.arm is not None}
        words += ["fail", verb, *(id_words(target) if target else ()), *sorted(arms)]
        words += [_count(len(events))] if len(events) > 1 else []
    for target, count in belief.stances.items():
        if count > 1 or target != belief.state.here:  # having come once is said already
            words += ["tried", *id_words(target), _count(count)]
    for target, count in belief.let_shut.items():
        words += ["closed", *id_words(target), _count(count)]
    for target in sorted(belief.too_far):
        words += ["far", *id_words(target)]
    words += ["up" if rise > 0 else "down" for rise in belief.heights]
    words += ["top" if up else "bottom" for up in sorted(belief.at_limit)]
    words += ["low", _metres(belief.lowered_m)] if belief.lowered_m > 0.02 else []
    words += ["blocked", _count(belief.blocked)] if belief.blocked else []
    words += ["bent", "left" if belief.bearing_deg > 0 else "right"] if belief.bearing_deg else []
    return words


# ---- what is written


def _action_words(action: Action) -> Words:
    words = [action.name]
    if action.arm is not None:
        words.append(action.arm.value)
    if action.object_id is not None:
        words += id_words(action.object_id)
    units = [amount.unit for amount in action.spec.amounts]
    numbers = (action.amount, action.bearing_deg)
    last = max((index + 1 for index, number in enumerate(numbers) if number is not None), default=0)
    for unit, number in zip(units[:last], numbers, strict=False):
        words.append("auto" if number is None else _metres(number) if unit == "m" else _degrees(number))
    return tuple(words)


def reflection_words(failed: Event | None, step: PlanStep) -> Words:
    """Of what type a failure is, and what the step after it changes; nothing where nothing failed."""
    if failed is None:
        return ()
    kind = FAILURES[FailureCode(failed.code)].category if failed.code in tuple(FailureCode) else None
    return (CAUSES[-1] if kind is None else str(kind).partition("_")[0], "so", _change(failed.action, step))


def _change(failed: Action, step: PlanStep) -> str:
    head = step.actions[0]
    if failed in step.actions:
        return "again"
    if head.spec.kind is ActionKind.EPISODE:
        return "end"
    if head.spec.has_effect(Rise):
        return "height"
    if head.spec.kind is ActionKind.BODY:
        return "stance" if head.object_id in (None, failed.object_id) else "place"
    same = any((one.name, one.object_id) == (failed.name, failed.object_id) for one in step.actions)
    return "arm" if same else "other"


def answer_words(verb: str, target: str | None, step: PlanStep, reflection: Words = (), place: Words = ()) -> Words:
    """The sub-goal and the step.

    Args:
        verb: what is to be done next, a name of the table of actions.
        target: its object, None while that has not been seen; empty for verbs without one.
        step: what to do now.
        reflection: from `reflection_words`, where the state asked why.
        place: from `place_words`, where the target is seen and it is to be said.
    """
    thing: Words = ("unseen",) if target is None else id_words(target) if target else ()
    actions = [word for number, one in enumerate(step.actions) for word in (*(("&",) if number else ()), *_action_words(one))]
    return (*reflection, verb, *thing, *place, "do", *actions, END)


def verdict_words(done: bool) -> Words:
    """What a critic answers where a planner would say the step: that the goals hold, as planners say it, or to go on."""
    return answer_words("Done", "", PlanStep((Action("Done"),))) if done else ("again", END)


def read_step(words: Sequence[str], ids: Mapping[Words, str]) -> PlanStep:
    """The step of an answer, the inverse of `answer_words`.

    Args:
        words: an answer, with or without its end.
        ids: known ids by their words.

    Raises:
        ActionError: when the words are no step of the grammar.
        KeyError: on an id that is not known.
    """
    start = list(words).index("do") + 1
    parts: list[list[str]] = [[]]
    for word in words[start:]:
        if word == END:
            break
        if word == "&":
            parts.append([])
        else:
            parts[-1].append(word)
    return PlanStep(tuple(_read_action(part, ids) for part in parts))


def _read_action(words: Sequence[str], ids: Mapping[Words, str]) -> Action:
    name, rest = words[0], list(words[1:])
    spec = ACTIONS[name]
    arm = Arm(rest.pop(0)) if spec.kind is ActionKind.ARM else None
    target = None
    if spec.takes_object:
        end = next(index for index, word in enumerate(rest) if word.startswith("_")) + 1
        target, rest = ids[tuple(rest[:end])], rest[end:]
    numbers = [None if word == "auto" else float(word.rstrip("d")) for word in rest]
    numbers += [None] * (2 - len(numbers))
    return Action(name, arm, target, numbers[0], numbers[1])
