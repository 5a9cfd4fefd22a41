"""Goal predicates: every kind in both truth values, nesting, and what is refused."""

import pytest

from interface.facts import Affordances, ObjectFacts
from sim.tasks.predicates import ANY, Predicate, PredicateError
from sim.tasks.task import load_benchmark

FURNITURE = Affordances(movable=False)
OBJECTS = {
    item.object_id: item
    for item in (
        ObjectFacts("Mug_1", Affordances(), carriers=("Table_1",), fill=0.09),
        ObjectFacts("Apple_1", Affordances(), holders=("left",)),
        ObjectFacts("Box_1", Affordances(), holders=("left", "right")),
        ObjectFacts("Pot_1", Affordances(), holders=("left", "right"), carriers=("Table_1",)),
        ObjectFacts("Fridge_1", FURNITURE, openness=0.4),
        ObjectFacts("Cabinet_1", FURNITURE, openness=0.3, holders=("left",)),
        ObjectFacts("Lamp_1", FURNITURE, on=True),
        ObjectFacts("Table_1", Affordances(movable=False, openable=False)),
        ObjectFacts("Mug_2", Affordances(), carriers=("Table_1",), fill=0.1, dirty=True),
        ObjectFacts("Potato_1", Affordances(), carriers=("Fridge_1",), sliced=True, cooked=True, wet=True),
        ObjectFacts("Soap_1", Affordances(), used_up=True),
    )
}
ON_TABLE = Predicate("on", ANY, "Table_1")


@pytest.mark.parametrize(
    ("predicate", "expected"),
    [
        (Predicate("on", "Mug_1", "Table_1"), True),
        (Predicate("in", "Mug_1", "Fridge_1"), False),
        (Predicate("held", "Apple_1"), True),
        (Predicate("held", "Mug_1"), False),
        (Predicate("lifted", "Box_1"), True),
        (Predicate("lifted", "Apple_1"), False),
        (Predicate("lifted", "Pot_1"), False),
        (Predicate("open", "Fridge_1"), True),
        (Predicate("closed", "Fridge_1"), False),
        (Predicate("closed", "Table_1"), True),
        (Predicate("open", "Cabinet_1"), False),
        (Predicate("held", "Cabinet_1"), False),
        (Predicate("clean", "Potato_1"), True),
        (Predicate("toggled_on", "Lamp_1"), True),
        (Predicate("toggled_off", "Lamp_1"), False),
        (Predicate("filled", "Mug_2"), True),
        (Predicate("filled", "Mug_1"), False),
        (Predicate("clean", "Mug_2"), False),
        (Predicate("clean", "Mug_1"), True),
        (Predicate("sliced", "Potato_1"), True),
        (Predicate("sliced", "Apple_1"), False),
        (Predicate("cooked", "Potato_1"), True),
        (Predicate("cooked", "Apple_1"), False),
        (Predicate("used_up", "Soap_1"), True),
        (Predicate("used_up", "Mug_1"), False),
        (Predicate("exists", object_type="Mug", of=(ON_TABLE,), at_least=2), True),
        (Predicate("exists", object_type="Mug", of=(ON_TABLE,), at_least=3), False),
        (Predicate("exists", object_type="Fork", of=(ON_TABLE,), at_least=1), False),
        (
            Predicate("exists", object_type="Mug", of=(Predicate("and", of=(ON_TABLE, Predicate("clean", ANY))),), at_least=1),
            True,
        ),
        (Predicate("not", of=(Predicate("held", "Mug_1"),)), True),
        (Predicate("and", of=(Predicate("held", "Apple_1"), Predicate("open", "Fridge_1"))), True),
        (Predicate("or", of=(Predicate("held", "Mug_1"), Predicate("closed", "Fridge_1"))), False),
        (Predicate("count", of=(Predicate("held", "Mug_1"), Predicate("held", "Apple_1")), at_least=1), True),
        (Predicate("count", of=(Predicate("held", "Mug_1"), Predicate("held", "Apple_1")), at_least=2), False),
    ],
)
def test_truth(predicate, expected):
    assert predicate.holds(OBJECTS) is expected


def test_a_held_object_is_on_nothing():
    held = ObjectFacts("Mug_1", Affordances(), carriers=("Table_1",), holders=("left",))
    assert not Predicate("on", "Mug_1", "Table_1").holds(OBJECTS | {"Mug_1": held})


def test_json_has_only_the_arguments_of_the_kind():
    predicate = Predicate("not", of=(Predicate("held", "Mug_1"),))
    assert predicate.to_json() == {"kind": "not", "of": [{"kind": "held", "object_id": "Mug_1"}]}
    assert predicate.object_ids() == ("Mug_1",)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"kind": "near", "object_id": "Mug_1"}, "near"),
        ({"kind": "on", "object_id": "Mug_1"}, "receptacle_id"),
        ({"kind": "held", "object_id": "Mug_1", "receptacle_id": "Table_1"}, "Table_1"),
        ({"kind": "not", "of": (Predicate("held", "A_1"), Predicate("held", "B_1"))}, "got 2"),
        ({"kind": "count", "of": (Predicate("held", "A_1"),), "at_least": 2}, "at_least 2"),
        ({"kind": "exists", "object_type": "A", "of": (Predicate("held", "A_1"),), "at_least": 1}, "'A_1'"),
        ({"kind": "exists", "object_type": "A", "of": (Predicate("held", "$"),)}, "at_least"),
        ({"kind": "held", "object_id": "A_1", "object_type": "A"}, "object_type"),
    ],
)
def test_malformed_predicates_are_refused(arguments, message):
    with pytest.raises(PredicateError, match=message):
        Predicate(**arguments)


@pytest.mark.parametrize("predicate", [Predicate("held", "Ghost_1"), Predicate("on", "Mug_1", "Ghost_1")])
def test_unknown_objects_are_named(predicate):
    with pytest.raises(PredicateError, match="Ghost_1"):
        predicate.holds(OBJECTS)


def test_an_exists_names_its_receptacle_and_involves_every_object_of_its_type():
    goal = Predicate("exists", object_type="Mug", of=(ON_TABLE,), at_least=1)
    assert goal.object_ids() == ("Table_1",)
    assert set(goal.involved(["Mug_10", "Mug_2", "Table_1", "Mugger_1"])) == {"Table_1", "Mug_2", "Mug_10"}
    assert [operand.object_id for operand in goal.candidates(["Mug_10", "Mug_2"])] == ["Mug_2", "Mug_10"]
    assert goal.to_json() == {"kind": "exists", "object_type": "Mug", "of": [ON_TABLE.to_json()], "at_least": 1}


def test_goals_in_text() -> None:
    both = Predicate("and", of=(Predicate("open", "Fridge_1"), ON_TABLE))
    assert both.to_text() == f"and(open(Fridge_1), {ON_TABLE.to_text()})"
    count = Predicate("count", of=(both, Predicate("not", of=(Predicate("held", "Cup_1"),))), at_least=1)
    assert count.to_text() == f"count({both.to_text()}, not(held(Cup_1)), at_least=1)"
    assert all(name in goal.to_text() for task in load_benchmark() for goal in task.goals for name in goal.object_ids())
