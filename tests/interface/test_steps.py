from __future__ import annotations

import pytest

from interface.actions import ACTIONS
from interface.bodies import Arm
from interface.feedback import ActionOutcome, Feedback
from interface.steps import Action, ActionError, PlanStep


@pytest.mark.parametrize(
    "text",
    [
        "Pick(left, Mug_1) & Place(right, DiningTable_1)",
        "GoTo(Fridge_1)",
        "GoTo(Fridge_1, 0.6)",
        "GoTo(Fridge_1, 0.6, -15)",
        "GoTo(Fridge_1, auto, 30)",
        "MoveDown(0.25)",
        "RotateLeft()",
        "Lift(Box_1)",
        "ResetArm(right)",
        "Done()",
    ],
)
def test_grammar_round_trip(text: str) -> None:
    assert PlanStep.parse(text).to_text() == text


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "not an action: ''"),
        ("Pick(left, Mug_1", "not an action"),
        ("Jump()", "unknown action 'Jump'; allowed: GoTo"),
        ("Pick(Mug_1)", "Pick needs an arm first"),
        ("Pick(left)", "Pick needs an object id"),
        ("Pick(left, Mug 1)", "object id 'Mug 1'"),
        ("MoveDown(nan)", "amount nan outside"),
        ("MoveDown(inf)", "amount inf outside"),
        ("MoveDown(low)", "'low' is not a number"),
        ("MoveDown(0.1, 2)", "superfluous arguments"),
        ("GoTo(Mug_1, 0.5, 500)", "bearing 500.0"),
        ("Lift(Box_1) & Pick(left, Mug_1)", "only arm actions run in parallel"),
        ("Pick(left, Mug_1) & Place(left, Sink_1)", "both actions use the left arm"),
        ("Done() & Done() & Done()", "one or two actions, got 3"),
    ],
)
def test_grammar_refuses(text: str, message: str) -> None:
    with pytest.raises(ActionError, match=message.replace("(", r"\(").replace("+", r"\+")):
        PlanStep.parse(text)


def test_action_refuses_an_arm_where_none_belongs() -> None:
    with pytest.raises(ActionError, match="takes no arm"):
        Action("MoveAhead", arm=Arm.LEFT)
    with pytest.raises(ActionError, match="takes no object"):
        Action("MoveAhead", object_id="Mug_1")
    with pytest.raises(ActionError, match="takes no amount"):
        Action("Pick", arm=Arm.LEFT, object_id="Mug_1", amount=1.0)


def test_every_action_has_a_default_or_no_amount() -> None:
    for spec in ACTIONS.values():
        for amount in spec.amounts:
            assert amount.default is None or amount.low <= amount.default <= amount.high


def test_feedback_text_carries_codes_and_no_margins() -> None:
    action = Action.parse("Pick(left, Mug_1)")
    feedback = Feedback((ActionOutcome(action, False, code="TooFar", margins={"reach_m": -0.123}),), 1.0)
    assert feedback.to_text() == "Pick(left, Mug_1) TooFar"
    assert not feedback.success
