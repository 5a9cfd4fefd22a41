"""What a belief rules out: what is bound to be refused, and nothing that could succeed."""

from __future__ import annotations

from collections import Counter

import pytest

from interface.belief import Belief
from interface.effects import Condition
from interface.observation import HistoryItem
from interface.steps import Action
from proprio_mllm.evaluation.lessons import WordsOnly
from proprio_mllm.planners.scripted.planner import ScriptedPlanner


def believed(*log: str, shutting: tuple[str, ...] = ()) -> Belief:
    return Belief.of([HistoryItem(line.rpartition(" ")[0], line) for line in log], shutting)


@pytest.mark.parametrize(
    ("log", "call", "code"),
    [
        ((), "Place(left, Shelf_1)", "HandEmpty"),
        ((), "Pick(left, Mug_1)", None),
        (("Pick(left, Mug_1) ok",), "Pick(left, Bowl_1)", "HandOccupied"),
        (("Pick(left, Mug_1) ok",), "Pick(right, Mug_1)", "AlreadyHeld"),
        (("Pick(left, Mug_1) ok",), "Place(left, Mug_1)", "NotReceptacle"),
        (("Pick(left, Mug_1) ok",), "Lift(Box_1)", "HandOccupied"),
        (("Pick(left, Mug_1) ok", "Place(left, Shelf_1) ok"), "Pick(left, Mug_1)", None),
        (("Pick(left, Mug_1) Slipped",), "Pick(left, Mug_1)", None),
        (("Pick(left, Box_1) NeedsTwoHands",), "Pick(right, Box_1)", "NeedsTwoHands"),
        (("Lift(Box_1) ok",), "Pick(left, Mug_1)", "BothHandsBusy"),
        (("Pick(left, Rug_1) NotPickupable",), "Pick(left, Rug_1)", "NotPickupable"),
        (("Place(left, Fridge_1) ReceptacleClosed", "Pick(left, Mug_1) ok"), "Place(left, Fridge_1)", "ReceptacleClosed"),
        (("ToggleOn(left, Lamp_1) ok",), "ToggleOn(right, Lamp_1)", "AlreadyInState"),
        (("ToggleOn(left, Lamp_1) ok",), "ToggleOff(right, Lamp_1)", None),
        (("Open(left, Drawer_1) ok", "Open(left, Drawer_2) ok"), "Open(left, Drawer_1)", "AlreadyInState"),
        (("Open(left, Drawer_1) ok",), "Open(right, Drawer_1)", None),  # it may have fallen shut
        (("Open(left, Drawer_1) ok",), "Release(left)", None),  # it may have to be held
        (("Open(left, Drawer_1) ok",), "Release(right)", "HandEmpty"),
        ((), "Fill(left, Sink_1)", "HandEmpty"),
        (("Pick(left, Cup_1) ok",), "Fill(left, Sink_1)", None),  # whether water runs nobody has told
        (("Pick(left, Cup_1) ok", "ToggleOff(right, Sink_1) ok"), "Fill(left, Sink_1)", "SourceOff"),
        (("Pick(left, Cup_1) ok",), "Pour(left, Bowl_1)", None),  # whether it is filled nobody has told
        (("Lift(Rug_1) NotLiftable",), "Lift(Rug_1)", "NotLiftable"),
        (("Pick(left, Mug_1) Broke",), "Pick(right, Mug_1)", "ObjectBroken"),
        (("Pick(left, Mug_1) ok", "Place(left, Shelf_1) Broke"), "Pick(right, Mug_1)", "ObjectBroken"),
        (("Pick(left, Jug_1) ok", "Place(left, Bowl_1) Broke", "Pick(left, Cup_1) ok"), "Pour(left, Bowl_1)", None),
        (("Pick(left, Cup_1) ok", "Fill(left, Sink_1) ObjectBroken"), "ToggleOff(right, Sink_1)", None),
        (("Pick(left, Cup_1) ok", "Fill(left, Sink_1) ObjectBroken", "Release(left) ok"), "Pick(left, Cup_1)", "ObjectBroken"),
    ],
)
def test_what_is_bound_to_be_refused(log: tuple[str, ...], call: str, code: str | None) -> None:
    assert believed(*log).refusal(Action.parse(call)) == code


@pytest.mark.parametrize(
    ("log", "call", "code"),
    [
        (("Open(left, Drawer_1) ok",), "GoTo(Shelf_1)", "InUse"),
        (("Open(left, Drawer_1) ok",), "Pick(left, Mug_1)", "HandOccupied"),
        (("Open(left, Drawer_1) ok",), "Pick(right, Drawer_1)", "AlreadyHeld"),
        (("Open(left, Drawer_1) ok", "Pick(right, Mug_1) ok"), "Place(right, Drawer_1)", None),
        (("Open(left, Drawer_1) ok", "Release(left) ok"), "GoTo(Shelf_1)", None),
        ((), "Pick(left, Drawer_1)", "NotPickupable"),
        (("Lift(Drawer_1) NotLiftable",), "Lift(Drawer_1)", "NotLiftable"),
    ],
)
def test_a_door_that_falls_shut_stays_in_the_hand(log: tuple[str, ...], call: str, code: str | None) -> None:
    assert believed(*log, shutting=("Drawer_1",)).refusal(Action.parse(call)) == code


def test_what_is_behind_the_door_that_was_just_opened_tells_that_it_is_shut_again() -> None:
    opened = believed("Open(left, Drawer_1) ok", "Pick(right, Mug_1) ReceptacleClosed")
    assert opened.state.is_in(Condition.OPEN, "Drawer_1") is False
    assert opened.shut_away == {"Mug_1"}
    assert believed("Pick(right, Mug_1) ReceptacleClosed").state.conditions[Condition.OPEN] == {}


def test_what_was_done_for_good_is_known_to_be_done() -> None:
    done = believed("Slice(left, Bread_1) ok", "Clean(left, Plate_1) ok", "UseUp(left, Soap_1) ok", "Pour(left, Mug_1) ok")
    things = {"sliced": "Bread_1", "clean": "Plate_1", "used_up": "Soap_1", "filled": "Mug_1"}
    assert all(done.done(kind, name) for kind, name in things.items())
    assert not any(Belief().done(kind, name) for kind, name in things.items())
    assert not done.done("cooked", "Bread_1")  # nobody tells


def test_legs_that_came_to_their_end_are_taken_to_have_gone_half_the_way() -> None:
    legs = believed("MoveDown(0.25) ok", "MoveUp(0.125) ok")
    assert (legs.lowered_m, legs.heights, legs.at_limit) == (0.125, [-0.25, 0.125], set())
    legs = believed("MoveDown(0.25) ok", "MoveDown(0.5) HeightLimit")
    assert (legs.lowered_m, legs.heights, legs.at_limit) == (0.5, [-0.25, -0.5], {False})
    assert believed("MoveUp(0.5) HeightLimit").at_limit == {True}
    assert believed("MoveDown(0.5) HeightLimit", "MoveUp(0.125) ok").at_limit == set()
    assert believed("MoveDown(0.25) InUse").lowered_m == 0.0
    assert believed("MoveDown(0.25) ok", "GoTo(Shelf_1) ok").heights == []  # another stance, as low as before


def test_what_is_held_against_an_action_is_so() -> None:
    """In the text world, mistakes among the steps: no refused action succeeds, and most refusals name the code."""
    seen: Counter[str] = Counter()
    for seed in range(60):
        episode, teacher = WordsOnly(-1 - seed), ScriptedPlanner()
        while episode.steps < 30 and not episode.world.done():
            step, job = teacher.decide(episode.shown())
            if job is None:
                break
            step = episode.world.mistake(step) if episode.rng.random() < 0.4 else step
            expected = [Belief.of(episode.shown().history).refusal(one) for one in step.actions]
            episode.take(step)
            codes = [text.rpartition(" ")[2] for text in episode.shown().history[-1].feedback.split(";")]
            seen.update(
                "as said" if code == one else "succeeded" if code == "ok" else "other"
                for one, code in zip(expected, codes, strict=True)
                if one is not None
            )
    assert seen["succeeded"] == 0
    assert seen["as said"] > 3 * seen["other"] + 20
