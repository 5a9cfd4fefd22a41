"""Failure codes: the table is complete, and outcomes carry code, category and margins."""

import pytest

from data.records import Action, FailureCategory
from sim.skills.failures import FAILURES, FailureCode, SkillFailure, category_of, failed, succeeded


def test_every_code_has_a_meaning():
    assert set(FAILURES) == set(FailureCode)
    assert all(spec.meaning for spec in FAILURES.values())


@pytest.mark.parametrize(
    ("text", "category"),
    [
        ("MoveAhead(0.5)", FailureCategory.NAVIGATION),
        ("MoveDown(0.1)", FailureCategory.BODY_ADJUSTMENT),
        ("Pick(left, Mug_1)", FailureCategory.LOGICAL),
    ],
)
def test_contingencies_take_the_category_of_their_action(text, category):
    assert category_of(FailureCode.NOTHING_HAPPENED, Action.parse(text)) is category


def test_outcome_of_a_failure():
    action = Action.parse("Pick(left, Mug_1)")
    outcome = failed(action, SkillFailure(FailureCode.BODY_TOO_HIGH, {"height_m": -0.25, "reach_m": 0.1}))
    assert not outcome.success and outcome.code == "BodyTooHigh"
    assert outcome.category is FailureCategory.BODY_ADJUSTMENT
    assert outcome.margins == {"height_m": -0.25, "reach_m": 0.1}
    assert succeeded(action).success


def test_margins_must_belong_to_the_code():
    with pytest.raises(ValueError, match=r"\['mass_kg'\] do not belong to TooFar"):
        SkillFailure(FailureCode.TOO_FAR, {"mass_kg": 1.0})
