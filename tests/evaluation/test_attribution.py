"""The attribution rule on small traces, and against the rule read literally on random ones."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest

from interface.actions import ActionKind
from interface.failures import INVALID_OUTPUT, FailureCategory, FailureCode
from interface.feedback import category_of
from interface.steps import Action
from proprio_mllm.evaluation.attribution import Deciding, attribute, deciding_failure, unmet_objects
from sim.tasks.task import load_benchmark


def step(*outcomes: tuple[str, str, str]) -> dict:
    return {
        "outcomes": [
            {"action": action, "ok": not code, "code": code, "category": category or None}
            for action, code, category in outcomes
        ]
    }


def ok(action: str) -> dict:
    return step((action, "", ""))


FAR = ("Pick(left, Mug_1)", "TooFar", "navigation")
HIGH = ("Pick(left, Mug_1)", "BodyTooHigh", "body_adjustment")
GOT = ("Pick(right, Mug_1)", "", "")
OTHER = ("Pick(left, Cup_1)", "HandOccupied", "logical")
BLOCKED = ("MoveAhead(1)", "BlockedPath", "navigation")
LIMIT = ("MoveUp(1)", "HeightLimit", "body_adjustment")
INVALID = ("", "InvalidOutput", "logical")
LOST_WAY = ("GoTo(Table_1)", "NoFreePose", "navigation")
PUT_FAR = ("Place(right, Table_1)", "TooFar", "navigation")


@pytest.mark.parametrize(
    ("steps", "unmet", "expected"),
    [
        ([], {"Mug_1"}, "logical"),
        ([step(FAR)], {"Mug_1"}, "navigation"),
        ([step(FAR), step(HIGH)], {"Mug_1"}, "body_adjustment"),  # as many of both: the last one
        ([step(FAR), step(FAR), step(HIGH)], {"Mug_1"}, "navigation"),  # the more frequent one
        ([step(HIGH), step(OTHER)], {"Mug_1"}, "body_adjustment"),  # the goal's object goes first
        ([step(HIGH), step(OTHER), step(OTHER)], {"Mug_1"}, "body_adjustment"),
        ([step(HIGH), step(OTHER)], {"Plate_1"}, "logical"),  # else all count
        ([step(HIGH), step(GOT)], {"Table_1"}, "logical"),  # made good by the other arm
        ([step(HIGH), step(GOT), step(BLOCKED)], {"Mug_1"}, "navigation"),
        ([step(GOT), step(HIGH)], {"Mug_1"}, "body_adjustment"),  # an earlier success makes nothing good
        ([step(FAR, OTHER)], {"Cup_1", "Mug_1"}, "logical"),
        # what names no object counts like what is about a goal, until something gets the robot further
        ([step(BLOCKED), step(BLOCKED), step(OTHER)], {"Cup_1"}, "navigation"),
        ([step(BLOCKED), ok("GoTo(Table_1)"), ok("Done()")], {"Mug_1"}, "logical"),
        ([step(BLOCKED), step(GOT)], {"Table_1"}, "logical"),
        ([step(BLOCKED), ok("RotateLeft(90)")], {"Mug_1"}, "navigation"),  # turning gets it nowhere
        ([step(BLOCKED), ok("MoveAhead(0.2)")], {"Mug_1"}, "logical"),
        ([step(LIMIT), ok("MoveDown(0.2)")], {"Mug_1"}, "body_adjustment"),
        ([step(LIMIT), ok("GoTo(Table_1)")], {"Mug_1"}, "logical"),
        # invalid replies
        ([step(BLOCKED), step(INVALID)], {"Mug_1"}, "logical"),
        ([step(FAR), step(FAR), step(INVALID)], {"Mug_1"}, "navigation"),
        ([step(FAR), step(INVALID), step(INVALID)], {"Mug_1"}, "logical"),
        ([step(INVALID), ok("GoTo(Table_1)"), step(FAR)], {"Mug_1"}, "navigation"),
        # walks to an object
        ([step(LOST_WAY), ok("GoTo(Table_1)")], {"Table_1"}, "logical"),
        ([step(LOST_WAY), ok("Open(left, Table_1)")], {"Table_1"}, "logical"),
        ([step(LOST_WAY), ok("GoTo(Chair_1)")], {"Table_1"}, "navigation"),
        # putting down: what counts is the load, whichever arm has it
        ([step(GOT), ok("Pick(left, Cup_1)"), step(PUT_FAR), ok("Place(left, Table_1)")], {"Mug_1", "Table_1"}, "navigation"),
        ([step(GOT), step(PUT_FAR), ok("Place(right, Table_1)")], {"Mug_1", "Table_1"}, "logical"),
        ([step(GOT), step(PUT_FAR), step(OTHER), step(OTHER)], {"Mug_1", "Shelf_1"}, "navigation"),  # the load is the goal's
        (
            [
                step(GOT),
                step(("Place(right, Table_1)", "Dropped", "logical")),
                ok("Pick(left, Mug_1)"),
                ok("Place(left, Table_1)"),
                step(FAR),
            ],
            {"Mug_1"},
            "navigation",
        ),
    ],
)
def test_attribution(steps, unmet, expected) -> None:
    assert attribute(steps, unmet) is FailureCategory(expected)


def test_what_the_deciding_failure_is_about() -> None:
    trace = [step(OTHER), step(FAR), step(BLOCKED)]
    assert deciding_failure(trace, {"Mug_1"}) == Deciding(2, 0, "nothing", FailureCategory.NAVIGATION)
    assert deciding_failure(trace[:2], {"Mug_1"}) == Deciding(1, 0, "goal", FailureCategory.NAVIGATION)
    assert deciding_failure(trace[:1], {"Mug_1"}) == Deciding(0, 0, "other", FailureCategory.LOGICAL)
    assert deciding_failure([step(HIGH), step(GOT)], {"Mug_1"}) is None


def test_unmet_goals_are_about_what_their_objects_started_in() -> None:
    """A cabinet that has to be opened first is in no goal, and still is what a failed episode may be about."""
    met = 0
    for task in load_benchmark():
        homes = {placement.object_id: placement.receptacle for placement in task.placements}
        for number, goal in enumerate(task.goals):
            named = set(goal.involved(homes))
            found = unmet_objects(task, [other != number for other in range(len(task.goals))])
            assert found == named | {homes[name] for name in named if name in homes}
            met += len(found) > len(named)
        assert unmet_objects(task, [True] * len(task.goals)) == frozenset()
    assert met, "some goal's object starts in a receptacle that no goal names"


NAMES = ("Mug_1", "Cup_1", "Fridge_1")


def _random_trace(rng: np.random.Generator) -> list[dict]:
    """Without Place, whose load the literal rule below does not know."""
    trace = []
    for _ in range(int(rng.integers(1, 9))):
        kind = rng.random()
        if kind < 0.15:
            trace.append(step(INVALID))
            continue
        if kind < 0.5:
            texts = [str(rng.choice(["MoveAhead(1)", "MoveUp(0.1)", "RotateLeft(90)", f"GoTo({rng.choice(NAMES)})"]))]
        else:
            texts = [
                f"{rng.choice(['Pick', 'Open'])}({arm}, {rng.choice(NAMES)})"
                for arm in ["left", "right"][: int(rng.integers(1, 3))]
            ]
        outcomes = []
        for text in texts:
            code = FailureCode(str(rng.choice(list(FailureCode))))
            fine = rng.random() < 0.4
            outcomes.append((text, "", "") if fine else (text, str(code), category_of(code, Action.parse(text)).value))
        trace.append(step(*outcomes))
    return trace


def _literally(trace: list[dict], unmet: set[str]) -> FailureCategory:
    """The rule of the documentation, one failure at a time with everything that came after it."""
    flat = [outcome for entry in trace for outcome in entry["outcomes"]]
    counted: dict[bool, list[str]] = {True: [], False: []}
    for number, outcome in enumerate(flat):
        if outcome["ok"]:
            continue
        later = [Action.parse(other["action"]) for other in flat[number + 1 :] if other["ok"]]
        further = any(other.name == "GoTo" or other.spec.kind in (ActionKind.ARM, ActionKind.TWO_ARM) for other in later)
        if outcome["code"] == INVALID_OUTPUT:
            good, about = further, True
        else:
            action = Action.parse(outcome["action"])
            good = any((other.name, other.object_id) == (action.name, action.object_id) for other in later)
            if action.object_id is None:
                good, about = good or further, True
            else:
                about = action.object_id in unmet
                good = good or (action.name == "GoTo" and any(other.object_id == action.object_id for other in later))
        if not good:
            counted[about].append(outcome["category"])
    votes = counted[True] or counted[False]
    if not votes:
        return FailureCategory.LOGICAL
    most = max(Counter(votes).values())
    return FailureCategory([vote for vote in votes if votes.count(vote) == most][-1])


def test_the_rule_is_the_documented_one_on_random_traces() -> None:
    rng = np.random.default_rng(0)
    kinds = set()
    for _ in range(3000):
        trace, unmet = _random_trace(rng), set(map(str, rng.choice(NAMES, int(rng.integers(3)))))
        found, given = deciding_failure(trace, unmet), attribute(trace, unmet)
        assert given is _literally(trace, unmet), (trace, unmet)
        kinds.add((None if found is None else found.about, given))
        if found is not None:
            assert trace[found.step]["outcomes"][found.outcome]["category"] == given.value
    assert len(kinds) == 10, "every kind of decision was met"
