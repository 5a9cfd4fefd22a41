"""The table of actions: which code comes first, what holds afterwards, and who may work beside whom."""

from __future__ import annotations

from dataclasses import fields, replace

import pytest

from interface.actions import ACTIONS, ActionKind, bringing_about, exclude_each_other, first_refusal
from interface.bodies import Arm
from interface.effects import Condition
from interface.facts import Affordances, Facts, ObjectFacts
from interface.failures import FAILURES, FailureCode
from interface.observation import HistoryItem
from interface.steps import Action
from interface.symbolic import SymbolicState, events_of


def can(*what: str) -> Affordances:
    """Nothing but this."""
    return Affordances(**{field.name: field.name in what for field in fields(Affordances)})


def world(
    hands: dict[Arm, str] | None = None,
    lifted: str | None = None,
    inside: dict[str, str] | None = None,
    mass_kg: float = 0.5,
    **states: dict[str, object],
) -> Facts:
    """A world of a few objects."""
    small, fixed = ("movable", "pickupable"), ("receptacle",)
    items = {
        "Mug_1": can(*small, "fillable"), "Jug_1": can(*small, "fillable"), "Bread_1": can(*small, "sliceable", "unsteady"),
        "Knife_1": can(*small, "cutter"), "Box_1": can("movable", "liftable"), "Fridge_1": can(*fixed, "openable", "encloses"),
        "Table_1": can(*fixed), "Sink_1": can(*fixed), "Faucet_1": can("toggleable"),
    }  # fmt: skip
    known: dict[str, dict[str, object]] = {
        "Jug_1": {"fill": 1.0}, "Box_1": {"two_handed": True}, "Faucet_1": {"outlet": "Faucet_1"},
        "Sink_1": {"outlet": "Faucet_1"},
    }  # fmt: skip
    places = {name: (place,) for name, place in (inside or {}).items()}
    objects = {
        name: ObjectFacts(
            name, affordances, mass_kg=mass_kg, carriers=places.get(name, ()), **known.get(name, {}) | states.get(name, {})  # type: ignore[arg-type]
        )
        for name, affordances in items.items()
    }  # fmt: skip
    return Facts(objects, dict.fromkeys(Arm) | (hands or {}), lifted, (1.0, 2.0))


def code(text: str, facts: Facts) -> str:
    refusal = first_refusal(Action.parse(text), facts)
    return "" if refusal is None else refusal.code


LEFT_MUG = {Arm.LEFT: "Mug_1"}


@pytest.mark.parametrize(
    ("text", "facts", "expected"),
    [
        ("Pick(left, Mug_1)", world(), ""),
        ("Pick(left, Jug_1)", world(hands=LEFT_MUG), "HandOccupied"),
        ("Pick(left, Mug_1)", world(lifted="Box_1", hands=LEFT_MUG), "BothHandsBusy"),  # before the hand itself
        ("Pick(left, Table_1)", world(), "NotPickupable"),
        ("Pick(left, Box_1)", world(), "NeedsTwoHands"),
        ("Pick(left, Box_1)", world(mass_kg=4.0), "TooHeavy"),  # before the number of hands
        ("Pick(left, Mug_1)", world(inside={"Mug_1": "Fridge_1"}), "ReceptacleClosed"),
        ("Place(left, Table_1)", world(), "HandEmpty"),
        ("Place(left, Fridge_1)", world(hands=LEFT_MUG), "ReceptacleClosed"),
        ("Place(left, Mug_1)", world(hands=LEFT_MUG), "NotReceptacle"),
        ("Place(left, Table_1)", world(hands=LEFT_MUG), ""),
        ("Open(right, Table_1)", world(), "NotOpenable"),
        ("Close(right, Fridge_1)", world(), "AlreadyInState"),
        ("Open(right, Fridge_1)", world(), ""),
        ("ToggleOff(right, Faucet_1)", world(), "AlreadyInState"),
        ("ToggleOn(right, Mug_1)", world(), "NotToggleable"),
        ("ToggleOn(right, Faucet_1)", world(), ""),
        ("Slice(left, Bread_1)", world(hands=LEFT_MUG), "NeedsTool"),
        ("Slice(left, Mug_1)", world(hands={Arm.LEFT: "Knife_1"}), "NotSliceable"),
        ("Slice(left, Bread_1)", world(hands={Arm.LEFT: "Knife_1"}), "NeedsSteadying"),
        ("Fill(left, Sink_1)", world(hands=LEFT_MUG), "SourceOff"),
        ("Fill(left, Table_1)", world(hands=LEFT_MUG), "NotFillable"),
        ("Pour(left, Jug_1)", world(hands=LEFT_MUG), "Empty"),
        ("Pour(left, Mug_1)", world(hands={Arm.LEFT: "Jug_1"}), ""),
        ("Lift(Mug_1)", world(), "NotLiftable"),
        ("Lift(Box_1)", world(hands=LEFT_MUG), "HandOccupied"),
        ("PlaceBoth(Table_1)", world(), "HandEmpty"),
        ("Release(left)", world(), "HandEmpty"),
        ("GoTo(Table_1)", world(hands={Arm.LEFT: "Fridge_1"}), "InUse"),  # a hand at a door keeps the robot there
        ("GoTo(Table_1)", world(hands=LEFT_MUG), ""),
        ("ResetArm(left)", world(hands={Arm.LEFT: "Fridge_1"}), "InUse"),
        ("Hold(left, Fridge_1)", world(), ""),  # a door is held like a load, but is none
        ("Hold(left, Bread_1)", world(), ""),
        ("Hold(left, Box_1)", world(), "NeedsTwoHands"),
        ("Hold(left, Table_1)", world(), "NotPickupable"),
        ("Hold(left, Bread_1)", world(inside={"Bread_1": "Fridge_1"}), "ReceptacleClosed"),
    ],
)
def test_the_first_requirement_that_fails_decides(text: str, facts: Facts, expected: str) -> None:
    assert code(text, facts) == expected
    assert not expected or FailureCode(expected) in Action.parse(text).spec.codes


def test_what_is_steadied_can_be_cut_where_it_rests() -> None:
    hands = {Arm.LEFT: "Knife_1", Arm.RIGHT: "Bread_1"}
    held = {"Bread_1": {"holders": ("right",)}}
    assert code("Slice(left, Bread_1)", world(hands, inside={"Bread_1": "Table_1"}, **held)) == ""
    assert code("Slice(left, Bread_1)", world(hands, **held)) == "NeedsSteadying"  # in the air


def test_shares_decide_what_is_open_filled_and_full() -> None:
    door = ObjectFacts("Fridge_1", can("openable", "encloses"))
    states = {share: replace(door, openness=share) for share in (0.0, 0.05, 0.2, 0.34, 0.5, 0.61, 1.0)}
    assert [share for share, one in states.items() if one.closed] == [0.0, 0.05]
    assert [share for share, one in states.items() if one.opened] == [0.61, 1.0]
    assert [share for share, one in states.items() if one.open] == [share for share, one in states.items() if not one.shut]
    assert [share for share, one in states.items() if one.shut] == [0.0, 0.05, 0.2]
    assert not replace(door, can=can()).open and not replace(door, can=can()).shut
    lid, lamp = replace(door, can=can("openable", "lidded")), replace(door, can=can("toggleable"))
    assert [replace(lid, openness=share).covered for share in (0.0, 0.34)] == [True, False]
    assert not lamp.covered  # what has no lid is under none
    levels = [replace(door, fill=share) for share in (0.0, 0.09, 0.1, 0.9, 0.999, 1.0)]
    assert [(one.filled, one.full) for one in levels] == [(False, False)] * 2 + [(True, False)] * 2 + [(True, True)] * 2


@pytest.mark.parametrize(
    ("text", "mass_kg", "expected", "over_kg"),
    [
        ("Pick(left, Box_1)", 3.5, "TooHeavy", 1.5),  # two arms carry 2 kg
        ("Pick(left, Box_1)", 1.25, "NeedsTwoHands", 0.25),  # one carries 1 kg
        ("Lift(Box_1)", 3.5, "TooHeavy", 1.5),
    ],
)
def test_margins_come_with_weight(text: str, mass_kg: float, expected: str, over_kg: float) -> None:
    refusal = first_refusal(Action.parse(text), world(mass_kg=mass_kg))
    assert refusal is not None and refusal.code == expected and dict(refusal.margins) == {"mass_kg": over_kg}


def test_what_two_arms_just_carry_is_not_too_heavy() -> None:
    assert code("Lift(Box_1)", world(mass_kg=2.0)) == ""
    assert code("Pick(left, Box_1)", world(mass_kg=2.0)) == "NeedsTwoHands"


def after(*lines: str, shutting: tuple[str, ...] = ()) -> SymbolicState:
    state = SymbolicState(self_closing=shutting)
    for events in events_of([HistoryItem("", line) for line in lines]):
        for event in events:
            if event.ok:
                state.succeed(event.action)
    return state


def test_effects_follow_a_log() -> None:
    state = after("Pick(left, Mug_1) ok; Open(right, Fridge_1) TooFar", "Place(left, Table_1) ok", "Lift(Box_1) ok")
    assert state.at == {"Mug_1": "Table_1"}
    assert state.lifted == "Box_1" and state.free_arms() == ()
    assert state.is_in(Condition.OPEN, "Fridge_1") is None
    state.succeed(Action.parse("PlaceBoth(Table_1)"))
    assert state.at["Box_1"] == "Table_1" and len(state.free_arms()) == 2


def test_a_door_that_falls_shut_stays_in_the_hand_and_may_be_shut_when_it_is_let_go() -> None:
    state = after("Open(left, Drawer_1) ok", shutting=("Drawer_1",))
    assert state.held[Arm.LEFT] == "Drawer_1" and state.is_in(Condition.OPEN, "Drawer_1")
    state.succeed(Action.parse("Release(left)"))
    assert state.held[Arm.LEFT] is None and state.is_in(Condition.OPEN, "Drawer_1") is None
    assert after("Open(left, Fridge_1) ok").held[Arm.LEFT] is None


def test_steadying_leaves_an_object_where_it_is() -> None:
    state = after("Pick(right, Bread_1) ok", "Place(right, Table_1) ok", "Hold(right, Bread_1) ok")
    assert state.at == {"Bread_1": "Table_1"} and state.in_place == {"Bread_1"}
    assert state.holders("Bread_1") == ("right",) and not state.holds("Bread_1")
    state.succeed(Action.parse("Pick(right, Bread_1)"))
    assert state.at == {} and state.in_place == set()
    assert state.holds("Bread_1") and not state.holds("Mug_1")
    assert after("Lift(Box_1) ok").holds("Box_1")


def test_body_and_liquids() -> None:
    state = after("GoTo(Table_1) ok", "MoveUp ok", "MoveUp(0.2) ok", "MoveDown() ok", "RotateLeft(30) ok")
    assert state.here == "Table_1" and state.rise_m == pytest.approx(0.1)
    state.succeed(Action.parse("MoveBack(0.3)"))
    assert state.here is None
    state = after("Pick(left, Mug_1) ok", "Fill(left, Sink_1) ok", "Pour(left, Vase_1) ok")
    assert state.is_in(Condition.FILLED, "Vase_1") and state.is_in(Condition.FILLED, "Mug_1") is None


def test_who_may_share_an_object() -> None:
    def both(first: str, second: str) -> bool:
        return exclude_each_other(Action.parse(first), Action.parse(second))

    assert not both("Place(left, Table_1)", "Place(right, Table_1)")
    assert not both("Hold(left, Bread_1)", "Slice(right, Bread_1)")
    assert both("Pick(left, Mug_1)", "Pick(right, Mug_1)")
    assert both("Open(left, Fridge_1)", "Place(right, Fridge_1)")
    assert not both("Release(left)", "Release(right)")
    for first in ACTIONS.values():
        for name in first.beside:
            assert first.name in ACTIONS[name].beside, (first.name, name)


def test_every_row_is_whole() -> None:
    assert [spec.name for spec in bringing_about(Condition.SLICED, True)] == ["Slice"]
    met = {code for spec in ACTIONS.values() for code in spec.codes}
    assert met == set(FAILURES)
    for spec in ACTIONS.values():
        assert spec.meaning
        assert spec.arms == {ActionKind.ARM: 1, ActionKind.TWO_ARM: 2}.get(spec.kind, 0)
        assert spec.kind is ActionKind.EPISODE or spec.requires
