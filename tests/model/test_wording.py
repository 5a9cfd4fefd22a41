"""Episodes in words, written out by hand."""

from __future__ import annotations

import numpy as np
import pytest

from interface.bodies import KEY_BODIES
from interface.failures import FAILED
from interface.observation import HistoryItem
from interface.sightings import Shown, Sightings
from interface.steps import PlanStep
from proprio_mllm.model.wording import (
    MARKERS,
    PLACE_SCALES,
    PLACES,
    answer_words,
    id_words,
    log_words,
    number_words,
    place_words,
    prefix_words,
    read_step,
    reflection_words,
    state_words,
)

ROOM = ("CounterTop_1", "TVStand_1", "Fridge_2")


def told(*steps: tuple[str, str, tuple[str, ...], tuple[str, ...]]) -> Sightings:
    """What has been seen after some steps: step, feedback, what is in view, what is known besides the room."""
    sightings, history = Sightings(), []
    sightings.look(Shown("Put the mug away.", "h1", (), ROOM))
    for step, feedback, visible, known in steps:
        history.append(HistoryItem(step, feedback))
        sightings.look(Shown("Put the mug away.", "h1", visible, (*ROOM, *known), tuple(history)))
    return sightings


@pytest.mark.parametrize(
    ("object_id", "words"), [("DiningTable_1", "dining table _1"), ("TVStand_2", "tv stand _2"), ("Mug_12", "mug _12")]
)
def test_ids(object_id: str, words: str) -> None:
    assert " ".join(id_words(object_id)) == words


def test_the_start() -> None:
    words = prefix_words(Shown("Put the mug, please, on the counter.", "x1", (), ROOM))
    assert " ".join(words) == "x1 put the mug , please , on the counter . room counter top _1 tv stand _1 fridge _2"


def test_a_step_of_the_log() -> None:
    item = HistoryItem("Pick(left, Mug_1) & Open(right, Fridge_2)", "Pick(left, Mug_1) ok; Open(right, Fridge_2) BodyTooHigh")
    assert " ".join(log_words([item], ("Egg_1",))) == "did Pick left mug _1 ok Open right fridge _2 BodyTooHigh see egg _1"
    walk = HistoryItem("GoTo(Mug_1, auto, -20)", "GoTo(Mug_1, auto, -20) NoFreePose")
    assert " ".join(log_words([walk], ())) == "did GoTo mug _1 auto -20d NoFreePose"
    assert log_words((), ("Egg_1",)) == ("see", "egg", "_1")


def test_what_is_known_now() -> None:
    sightings = told(
        ("GoTo(CounterTop_1)", "GoTo(CounterTop_1) ok", ("Mug_1", "Egg_1"), ("Mug_1", "Egg_1")),
        ("Pick(left, Mug_1)", "Pick(left, Mug_1) ok", ("Egg_1",), ("Mug_1", "Egg_1")),
        ("GoTo(Fridge_2)", "GoTo(Fridge_2) ok", ("Fridge_2",), ("Mug_1", "Egg_1")),
        ("Open(right, Fridge_2)", "Open(right, Fridge_2) ok", ("Fridge_2",), ("Mug_1", "Egg_1")),
        ("Place(left, Fridge_2)", "Place(left, Fridge_2) BodyTooHigh", ("Fridge_2",), ("Mug_1", "Egg_1")),
        ("MoveDown(0.1)", "MoveDown(0.1) ok", ("Fridge_2",), ("Mug_1", "Egg_1")),
    )
    assert " ".join(state_words(sightings)) == (
        "now left mug _1 right empty at fridge _2 see fridge _2 egg _1 from counter top _1 open fridge _2 "
        "fail Place fridge _2 down low 0.10 do"
    )


def test_hands_and_places() -> None:
    lifted = told(("Lift(Box_1)", "Lift(Box_1) ok", ("Box_1",), ("Box_1",)))
    assert " ".join(state_words(lifted)) == "now both box _1 away see box _1 do"
    placed = told(
        ("Pick(right, Mug_1)", "Pick(right, Mug_1) ok", (), ("Mug_1",)),
        ("Place(right, Fridge_2)", "Place(right, Fridge_2) ok", (), ("Mug_1",)),
        ("Hold(left, Egg_1)", "Hold(left, Egg_1) ok", (), ("Mug_1", "Egg_1")),
    )
    assert " ".join(state_words(placed)) == "now left egg _1 steady right empty away see mug _1 on fridge _2 do"


@pytest.mark.parametrize(
    ("done", "code", "step", "words"),
    [
        ("Pick(left, Mug_1)", "BodyTooHigh", "MoveDown(0.2)", "body so height"),
        ("Pick(left, Mug_1)", "TooFar", "Pick(right, Mug_1)", "navigation so arm"),
        ("Pick(left, Mug_1)", "TooFar", "GoTo(Mug_1, 0.5)", "navigation so stance"),
        ("Pick(left, Mug_1)", "ObjectBroken", "GoTo(Fridge_1)", "logical so place"),
        ("Place(left, Fridge_1)", "ReceptacleClosed", "Open(right, Fridge_1)", "logical so other"),
        ("Pick(left, Mug_1)", "Slipped", "Pick(left, Mug_1)", "chance so again"),
        ("Pick(left, Mug_1)", FAILED, "Done()", "chance so end"),
    ],
)
def test_a_failure_is_reflected_on(done: str, code: str, step: str, words: str) -> None:
    seen = told((done, f"{done} {code}", ("Mug_1",), ("Mug_1",)))
    assert state_words(seen)[-1] == "do" and "why" not in state_words(seen)
    assert state_words(seen, reflects=True) == (*state_words(seen)[:-1], "why", "do")
    assert " ".join(reflection_words(seen.belief.failed, PlanStep.parse(step))) == words
    assert set(words.split()) <= set(MARKERS)


def test_what_works_is_not_reflected_on() -> None:
    seen = told(("GoTo(Mug_1)", "GoTo(Mug_1) ok", ("Mug_1",), ("Mug_1",)))
    assert state_words(seen, reflects=True) == state_words(seen)
    assert reflection_words(seen.belief.failed, PlanStep.parse("Done()")) == ()


@pytest.mark.parametrize(
    ("verb", "target", "step", "words"),
    [
        ("Pick", None, "GoTo(Fridge_2, 0.5, 30)", "Pick unseen do GoTo fridge _2 0.50 30d ."),
        (
            "Pick",
            "Mug_1",
            "Pick(left, Mug_1) & Open(right, Fridge_2)",
            "Pick mug _1 do Pick left mug _1 & Open right fridge _2 .",
        ),
        ("Release", "", "Release(left)", "Release do Release left ."),
    ],
)
def test_answers(verb: str, target: str | None, step: str, words: str) -> None:
    written = answer_words(verb, target, PlanStep.parse(step))
    assert " ".join(written) == words
    assert read_step(written, {id_words(name): name for name in ("Mug_1", "Egg_1", "Fridge_2")}) == PlanStep.parse(step)


@pytest.mark.parametrize(
    ("center", "words"),
    [
        ((0.6, 0.0, 0.3), "at 0deg 0.6m 0.9m 1.3arm 1.3arm -10deg"),
        ((0.5, 0.2, 0.4), "at 20deg 0.5m 1.0m 1.0arm 1.3arm 0deg"),
        ((0.0, -0.2, -0.1), "at -90deg 0.2m 0.5m 1.3arm 1.0arm -70deg"),  # straight below the right shoulder
        ((0.3, -0.3, -0.58), "at -40deg 0.4m 0.1m 2.0arm 2.0arm -70deg"),  # halves go to the even one
        ((0.0, 5.0, 9.0), "at 90deg 2.0m 2.0m 2.0arm 2.0arm 60deg"),
        ((-1.0, -1e-9, -0.6), "at -180deg 1.0m 0.1m 2.0arm 2.0arm -40deg"),
    ],
)
def test_places(center: tuple[float, float, float], words: str) -> None:
    bodies = np.zeros((len(KEY_BODIES), 3))
    for side, y in (("left", 0.2), ("right", -0.2)):  # arms of half a metre, stretched forward
        for part, x in (("shoulder", 0.0), ("elbow", 0.25), ("hand", 0.5)):
            bodies[KEY_BODIES.index(f"{side}_{part}")] = x, y, 0.4
    bodies[KEY_BODIES.index("left_ankle"), 2] = -0.6
    written = place_words(np.array(center), bodies)
    assert " ".join(written) == words
    assert all(word in may for word, may in zip(written, PLACES, strict=True))
    assert {word for may in PLACES[1:] for word in may} == {word for scale in PLACE_SCALES for word in scale}
    assert not {word for scale in PLACE_SCALES for word in scale} & {*number_words(), *MARKERS}
    step = PlanStep.parse("MoveDown(0.2)")
    assert answer_words("Pick", "Mug_1", step, ("body", "so", "height"), written)[:13] == (
        *("body", "so", "height", "Pick", "mug", "_1"),
        *written,
    )
