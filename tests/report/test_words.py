"""Goals, codes and margins in words."""

from __future__ import annotations

import pytest

from data.interface.failures import FAILURES, FailureCode
from proprio_mllm.report.words import code_in_words, goal_in_words, margins_in_words
from sim.tasks.predicates import Predicate
from sim.tasks.task import load_benchmark


def test_goals_are_printed_from_their_plain_form() -> None:
    both = Predicate("and", of=(Predicate("open", "Fridge_1"), Predicate("on", "Mug_1", "Table_1")))
    assert goal_in_words(both.to_json()) == "and(open(Fridge_1), on(Mug_1, Table_1))"
    count = Predicate("count", of=(both, Predicate("not", of=(Predicate("held", "Cup_1"),))), at_least=1)
    assert goal_in_words(count.to_json()) == f"count({goal_in_words(both.to_json())}, not(held(Cup_1)), at_least=1)"
    unheard_of = {"kind": "filled", "object_id": "Cup_1", "with": {"kind": "liquid", "litres": 0.2}, "hot": True}
    assert goal_in_words(unheard_of) == "filled(Cup_1, liquid(litres=0.2), hot=True)"


def test_every_goal_of_the_benchmark_has_words() -> None:
    for task in load_benchmark():
        for goal in task.goals:
            assert all(name in goal_in_words(goal.to_json()) for name in goal.object_ids())


@pytest.mark.parametrize("code", FailureCode)
def test_every_margin_of_every_code_has_a_sentence(code: FailureCode) -> None:
    margins = dict.fromkeys(FAILURES[code].margins, -0.25)
    said = margins_in_words("x1", code.value, margins)
    assert len(said) == len(margins)
    assert all(sentence.endswith(f"({name} -0.25)") for sentence, name in zip(said, margins, strict=True))
    assert code_in_words(code.value) == FAILURES[code].meaning


def test_signs_decide_the_words() -> None:
    def say(code: str, **margins: float) -> str:
        return " ".join(margins_in_words("x1", code, margins))

    assert say("BodyTooHigh", height_m=-0.12) == "X1's pelvis is 0.12 m too high (height_m -0.12)"
    assert say("BodyTooLow", height_m=0.2).startswith("X1's pelvis is 0.20 m too low")
    assert "last 0.05 m down" in say("HeightLimit", height_m=-0.05) and "up" in say("HeightLimit", height_m=0.05)
    assert "beyond X1's reach" in say("TooFar", reach_m=0.3) and "within X1's reach" in say("BodyTooLow", reach_m=-0.3)
    assert "above" in say("TooHeavy", mass_kg=1.0) and "below" in say("TooHeavy", mass_kg=-1.0)
    assert say("Unheard", depth_m=0.1) == "depth_m +0.1" and code_in_words("Unheard") == "Unheard"
