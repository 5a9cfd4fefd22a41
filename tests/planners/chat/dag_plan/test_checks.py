"""What makes a graph valid, and that a message names what is wrong."""

from __future__ import annotations

import re

import pytest
from pydantic import ValidationError

from proprio_mllm.planners.chat.dag_plan.checks import GraphError, check_graph
from proprio_mllm.planners.chat.dag_plan.graph import NodeReply
from proprio_mllm.planners.chat.dag_plan.names import Vocabulary, bindings
from proprio_mllm.planners.furniture import FIXTURES
from sim.scene.catalogue import load_catalogue
from tests.planners.chat.dag_plan.graphs import carried, graph, node

TAKE = node("a", "Pick(Mug_1)", at="CounterTop_1")
PUT = node("b", "Place(DiningTable_1)", "a", item="Mug_1")
KNIFE = node("k", "Pick(Knife_1)")
CUT = node("s", "Slice(Apple_1)", "k", item="Knife_1")


def test_a_valid_graph_keeps_order_and_knows_ancestors() -> None:
    one = graph(TAKE, PUT, node("c", "ToggleOn(StoveKnob_1)"), node("d", "Done()", "b c"))
    assert [n.text() for n in one.nodes] == ["Pick(Mug_1)", "Place(DiningTable_1)", "ToggleOn(StoveKnob_1)", "Done()"]
    assert one.ancestors["d"] == {"a", "b", "c"}
    assert one.dependents("a") == {"b", "d"}
    assert one.nodes[0].item == "Mug_1"
    assert one.objects() == {"Mug_1", "CounterTop_1", "DiningTable_1", "StoveKnob_1"}


@pytest.mark.parametrize(
    ("nodes", "message"),
    [
        ([], "1 to 60 nodes, got 0"),
        ([node(str(i), "ToggleOn(StoveKnob_1)") for i in range(61)], "got 61"),
        ([TAKE, PUT, node("a", "Open(Fridge_1)")], "id 'a' is used 2 times"),
        ([TAKE, node("b", "Place(DiningTable_1)", "a z", item="Mug_1")], "b: waits for 'z', which is no node"),
        ([node("x", "Open(Fridge_1)", "y"), node("y", "Close(Fridge_1)", "x")], "circle: (x -> y -> x|y -> x -> y)$"),
        ([node("x", "Open(Fridge_1)", "x")], "circle: x -> x"),
        ([node("x", "Juggle(Mug_1)")], "x: unknown action 'Juggle'"),
        ([node("x", "grab the mug")], "x: not an action: 'grab the mug'"),
        ([node("x", "Pick(left, Mug_1)")], r"x: 'Pick\(left, Mug_1\)' names an arm"),
        ([node("x", "Place(Mug_1, CounterTop_1)", item="Mug_1")], r"x: Place: superfluous arguments \['CounterTop_1'\]"),
        ([node("x", "Pick()")], "x: Pick needs an object id"),
        ([node("x", "MoveDown(7)")], "x: MoveDown: amount 7.0 outside"),
        ([node("x", "Pick(Mug_1)", type="operate")], r"x: type 'operate' with Pick\(Mug_1\); allowed for Pick: occupy"),
        ([node("x", "Open(Fridge_1)", type="complete")], "allowed for Open: occupy or operate"),
        ([node("x", "Lift(Pot_1)", arms=1)], r"x: Lift\(Pot_1\) takes 2 arms, got 1"),
        ([node("x", "Pick(Mug_1)", arms=2)], r"x: Pick\(Mug_1\) takes 1 arms, got 2"),
        ([TAKE, node("b", "Place(DiningTable_1)", "a")], r"b: Place\(DiningTable_1\) needs the item"),
        ([node("x", "Open(Fridge_9)")], "x: there is no Fridge_9; known of its type: Fridge_1"),
        ([node("x", "Open(Toilet_1)")], "x: there is no Toilet_1; known of its type: none"),
        ([node("x", "Pick(Vase_1)")], "x: Vase_1 has not been seen, and the task names nothing of its type"),
        ([node("x", "Pick(Mug_1)", at="Shelf_1")], "x: there is no Shelf_1"),
        ([TAKE], "a: Mug_1 is taken and never put down"),
        ([TAKE, node("d", "Done()")], "a: Mug_1 is taken and never put down"),
        ([node("b", "Place(DiningTable_1)", item="Mug_1")], r"b: Place\(DiningTable_1\) without an occupy of Mug_1"),
        ([TAKE, node("b", "Place(DiningTable_1)", item="Mug_1")], "a and b both take or put down Mug_1"),
        ([TAKE, node("c", "Hold(Mug_1)", "a"), node("b", "Release()", "c", item="Mug_1")], r"c: Hold\(Mug_1\) while a hand"),
        ([TAKE, PUT, node("c", "Release()", "b", item="Mug_1")], r"c: Release\(\) without an occupy of Mug_1"),
        ([node("a", "Lift(Pot_1)"), node("b", "Place(CounterTop_1)", "a", item="Pot_1")], "b: .* with 1 arms of what Lift"),
        (
            [node("o", "Open(Drawer_1)", type="occupy"), node("p", "Place(CounterTop_1)", "o", item="Drawer_1")],
            r"p: .* of Drawer_1, which o only holds open",
        ),
        ([node("s", "Slice(Apple_1)", item="Knife_1")], r"s: Slice\(Apple_1\) is not after an occupy of Knife_1"),
        (
            [KNIFE, CUT, node("r", "Place(CounterTop_1)", "k", item="Knife_1")],
            "r: puts Knife_1 down without waiting for s",
        ),
        (
            [KNIFE, node("r", "Place(CounterTop_1)", "k", item="Knife_1"), node("s", "Slice(Apple_1)", "r", item="Knife_1")],
            r"s: Slice\(Apple_1\) is not after an occupy of Knife_1",
        ),
        ([TAKE, PUT, node("d", "Done()", "b"), node("e", "Done()", "b")], "2 nodes end the task: d, e"),
        ([node("d", "Done()"), node("e", "Open(Fridge_1)", "d")], "e after d, which ends the task"),
        (
            [TAKE, node("k", "Pick(Knife_1)"), node("c", "Pick(Cup_1)"), node("d", "Done()", "a k c")],
            "two hands cannot do these nodes in any order, starting with nothing in them",
        ),
        (
            [TAKE, KNIFE, node("o", "Open(Drawer_1)", "a k"), node("d", "Done()", "o")],
            "two hands cannot do these nodes",
        ),
    ],
)  # fmt: skip
def test_what_is_wrong_is_named(nodes: list[NodeReply], message: str) -> None:
    with pytest.raises(GraphError) as error:
        graph(*nodes)
    assert re.search(message, str(error.value)), error.value


def test_all_that_is_wrong_is_told_at_once() -> None:
    with pytest.raises(GraphError) as error:
        graph(node("a", "Jump()"), node("b", "Pick(Mug_1)", "z"), node("c", "Open(Fridge_9)"))
    assert len(error.value.problems) == 3


@pytest.mark.parametrize(
    "nodes",
    [
        [TAKE, node("d", "Done()", "a")],
        [*carried("Mug_1", "CounterTop_1", "Fridge_1"), node("e", "Pick(Mug_1)", "put_m"), node("d", "Done()", "e")],
        [KNIFE, CUT, node("t", "Slice(Cup_1)", "k", item="Knife_1"), node("r", "Place(Fridge_1)", "s t", item="Knife_1")],
        [node("l", "Lift(Pot_1)"), node("u", "MoveUp(0.1)", "l"), node("p", "PlaceBoth(CounterTop_1)", "u", item="Pot_1")],
        [TAKE, node("o", "Open(Drawer_1)", "a"), node("p", "Place(Drawer_1)", "a o", item="Mug_1")],
        [node("o", "Open(Drawer_1)", type="occupy"), node("r", "Release()", "o", item="Drawer_1")],
        [node("x", "GoTo(Mug_1, 0.5, -20)"), node("y", "ResetArm()", "x")],
    ],
)
def test_valid_graphs(nodes: list[NodeReply]) -> None:
    assert len(graph(*nodes).nodes) == len(nodes)


def test_what_the_hands_hold_already_needs_no_occupy_and_counts() -> None:
    assert graph(PUT.model_copy(update={"after": []}), hands=("Mug_1", None)).nodes[0].item == "Mug_1"
    with pytest.raises(GraphError, match=r"a: Pick\(Mug_1\) while a hand already holds Mug_1"):
        graph(TAKE, PUT, hands=("Mug_1", None))
    with pytest.raises(GraphError, match="starting with Cup_1, Egg_1 in them"):
        graph(TAKE, PUT, hands=("Cup_1", "Egg_1"))


def test_a_door_in_the_hand_keeps_the_robot_there() -> None:
    opened = node("o", "Open(Drawer_1)", type="occupy")
    inside = node("p", "Place(Drawer_1)", "o m", item="Mug_1")
    let_go = node("r", "Release()", "p", item="Drawer_1")
    with pytest.raises(GraphError, match="two hands cannot do"):
        graph(opened, node("c", "MoveDown(0.1)", "o"), node("r", "Release()", "o c", item="Drawer_1"))
    assert graph(node("m", "Pick(Mug_1)"), opened, inside, let_go)


def test_unseen_things_are_named_by_what_the_task_names() -> None:
    words = Vocabulary("Put two mugs in the sink, and cut the bread.", ("SinkBasin_1", "Plate_1"))
    assert words.refusal("Mug_7") is None
    assert words.refusal("Bread_1") is None
    assert words.refusal("Knife_1") is None, "a tool need not be named"
    assert words.refusal("Plate_1") is None
    assert words.refusal("SinkBasin_2") == "there is no SinkBasin_2; known of its type: SinkBasin_1"
    assert words.refusal("Plate_2") == "Plate_2 has not been seen, and the task names nothing of its type"


def test_names_are_bound_to_what_is_seen_later() -> None:
    one = check_graph(
        [node("a", "Pick(Mug_1)", at="SideTable_1"), node("b", "Pick(Mug_2)"), node("d", "Done()", "a b")],
        Vocabulary("Take two mugs.", ("SideTable_1", "Mug_9")),
    )
    assert bindings(one, ("SideTable_1", "Mug_9"), ("SideTable_1", "Mug_9", "Cup_1"), ()) == {}
    now = ("SideTable_1", "Mug_9", "Mug_4", "Mug_3")
    assert bindings(one, ("SideTable_1", "Mug_9"), now, ()) == {"Mug_2": "Mug_3"}, "Mug_1 is said to be at the side table"
    assert bindings(one, ("SideTable_1", "Mug_9"), now, {"SideTable_1"}) == {"Mug_1": "Mug_3", "Mug_2": "Mug_4"}
    assert bindings(one, ("SideTable_1",), (*now, "Mug_1"), {"SideTable_1"}) == {"Mug_2": "Mug_3"}
    assert one.renamed({"Mug_1": "Mug_3"}).nodes[0].text() == "Pick(Mug_3)"
    assert one.renamed({"Mug_1": "Mug_3"}).nodes[0].item == "Mug_3"


def test_fixtures_are_the_types_that_nobody_carries() -> None:
    assert {one.name.lower() for one in load_catalogue().types.values() if not one.movable} == FIXTURES


def test_the_schema_takes_numbers_as_ids_and_no_other_types() -> None:
    assert NodeReply.model_validate({"id": 1, "action": "Done()", "type": "complete", "arms": 1, "after": [2]}).after == ["2"]
    with pytest.raises(ValidationError, match="grasp"):
        NodeReply.model_validate({"id": "a", "action": "Pick(Mug_1)", "type": "grasp", "arms": 1, "after": []})
