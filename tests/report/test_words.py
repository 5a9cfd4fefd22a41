"""Goals, codes and margins in words, and which failure decided."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from data.records import Action, FailureCategory
from proprio_mllm.evaluation.attribution import INVALID_OUTPUT, attribute
from proprio_mllm.report.deciding import Deciding, deciding_failure
from proprio_mllm.report.words import code_in_words, goal_in_words, margins_in_words
from sim.failures import FAILURES, FailureCode, category_of
from sim.tasks.predicates import Predicate
from sim.tasks.task import load_benchmark
from tests.report.ledgers import failed, fine, step


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


def _random_trace(rng: np.random.Generator) -> list[dict[str, Any]]:
    trace = []
    for _ in range(int(rng.integers(1, 8))):
        if rng.random() < 0.2:
            trace.append(step(failed("", INVALID_OUTPUT, "logical"), text="well"))
            continue
        arms = ["left", "right"][: int(rng.integers(1, 3))]
        outcomes = []
        for arm in arms:
            action = f"{rng.choice(['Pick', 'Open'])}({arm}, {rng.choice(['Mug_1', 'Cup_1', 'Fridge_1'])})"
            code = rng.choice(list(FailureCode))
            kind = category_of(FailureCode(code), Action.parse(action)).value
            outcomes.append(fine(action) if rng.random() < 0.4 else failed(action, str(code), kind))
        trace.append(step(*outcomes))
    return trace


def test_the_deciding_failure_has_the_type_of_the_ledger() -> None:
    rng = np.random.default_rng(0)
    kinds = set()
    for _ in range(2000):
        trace, unmet = _random_trace(rng), set(rng.choice(["Mug_1", "Cup_1", "Fridge_1"], int(rng.integers(3))))
        found = deciding_failure(trace, unmet)
        expected = attribute(trace, unmet)
        kinds.add((found is None, found is not None and found.about_goal, expected))
        if found is None:
            assert expected is FailureCategory.LOGICAL
        else:
            assert trace[found.step]["outcomes"][found.outcome]["category"] == expected.value
    assert len(kinds) == 7, "every kind of decision was met"


def test_a_failure_made_good_does_not_decide() -> None:
    trace = [
        step(failed("Pick(left, Cup_1)", "TooFar", "navigation")),
        step(failed("Pick(left, Mug_1)", "TooFar", "navigation")),
        step(fine("Pick(right, Mug_1)")),
    ]
    assert deciding_failure(trace, {"Mug_1"}) == Deciding(0, 0, about_goal=False)
    assert deciding_failure(trace, {"Cup_1"}) == Deciding(0, 0, about_goal=True)
    assert deciding_failure(trace[1:], {"Mug_1"}) is None
