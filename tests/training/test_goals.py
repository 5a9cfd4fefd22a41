"""Verbs, relabelling and self-asked replies, all on text."""

from __future__ import annotations

import pytest

from interface.observation import HistoryItem
from proprio_mllm.training.goals import natural_name, parse_ids, relabel, verbs_of
from proprio_mllm.training.states import states_from_log
from sim.tasks.instructions import TEMPLATES, wordings

INVENTORY = ("Mug_1", "Plate_1", "CoffeeTable_1", "Fridge_1", "Lamp_1", "Lamp_2")


@pytest.mark.parametrize(
    ("instruction", "verbs"),
    [
        ("Pick up the mug.", ("pick",)),
        ("Grab the mug while switching the lamp on.", ("turn_on", "pick")),
        ("Put the mug and the plate on the table.", ("place",)),
        ("Open the fridge and put the mug in it.", ("place",)),
        ("Put the mug in the fridge, which is closed.", ("place",)),
        ("Store the mug in the fridge, then close the fridge.", ("place", "close")),
        ("The fridge should not stay open.", ("close",)),
        ("Switch the lamp off.", ("turn_off",)),
        ("Lift the box with both hands.", ("lift",)),
        ("The fridge: set hands to it and close it.", ("close",)),
        ("There is a box to set both hands to.", ("lift",)),
        ("Dance!", ()),
    ],
)
def test_verbs(instruction: str, verbs: tuple[str, ...]) -> None:
    assert verbs_of(instruction) == verbs


#: The verbs of every family of tasks, the same in all of its wordings.
FAMILIES = {
    "pick": "pick", "place": "place", "open": "open", "close": "close", "toggle_on": "turn_on", "toggle_off": "turn_off",
    "transport_two": "place", "transport_each": "place", "pick_and_toggle_on": "turn_on pick",
    "pick_and_toggle_off": "turn_off pick", "pick_and_open": "open pick", "place_any": "place", "transport_any_two": "place",
    "fill": "fill", "slice": "slice", "clean": "clean", "use_up": "use_up", "fetch_two": "place", "stow_two": "place",
    "stow_two_close": "place close", "set_three": "place", "tidy_three": "place", "carry_level": "place",
    "store_ajar": "place close", "fetch_ajar": "close pick", "slice_steady": "slice", "clean_steady": "clean",
    "pour_hold": "fill", "toggle_both": "turn_on", "fetch": "place", "fetch_hold": "pick", "stow": "place",
    "stow_close": "place close", "lift": "lift", "carry": "place", "hold_two": "pick", "carry_and_toggle": "place turn_on",
    "carry_and_place": "place",
}  # fmt: skip


@pytest.mark.parametrize("family", sorted(set(TEMPLATES) - {"cook"}))  # a log does not tell what is cooked
def test_every_wording_of_a_family_shows_its_verbs(family: str) -> None:
    slots = {"a": "the mug", "b": "the lamp", "c": "the cup", "r": "the coffee table", "s": "the fridge", "n": "two mugs"}
    for sentence in wordings(family, slots | {"pr": "on", "ps": "in", "on": "on"}):
        assert verbs_of(sentence) == tuple(FAMILIES[family].split()), sentence


def test_a_relabel_of_a_verb_of_tools() -> None:
    found = relabel("Use the knife to slice the apple.", INVENTORY, (), {"sliced": "Mug_1"}.__getitem__)
    assert found is not None and found.goal == "Slice the mug."


def test_reply_is_checked_against_the_inventory() -> None:
    reply = "Mug_1, Unicorn_1, Mug_1, rm -rf, Plate_1."
    assert parse_ids(reply, INVENTORY) == ("Mug_1", "Plate_1")
    assert parse_ids("none", INVENTORY) == ()


def test_relabel_keeps_the_verb_and_changes_the_object() -> None:
    asked: list[str] = []

    def ask(relation: str) -> str:
        asked.append(relation)
        return "Plate_1" if relation == "held" else "none"

    found = relabel("Pick up the mug.", INVENTORY, (), ask)
    assert found is not None
    assert asked == ["held"]
    assert found.goal == "Pick up the plate."
    assert found.parts == (("pick", "Plate_1", ""),)
    assert verbs_of(found.goal) == verbs_of("Pick up the mug.")


def test_relabel_asks_about_tried_receptacles_only() -> None:
    answers = {"on Fridge_1": "none", "on CoffeeTable_1": "Mug_1"}
    found = relabel("Put the plate on the table.", INVENTORY, ["Fridge_1", "CoffeeTable_1"], answers.__getitem__)
    assert found is not None
    assert found.goal == "Put the mug on the coffee table."
    assert found.asked == (("on Fridge_1", "none"), ("on CoffeeTable_1", "Mug_1"))


def test_relabel_per_sub_goal() -> None:
    answers = {"held": "Mug_1", "switched on": "none"}
    found = relabel("Pick up the plate and turn on the lamp.", INVENTORY, (), answers.__getitem__)
    assert found is not None
    assert found.goal == "Pick up the mug."
    answers["switched on"] = "Fridge_1"
    both = relabel("Pick up the plate and turn on the lamp.", INVENTORY, (), answers.__getitem__)
    assert both is not None
    assert both.goal == "Turn on the fridge and pick up the mug."


@pytest.mark.parametrize("reply", ["none", "Lamp_1", "Ghost_1"])
def test_no_relabel_without_a_unique_known_object(reply: str) -> None:
    assert relabel("Pick up the mug.", INVENTORY, (), lambda _: reply) is None


def test_the_original_goal_is_not_a_relabel() -> None:
    assert relabel("Pick up the plate.", INVENTORY, (), lambda _: "Mug_1", ("Pick up the mug.",)) is None


def test_natural_names() -> None:
    assert natural_name("CoffeeTable_12") == "the coffee table"
    assert natural_name("TVStand_1") == "the TV stand"


def test_states_from_a_log() -> None:
    log = [
        "Open(left, Fridge_1) ok",
        "Pick(left, Mug_1) ok; Pick(right, Plate_1) Blocked",
        "Place(left, CoffeeTable_1) ok",
        "Pick(right, Plate_1) ok",
        "ToggleOn(left, Lamp_1) ok",
        "ToggleOff(left, Lamp_1) ok",
        "not an action ok",
    ]
    states = states_from_log([HistoryItem("", line) for line in log])
    assert states["open"] == ("Fridge_1",)
    assert states["held"] == ("Plate_1",)
    assert states["on CoffeeTable_1"] == ("Mug_1",)
    assert states["switched on"] == ()
    assert states["switched off"] == ("Lamp_1",)
