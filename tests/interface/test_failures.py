"""Failure codes: the table is complete, and codes roll up to the paper's failure types."""

import pytest

from interface.failures import FAILURES, FailureCategory, FailureCode
from interface.feedback import category_of
from interface.steps import Action


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
