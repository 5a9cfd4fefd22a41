"""The attribution rule on small traces."""

from __future__ import annotations

import pytest

from data.records import FailureCategory
from proprio_mllm.evaluation.attribution import attribute


def step(*outcomes: tuple[str, str, str]) -> dict:
    return {
        "outcomes": [
            {"action": action, "ok": not code, "code": code, "category": category or None}
            for action, code, category in outcomes
        ]
    }


FAR = ("Pick(left, Mug_1)", "TooFar", "navigation")
HIGH = ("Pick(left, Mug_1)", "BodyTooHigh", "body_adjustment")
GOT = ("Pick(right, Mug_1)", "", "")
OTHER = ("Pick(left, Cup_1)", "HandOccupied", "logical")
BLOCKED = ("MoveAhead(1)", "BlockedPath", "navigation")
INVALID = ("", "InvalidOutput", "logical")


@pytest.mark.parametrize(
    ("steps", "unmet", "expected"),
    [
        ([], {"Mug_1"}, "logical"),
        ([step(FAR)], {"Mug_1"}, "navigation"),
        ([step(FAR), step(HIGH)], {"Mug_1"}, "body_adjustment"),
        ([step(HIGH), step(OTHER)], {"Mug_1"}, "body_adjustment"),  # the goal's object goes first
        ([step(HIGH), step(OTHER)], {"Plate_1"}, "logical"),  # else the last failure
        ([step(HIGH), step(GOT)], {"Table_1"}, "logical"),  # made good by the other arm
        ([step(HIGH), step(GOT), step(BLOCKED)], {"Mug_1"}, "navigation"),
        ([step(GOT), step(HIGH)], {"Mug_1"}, "body_adjustment"),  # an earlier success makes nothing good
        ([step(BLOCKED), step(INVALID)], {"Mug_1"}, "logical"),
        ([step(FAR), step(INVALID)], {"Mug_1"}, "navigation"),
        ([step(FAR, OTHER)], {"Cup_1", "Mug_1"}, "logical"),
    ],
)
def test_attribution(steps, unmet, expected) -> None:
    assert attribute(steps, unmet) is FailureCategory(expected)
