"""Failure codes: the table is complete, and codes roll up to the paper's failure types."""

import pytest

from interface.failures import FAILURES, FailureCategory, FailureCode
from interface.feedback import ActionOutcome, Feedback, category_of
from interface.steps import Action


def test_every_code_has_a_meaning():
    assert set(FAILURES) == set(FailureCode)
    assert all(spec.meaning for spec in FAILURES.values())


@pytest.mark.parametrize(
    ("category", "codes"),
    [
        (FailureCategory.NAVIGATION, ("TooFar", "BlockedPath", "NoFreePose")),
        (FailureCategory.BODY_ADJUSTMENT, ("BodyTooHigh", "BodyTooLow", "HeightLimit")),
        (FailureCategory.LOGICAL, ("HandOccupied", "HandEmpty", "ReceptacleClosed", "NeedsTwoHands", "AlreadyInState")),
    ],
)
def test_codes_belong_to_the_papers_types(category, codes):
    assert {category_of(FailureCode(code), Action.parse("Pick(left, Mug_1)")) for code in codes} == {category}


def test_margins_and_luck_are_not_public():
    pick = Action.parse("Pick(left, Mug_1)")
    outcome = ActionOutcome(pick, False, "Slipped", FailureCategory.LOGICAL, {"gap_m": 0.1}, "it slipped", "slip")
    shown = Feedback((outcome, ActionOutcome(pick, True)), 2.0).public()
    assert [(one.margins, one.contingency) for one in shown.outcomes] == [({}, "")] * 2 and not shown.struck
    assert (shown.outcomes[0].code, shown.outcomes[0].message, shown.duration_s) == ("Slipped", "it slipped", 2.0)


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
