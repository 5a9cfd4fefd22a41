"""Ids and steps in words."""

from __future__ import annotations

import pytest

from proprio_mllm.planners.chat.spoken import plan_words, step_words, type_words


@pytest.mark.parametrize(
    ("object_id", "words"),
    [("CoffeeTable_1", "coffee table"), ("TVStand_12", "tv stand"), ("mug", "mug"), ("red_mug", "red mug"), ("Mug1", "mug")],
)
def test_a_type_in_words(object_id: str, words: str) -> None:
    assert type_words(object_id) == words


@pytest.mark.parametrize(
    ("step", "words"),
    [
        ("Pick(left, Mug_1) & Open(right, Fridge_1)", "pick mug and open fridge"),
        ("GoTo(TVStand_2, auto, -20)", "go to tv stand"),
        ("RotateLeft(60)", "rotate left"),
        ("Release(right)", "release"),
        ("3. Take the phone out of the drawer!", "take the phone out of the drawer"),
    ],
)
def test_a_step_in_words(step: str, words: str) -> None:
    assert step_words(step) == words


def test_a_plan_in_words() -> None:
    assert plan_words(["GoTo(Mug_1)", "Pick(left, Mug_1)"]) == "go to mug, pick mug"
