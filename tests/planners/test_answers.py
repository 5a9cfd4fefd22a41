"""The grammar of answers: every step can be said, nothing else can."""

from __future__ import annotations

import numpy as np
import pytest

from interface.actions import ACTIONS
from interface.belief import Belief
from interface.observation import HistoryItem
from interface.steps import PlanStep
from proprio_mllm.model.wording import END, PLACES, Words, answer_words, place_words, read_step
from proprio_mllm.planners.answers import AnswerGrammar

IDS = ("DiningTable_1", "DiningTable_2", "Mug_1", "TVStand_1", "Fridge_1", "Zubo_1")
STEPS = (
    "Pick(left, Mug_1) & Open(right, Fridge_1)",
    "GoTo(DiningTable_2, auto, -20)",
    "GoTo(TVStand_1, 0.5)",
    "MoveUp(0.15)",
    "RotateLeft(90)",
    "Release(left)",
    "Place(right, Zubo_1) & Place(left, Zubo_1)",
    "Lift(Mug_1)",
    "Done()",
)


def said(words: tuple[str, ...], grammar: AnswerGrammar) -> bool:
    return all(word in grammar.allowed(words[:number]) for number, word in enumerate(words))


@pytest.mark.parametrize("text", STEPS)
def test_every_step_can_be_said_and_is_read_back(text: str) -> None:
    step, grammar = PlanStep.parse(text), AnswerGrammar(IDS)
    words = answer_words("Pick", "Mug_1", step)
    assert said(words, grammar)
    assert grammar.allowed(words) == []
    assert read_step(words, grammar.ids) == step


def test_a_reflection_comes_first_where_it_is_asked_for() -> None:
    step, reflecting = PlanStep.parse("MoveDown(0.2)"), AnswerGrammar(IDS, reflects=True)
    words = answer_words("Pick", "Mug_1", step, ("body", "so", "height"))
    assert said(words, reflecting) and not said(words, AnswerGrammar(IDS))
    assert not said(answer_words("Pick", "Mug_1", step), reflecting)
    assert reflecting.allowed(words) == [] and reflecting.allowed(words[:3]) == AnswerGrammar(IDS).allowed(())
    assert read_step(words, reflecting.ids) == step


def test_a_place_stands_before_the_step_where_it_may_be_said() -> None:
    step, places = PlanStep.parse("MoveDown(0.2)"), AnswerGrammar(IDS, places=True)
    place = place_words(np.array([0.5, 0.2, 0.3]), np.eye(14, 3))
    words = answer_words("Pick", "Mug_1", step, place=place)
    assert said(words, places) and not said(words, AnswerGrammar(IDS))
    assert said(answer_words("Pick", "Mug_1", step), places)  # it need not be said
    assert said(answer_words("Pick", None, step), places)
    assert "at" not in places.allowed(("Pick", "unseen"))
    assert places.allowed(words[:6]) == list(PLACES[3]) and places.allowed(words[:10]) == ["do"]
    assert read_step(words, places.ids) == step


def test_a_place_that_is_told_is_said() -> None:
    step, place = PlanStep.parse("MoveDown(0.2)"), ("at", "20deg", "0.6m", "0.9arm")
    asked: list[Words] = []
    told = AnswerGrammar(IDS, places=True, place=lambda thing: asked.append(thing) or (place if thing[0] == "mug" else ()))
    words = answer_words("Pick", "Mug_1", step, place=place)
    assert said(words, told) and set(asked) == {("mug", "_1")}
    assert [told.allowed(words[:size]) for size in range(3, 8)] == [["at"], ["20deg"], ["0.6m"], ["0.9arm"], ["do"]]
    assert told.allowed(("Pick", "zubo", "_1")) == ["do"]
    assert said(answer_words("Pick", None, step), told) and said(answer_words("Done", "", PlanStep.parse("Done()")), told)


@pytest.mark.parametrize(
    "text",
    [
        "Pick(left, DiningTable_1)",  # furniture
        "Pick(left, Mug_1) & Pick(right, Mug_1)",  # one thing for two arms
        "GoTo(Mug_2)",  # not known
    ],
)
def test_what_cannot_be_done_cannot_be_said(text: str) -> None:
    assert not said(answer_words("Pick", "Mug_1", PlanStep.parse(text)), AnswerGrammar(IDS))


@pytest.mark.parametrize(
    ("text", "held"),
    [
        ("Pick(left, Zubo_1)", "Mug_1 in that hand"),
        ("Pick(right, Mug_1)", "Mug_1 in the other one"),
        ("Place(right, DiningTable_1)", "nothing in that one"),
        ("Place(left, DiningTable_1) & Place(right, DiningTable_1)", "nothing in the second one"),
    ],
)
def test_what_is_bound_to_be_refused_cannot_be_said(text: str, held: str) -> None:
    words = answer_words("Pick", "Zubo_1", PlanStep.parse(text))
    belief = Belief.of([HistoryItem("Pick(left, Mug_1)", "Pick(left, Mug_1) ok")])
    assert said(words, AnswerGrammar(IDS)), held
    assert not said(words, AnswerGrammar(IDS, belief)), held


def test_what_is_held_is_not_wanted_in_a_hand() -> None:
    belief = Belief.of([HistoryItem("Pick(left, Mug_1)", "Pick(left, Mug_1) ok")])
    assert AnswerGrammar(IDS, belief).allowed(["Pick"]) == ["zubo", "unseen"]
    assert "mug" in AnswerGrammar(IDS, belief).allowed(["Clean"])


def test_what_is_not_seen_is_looked_for_where_one_has_not_been() -> None:
    log = ["GoTo(DiningTable_1) ok", "GoTo(Fridge_1) ok", "GoTo(DiningTable_2) BlockedPath"]
    belief = Belief.of([HistoryItem(line.rpartition(" ")[0], line) for line in log])
    grammar = AnswerGrammar(IDS, belief)
    search, fetch = ["Pick", "unseen", "do", "GoTo"], ["Pick", "mug", "_1", "do", "GoTo"]
    assert grammar.allowed([*search, "dining", "table"]) == ["_2"]
    assert "fridge" in grammar.allowed(search)  # it has not been opened
    assert grammar.allowed([*fetch, "dining", "table"]) == ["_1", "_2"]
    assert AnswerGrammar(IDS).allowed([*search, "dining", "table"]) == ["_1", "_2"]
    everywhere = [HistoryItem(f"GoTo({name})", f"GoTo({name}) ok") for name in IDS]
    assert AnswerGrammar(IDS, Belief.of(everywhere)).allowed(search) == ["fridge"]
    opened = [
        *everywhere,
        HistoryItem("Open(left, Fridge_1)", "Open(left, Fridge_1) ok"),
        HistoryItem("Release(left)", "Release(left) ok"),
    ]
    assert AnswerGrammar(IDS, Belief.of(opened)).allowed(search) == ["dining", "tv", "fridge"]  # never what nothing lies in


def test_an_arm_tries_before_a_fourth_walk_to_one_thing() -> None:
    walks = [HistoryItem("GoTo(Mug_1)", f"GoTo(Mug_1) {code}") for code in ("ok", "BlockedPath", "ok", "ok")]
    tried = HistoryItem("Pick(left, Mug_1)", "Pick(left, Mug_1) TooFar")
    for log, walks_on in ((walks[:-1], True), (walks, False), ([*walks, tried], True)):
        assert ("GoTo" in AnswerGrammar(IDS, Belief.of(log)).allowed(["Pick", "mug", "_1", "do"])) is walks_on


@pytest.mark.parametrize(
    ("last", "ends"), [("Pick(left, Mug_1) ok", True), ("Pick(left, Mug_1) Slipped", False), ("GoTo(Mug_1) ok", False)]
)
def test_a_task_ends_with_what_hands_have_done(last: str, ends: bool) -> None:
    belief = Belief.of(
        [HistoryItem("Pick(right, Zubo_1)", "Pick(right, Zubo_1) ok"), HistoryItem(last.rpartition(" ")[0], last)]
    )
    assert ("Done" in AnswerGrammar(IDS, belief).allowed(["Place", "zubo", "_1", "do"])) is ends
    assert "Done" in AnswerGrammar(IDS).allowed(["Place", "zubo", "_1", "do"])


def test_what_is_wanted_need_not_have_been_seen() -> None:
    assert AnswerGrammar(["Fridge_1"]).allowed(["Pick"]) == ["unseen"]


@pytest.mark.parametrize(
    "log", [(), ("Pick(left, Mug_1) ok",), ("Open(left, Fridge_1) ok", "GoTo(Fridge_1) InUse"), ("Lift(Zubo_1) ok",)]
)
def test_whatever_may_be_done_can_be_said_to_its_end(log: tuple[str, ...]) -> None:
    belief = Belief.of([HistoryItem(line.rpartition(" ")[0], line) for line in log])
    rng, grammar = np.random.default_rng(0), AnswerGrammar(IDS, belief)
    for _ in range(100):
        words: list[str] = []
        while options := grammar.allowed(words):
            words.append(options[int(rng.integers(len(options)))])
        assert [belief.refusal(action) for action in read_step(words, grammar.ids).actions] in ([None], [None, None])


def test_whatever_is_said_is_a_step() -> None:
    rng, grammar = np.random.default_rng(0), AnswerGrammar(IDS)
    seen: set[str] = set()
    for _ in range(400):
        words: list[str] = []
        while options := grammar.allowed(words):
            words.append(options[int(rng.integers(len(options)))])
        assert words[-1] == END
        seen |= {action.name for action in read_step(words, grammar.ids).actions}
    assert seen == set(ACTIONS)
