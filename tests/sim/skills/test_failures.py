"""How skills end: outcomes carry code, category and margins."""

import pytest

from interface.failures import FailureCategory, FailureCode
from interface.steps import Action
from sim.skills.failures import SkillFailure, failed, succeeded


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
