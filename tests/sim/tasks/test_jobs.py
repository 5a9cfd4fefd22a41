"""The order of jobs: what is due, in which hands, through which doors."""

import pytest

from data.records import Arm
from sim.tasks.jobs import Facts, Job, pending_leaves, plan_jobs
from sim.tasks.predicates import Predicate

LEFT, RIGHT = Arm.LEFT, Arm.RIGHT


def facts(held=None, lifted=None, fridge_open=False, places=None, lamp=False):
    places = {"Mug_1": "Counter_1", "Egg_1": "Counter_1", "Box_1": "Table_1"} | (places or {})
    hands = {LEFT: None, RIGHT: None} | (held or {})
    objects = {}
    for name in ("Counter_1", "Table_1", "Fridge_1", "Lamp_1", *places):
        in_hands = [arm.value for arm, item in hands.items() if item == name] + (["left", "right"] if lifted == name else [])
        objects[name] = {
            "objectId": name,
            "parentReceptacles": [places[name]] if name in places and not in_hands else [],
            "isPickedUp": bool(in_hands),
            "heldBy": in_hands,
            "openable": name == "Fridge_1",
            "isOpen": name == "Fridge_1" and fridge_open,
            "isToggled": name == "Lamp_1" and lamp,
        }
    return Facts(objects, hands, lifted, frozenset({"Box_1"}), places)


ON_TABLE = Predicate("on", "Mug_1", "Table_1")
IN_FRIDGE = Predicate("in", "Mug_1", "Fridge_1")
BOX = Predicate("on", "Box_1", "Counter_1")
LAMP = Predicate("toggled_on", "Lamp_1")


@pytest.mark.parametrize(
    ("goals", "state", "expected"),
    [
        ([Predicate("held", "Mug_1")], facts(), [Job("Pick", "Mug_1")]),
        ([Predicate("held", "Mug_1")], facts(held={LEFT: "Mug_1"}), []),
        ([ON_TABLE], facts(), [Job("Pick", "Mug_1")]),
        ([ON_TABLE], facts(held={LEFT: "Mug_1"}), [Job("Place", "Table_1", LEFT)]),
        ([ON_TABLE], facts(places={"Mug_1": "Fridge_1"}), [Job("Open", "Fridge_1")]),
        ([ON_TABLE], facts(places={"Mug_1": "Fridge_1"}, fridge_open=True), [Job("Pick", "Mug_1")]),
        ([IN_FRIDGE], facts(), [Job("Pick", "Mug_1")]),
        ([IN_FRIDGE], facts(held={RIGHT: "Mug_1"}), [Job("Open", "Fridge_1")]),
        ([IN_FRIDGE], facts(held={RIGHT: "Mug_1"}, fridge_open=True), [Job("Place", "Fridge_1", RIGHT)]),
        ([IN_FRIDGE, Predicate("closed", "Fridge_1")], facts(fridge_open=True), [Job("Pick", "Mug_1")]),
        (
            [IN_FRIDGE, Predicate("closed", "Fridge_1")],
            facts(places={"Mug_1": "Fridge_1"}, fridge_open=True),
            [Job("Close", "Fridge_1")],
        ),
        ([ON_TABLE, Predicate("on", "Egg_1", "Table_1")], facts(), [Job("Pick", "Mug_1"), Job("Pick", "Egg_1")]),
        (
            [ON_TABLE, Predicate("on", "Egg_1", "Table_1")],
            facts(held={RIGHT: "Mug_1", LEFT: "Egg_1"}),
            [Job("Place", "Table_1", RIGHT), Job("Place", "Table_1", LEFT)],
        ),
        ([BOX], facts(), [Job("Lift", "Box_1")]),
        ([BOX], facts(lifted="Box_1"), [Job("PlaceBoth", "Counter_1")]),
        ([BOX, LAMP], facts(), [Job("ToggleOn", "Lamp_1")]),
        ([Predicate("held", "Mug_1"), LAMP], facts(), [Job("ToggleOn", "Lamp_1"), Job("Pick", "Mug_1")]),
        ([Predicate("lifted", "Box_1")], facts(held={RIGHT: "Egg_1"}), [Job("Place", "Counter_1", RIGHT)]),
        ([LAMP, ON_TABLE], facts(lifted="Box_1"), [Job("PlaceBoth", "Table_1")]),
    ],
)
def test_next_jobs(goals, state, expected):
    assert plan_jobs(goals, state) == expected


def test_pending_leaves_of_compound_goals():
    objects = facts().objects
    held = [Predicate("held", "Mug_1"), Predicate("held", "Egg_1")]
    assert pending_leaves([Predicate("count", of=tuple(held), at_least=1)], objects) == held[:1]
    assert pending_leaves([Predicate("or", of=tuple(held))], objects) == held[:1]
    assert pending_leaves([Predicate("and", of=tuple(held))], objects) == held
    closed = Predicate("not", of=(Predicate("closed", "Fridge_1"),))
    assert pending_leaves([closed], objects) == [Predicate("open", "Fridge_1")]


def test_a_negation_without_a_state_is_refused():
    unwanted = Predicate("not", of=(Predicate("on", "Mug_1", "Counter_1"),))
    with pytest.raises(ValueError, match="'on'"):
        pending_leaves([unwanted], facts().objects)
