"""Which arm does what next: closed forms, and what holds of every schedule."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from interface.bodies import Arm
from proprio_mllm.planners.chat.dag_plan.graph import Graph, NodeReply
from proprio_mllm.planners.chat.dag_plan.hands import after, arms_for, held_by
from proprio_mllm.planners.chat.dag_plan.scheduler import Scheduler, Situation
from tests.planners.chat.dag_plan.graphs import FURNITURE, KNOWN, THINGS, carried, graph, node, rollout, texts, uses

SEEN = frozenset(KNOWN)


def chosen(one: Graph, parallel: bool = True, **situation) -> str:
    jobs = Scheduler(one, parallel=parallel).choose(Situation(known=SEEN, **situation))
    return " & ".join(job.node.action(job.arm).to_text() for job in jobs)


def test_two_picks_on_one_counter_go_together_and_so_do_the_placings() -> None:
    one = graph(*carried("Apple_1", "CounterTop_1", "DiningTable_1"), *carried("Egg_1", "CounterTop_1", "DiningTable_1"))
    assert texts(rollout(one)) == [
        "GoTo(Apple_1)",
        "Pick(right, Apple_1) & Pick(left, Egg_1)",
        "GoTo(DiningTable_1)",
        "Place(right, DiningTable_1) & Place(left, DiningTable_1)",
    ]
    assert texts(rollout(one, parallel=False)) == [
        "GoTo(Apple_1)",
        "Pick(right, Apple_1)",
        "GoTo(DiningTable_1)",
        "Place(right, DiningTable_1)",
        "GoTo(Egg_1)",
        "Pick(right, Egg_1)",
        "GoTo(DiningTable_1)",
        "Place(right, DiningTable_1)",
    ]


def test_both_hands_are_filled_before_a_walk_to_put_down() -> None:
    one = graph(*carried("Apple_1", "CounterTop_1", "DiningTable_1"), *carried("Egg_1", "CounterTop_2", "DiningTable_1"))
    assert texts(rollout(one)) == [
        "GoTo(Apple_1)",
        "Pick(right, Apple_1)",
        "GoTo(Egg_1)",
        "Pick(left, Egg_1)",
        "GoTo(DiningTable_1)",
        "Place(right, DiningTable_1) & Place(left, DiningTable_1)",
    ]


def test_the_arm_that_took_it_uses_it_and_puts_it_down() -> None:
    one = graph(
        node("k", "Pick(Knife_1)"),
        node("h", "Hold(Apple_1)", "k"),
        node("s", "Slice(Apple_1)", "h", item="Knife_1"),
        node("r", "Release()", "s", item="Apple_1"),
        node("p", "Place(CounterTop_1)", "r s", item="Knife_1"),
    )
    assert texts(rollout(one)) == [
        "GoTo(Knife_1)",
        "Pick(right, Knife_1)",
        "GoTo(Apple_1)",
        "Hold(left, Apple_1)",
        "Slice(right, Apple_1)",
        "Release(left)",
        "GoTo(CounterTop_1)",
        "Place(right, CounterTop_1)",
    ]
    assert chosen(one, settled=frozenset("k"), hands=(None, "Knife_1")) == "Hold(right, Apple_1)"


def test_what_takes_two_arms_waits_for_both() -> None:
    one = graph(
        node("l", "Lift(Pot_1)"),
        node("b", "PlaceBoth(CounterTop_1)", "l", item="Pot_1"),
        node("p", "Place(SideTable_1)", item="Mug_1"),
        hands=("Mug_1", None),
    )
    assert texts(rollout(one, hands=("Mug_1", None))) == [
        "GoTo(SideTable_1)",
        "Place(right, SideTable_1)",
        "GoTo(Pot_1)",
        "Lift(Pot_1)",
        "GoTo(CounterTop_1)",
        "PlaceBoth(CounterTop_1)",
    ]


def test_ties_go_to_the_lower_index_then_to_the_right_arm() -> None:
    first, second = node("z", "ToggleOn(StoveKnob_1)"), node("a", "ToggleOn(Fridge_1)")
    assert chosen(graph(first, second)) == "ToggleOn(right, StoveKnob_1)"
    assert chosen(graph(second, first)) == "ToggleOn(right, Fridge_1)"


def test_the_nearer_node_goes_first() -> None:
    one = graph(node("a", "ToggleOn(StoveKnob_1)"), node("b", "ToggleOn(Fridge_1)"))
    assert chosen(one, here="Fridge_1") == "ToggleOn(right, Fridge_1)"
    lone = graph(node("a", "Pick(Mug_1)"), node("b", "Open(Fridge_1)"), node("d", "Done()", "a b"))
    jobs = Scheduler(lone).choose(Situation(known=SEEN - {"Mug_1"}))
    assert jobs[0].node.id == "b", "what has to be searched for comes later"
    short = graph(node("a", "ToggleOn(Fridge_1)"), node("b", "ToggleOn(StoveKnob_2)"))
    at = {"StoveKnob_1": "CounterTop_1", "StoveKnob_2": "CounterTop_1"}
    assert chosen(short, here="StoveKnob_1", at=at).startswith("ToggleOn(right, StoveKnob_2)")


def test_failures_of_reach_choose_the_other_arm() -> None:
    one = graph(node("a", "Open(Fridge_1)"))
    assert chosen(one, penalties={(Arm.RIGHT, "Fridge_1"): 1}) == "Open(left, Fridge_1)"
    assert chosen(one, penalties={(Arm.RIGHT, "Fridge_1"): 1, (Arm.LEFT, "Fridge_1"): 2}) == "Open(right, Fridge_1)"
    two = graph(node("a", "Open(Fridge_1)"), node("b", "ToggleOn(StoveKnob_1)"))
    blamed = chosen(two, here="StoveKnob_1", visible=frozenset({"Fridge_1"}), penalties={(Arm.RIGHT, "Fridge_1"): 1})
    assert blamed == "ToggleOn(right, StoveKnob_1) & Open(left, Fridge_1)"


def test_a_second_node_needs_the_same_place_or_the_view() -> None:
    one = graph(node("a", "ToggleOn(StoveKnob_1)"), node("b", "ToggleOn(StoveKnob_2)"))
    alone, both = "ToggleOn(right, StoveKnob_1)", "ToggleOn(right, StoveKnob_1) & ToggleOn(left, StoveKnob_2)"
    assert chosen(one, here="StoveKnob_1") == alone
    assert chosen(one, here="StoveKnob_1", visible=frozenset({"StoveKnob_2"})) == both
    assert chosen(one, visible=frozenset({"StoveKnob_2"})) == alone, "the view will change on the way"
    at = {"StoveKnob_1": "CounterTop_1", "StoveKnob_2": "CounterTop_1"}
    assert chosen(one, at=at) == both
    assert chosen(one, at=at, walked_only=frozenset("b")) == "ToggleOn(right, StoveKnob_2) & ToggleOn(left, StoveKnob_1)"
    assert chosen(one, at=at, walked_only=frozenset("ab")) == alone
    assert chosen(one, at=at, alone=frozenset("a")) == alone
    assert chosen(one, at=at, parallel=False) == alone


def test_only_two_placings_may_share_an_object() -> None:
    one = graph(node("a", "Open(Drawer_1)"), node("b", "Close(Drawer_1)"))
    assert chosen(one, here="Drawer_1", visible=frozenset({"Drawer_1"})) == "Open(right, Drawer_1)"


def test_a_hand_is_kept_free_for_what_is_still_to_be_opened() -> None:
    one = graph(
        node("m", "Pick(Mug_1)", at="CounterTop_1"),
        node("c", "Pick(Cup_1)", at="CounterTop_1"),
        node("o", "Open(Drawer_1)"),
        node("pm", "Place(Drawer_1)", "m o", item="Mug_1"),
        node("pc", "Place(Drawer_1)", "c o", item="Cup_1"),
    )
    assert texts(rollout(one)) == [
        "GoTo(Drawer_1)",
        "Open(right, Drawer_1)",
        "GoTo(Mug_1)",
        "Pick(right, Mug_1) & Pick(left, Cup_1)",
        "GoTo(Drawer_1)",
        "Place(right, Drawer_1) & Place(left, Drawer_1)",
    ]
    at = {"Mug_1": "CounterTop_1", "Cup_1": "CounterTop_1"}
    assert chosen(one, here="Mug_1", at=at) == "Pick(right, Mug_1)", "both hands full would leave the drawer shut"


def test_what_cannot_be_finished_any_more_does_not_stop_the_rest() -> None:
    one = graph(
        node("m", "Pick(Mug_1)"),
        node("p", "Place(Fridge_1)", "m", item="Mug_1"),
        node("l", "Lift(Pot_1)"),
        node("b", "PlaceBoth(CounterTop_1)", "l", item="Pot_1"),
        node("t", "ToggleOn(StoveKnob_1)"),
    )
    given_up = frozenset({"m", "p"})
    assert chosen(one, settled=given_up, hands=("Mug_1", None)) == "ToggleOn(left, StoveKnob_1)"
    assert chosen(one, settled=given_up | {"t"}, hands=("Mug_1", None)) == ""


def test_a_door_in_the_hand_is_served_before_anything_else() -> None:
    one = graph(
        node("t", "ToggleOn(StoveKnob_1)"),
        node("o", "Open(Drawer_1)", type="occupy"),
        node("e", "Pick(Egg_1)", "o", at="Drawer_1"),
        node("r", "Release()", "e", item="Drawer_1"),
        node("d", "Done()", "e"),
    )
    steps = texts(rollout(one))
    opened = steps.index(next(step for step in steps if "Open" in step))
    assert [step.partition("(")[0] for step in steps[opened:][:3]] == ["Open", "Pick", "Release"]
    assert len(steps) == 6


TASKS: dict[str, list[NodeReply]] = {
    "two things to one place": [
        *carried("Apple_1", "CounterTop_1", "SideTable_1"),
        *carried("Egg_1", "CounterTop_1", "SideTable_1"),
    ],
    "each to its own": [
        *carried("Apple_1", "CounterTop_1", "SideTable_1"),
        *carried("Egg_1", "CounterTop_1", "DiningTable_1"),
    ],
    "three": [
        *carried("Apple_1", "CounterTop_1", "SideTable_1"),
        *carried("Egg_1", "CounterTop_1", "SideTable_1"),
        *carried("Mug_1", "CounterTop_2", "SideTable_1"),
    ],
    "from a drawer": [
        node("o", "Open(Drawer_1)"),
        node("e", "Pick(Egg_1)", "o", at="Drawer_1"),
        node("m", "Pick(Mug_1)", "o", at="Drawer_1"),
        node("pe", "Place(CounterTop_1)", "e", item="Egg_1"),
        node("pm", "Place(CounterTop_1)", "m", item="Mug_1"),
    ],
    "pick and switch": [
        node("t", "ToggleOn(StoveKnob_1)", at="CounterTop_1"),
        node("p", "Pick(Mug_1)", at="CounterTop_1"),
        node("d", "Done()", "t p"),
    ],
    "two switches": [
        node("t", "ToggleOn(StoveKnob_1)", at="CounterTop_1"),
        node("u", "ToggleOn(StoveKnob_2)", at="CounterTop_1"),
    ],
}  # fmt: skip


@pytest.mark.parametrize("name", sorted(TASKS))
def test_both_arms_are_faster_than_one_after_the_other(name: str) -> None:
    one = graph(*TASKS[name])
    assert len(rollout(one)) < len(rollout(one, parallel=False))


@st.composite
def plans(draw: st.DrawFn) -> list[NodeReply]:
    """Nodes of a plan that one person with two hands could carry out from first to last, with fewer edges than that order."""
    nodes: list[NodeReply] = []
    held: dict[str, str] = {}  # item to the node that took it
    uses_of: dict[str, list[str]] = {}
    anchor: str | None = None
    objs = list(THINGS)
    for number in range(draw(st.integers(1, 9))):
        name = f"n{number}"
        two = any(item == "Pot_1" for item in held)
        free = 0 if two else 2 - len(held)
        moves = ["body"] if anchor is None else []
        moves += ["operate"] * bool(free) + ["take"] * bool(free and objs) + ["use", "put"] * bool(held)
        move = draw(st.sampled_from(moves or ["put"]))
        place = draw(st.sampled_from(FURNITURE))
        waits = [one.id for one in nodes if draw(st.integers(0, 3)) == 0]
        item = draw(st.sampled_from(sorted(held))) if held else None
        if move in ("use", "put") and (item == "Pot_1" or item == anchor or item == "Drawer_1"):
            move = "put"
        waits += [held[anchor]] if anchor is not None else []
        if move == "body":
            nodes.append(node(name, "MoveDown(0.1)", " ".join(waits)))
        elif move == "operate":
            nodes.append(node(name, f"ToggleOn({place})", " ".join(waits)))
        elif move == "use":
            assert item is not None
            nodes.append(node(name, "Slice(Apple_1)", " ".join([*waits, held[item]]), item=item))
            uses_of[item].append(name)
        elif move == "put":
            assert item is not None
            verb = "PlaceBoth" if item == "Pot_1" else "Release" if item == "Drawer_1" or item == anchor else "Place"
            text = "Release()" if verb == "Release" else f"{verb}({place})"
            nodes.append(node(name, text, " ".join([*waits, held.pop(item), *uses_of.pop(item)]), item=item))
            anchor = None if item == anchor else anchor
        else:
            obj = draw(st.sampled_from(objs))
            if obj == "Pot_1" and free < 2:
                obj = next(one for one in objs if one != "Pot_1") if len(objs) > 1 else ""
            if not obj:
                continue
            objs.remove(obj)
            door = anchor is None and obj == "Book_1"
            if door:
                nodes.append(node(name, "Open(Drawer_1)", " ".join(waits), type="occupy"))
                obj = anchor = "Drawer_1"
            else:
                verb = "Lift" if obj == "Pot_1" else "Pick"
                nodes.append(node(name, f"{verb}({obj})", " ".join(waits), at=place))
            held[obj], uses_of[obj] = name, []
    if held:
        nodes.append(node("end", "Done()", " ".join(held.values())))
    return nodes


@settings(max_examples=150, deadline=None)
@given(plans(), st.booleans())
def test_every_schedule_does_all_nodes_in_order_with_the_right_hands(nodes: list[NodeReply], parallel: bool) -> None:
    one = graph(*nodes)
    hands, done = (None, None), set()
    owner: dict[str, Arm | None] = {}
    for step in rollout(one, parallel=parallel):
        if isinstance(step, str):
            continue
        assert len(step) <= (2 if parallel else 1)
        busy = [arm for job in step for arm in uses(job)]
        assert len(busy) == len(set(busy)), "an arm does one thing at a time"
        for job in step:
            assert job.node.id not in done
            assert done.issuperset(job.node.after), "predecessors come in earlier steps"
            assert job.arm in arms_for(job.node, hands)
            if job.node.kind in ("tool-use", "release"):
                assert owner[job.node.item or ""] == job.arm, "the arm that took it"
            if job.node.kind == "occupy":
                owner[job.node.item or ""] = job.arm
        for job in step:
            hands = after(job.node, job.arm, hands)
        done |= {job.node.id for job in step}
    assert done == {n.id for n in one.nodes if n.kind != "complete"}
    held = {item for item in hands if item is not None}
    assert all(held_by(hands, item) for item in held)
    assert texts(rollout(one, parallel=parallel)) == texts(rollout(one, parallel=parallel))
