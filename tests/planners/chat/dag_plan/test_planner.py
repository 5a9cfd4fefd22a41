"""DAG-Plan as a planner: when it asks, what it carries out, what becomes of failures."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

import numpy as np
import pytest

from configs.compose import compose
from configs.schema.eval import EvalConfig
from configs.schema.planner import PlainPlanner
from configs.validate import build
from interface.failures import FailureCategory
from interface.feedback import ActionOutcome, Feedback
from interface.observation import HistoryItem, Observation
from proprio_mllm.backends.protocol import BackendError, ChatReply, ChatRequest
from proprio_mllm.planners.chat.dag_plan.graph import GraphReply, NodeReply, RevisedGraph
from proprio_mllm.planners.chat.dag_plan.planner import DagPlanner
from proprio_mllm.planners.chat.options import ChatOptions
from proprio_mllm.planners.protocol import Planner, PlannerReply, TaskInfo
from proprio_mllm.planners.registry import make_chat_planner
from tests.planners.chat.dag_plan.graphs import FURNITURE, KNOWN, carried, node, reply
from tests.planners.chat.script import Script, observation

TASK = "Put the apple and the egg from the first counter on the side table."
BOTH = (*carried("Apple_1", "CounterTop_1", "SideTable_1"), *carried("Egg_1", "CounterTop_1", "SideTable_1"))
SWITCHES = (node("s", "ToggleOn(StoveKnob_1)"), node("f", "Open(Fridge_1)"), node("t", "Close(Fridge_1)", "f"))


class World:
    """Tells codes from a list per action, ok when there is none; things come into view at some place."""

    def __init__(
        self, codes: Mapping[str, str] | None = None, hidden: Mapping[str, str] | None = None, task: str = TASK
    ) -> None:
        self.codes = {text: listed.split() for text, listed in (codes or {}).items()}
        self.hidden = dict(hidden or {})
        self.task = task
        self.history: tuple[HistoryItem, ...] = ()
        self.feedback: Feedback | None = None
        self.replies: list[PlannerReply] = []

    def seen(self) -> Observation:
        known = tuple(name for name in KNOWN if name not in self.hidden)
        shown = observation(self.history, visible=())
        return dataclasses.replace(shown, instruction=self.task, known_objects=known, time_limit=40)

    def act(self, answer: PlannerReply) -> None:
        if answer.step is None:
            self.feedback = None
            self.history = (*self.history, HistoryItem("x", "x InvalidOutput"))
            return
        outcomes = []
        for action in answer.step.actions:
            listed = self.codes.get(action.to_text(), [])
            code = listed.pop(0) if listed else "ok"
            ok = code == "ok"
            outcomes.append(ActionOutcome(action, ok, "" if ok else code, None if ok else FailureCategory.LOGICAL))
            if action.name == "GoTo" and ok:
                self.hidden = {name: place for name, place in self.hidden.items() if place != action.object_id}
        self.feedback = Feedback(tuple(outcomes), 1.0)
        self.history = (*self.history, HistoryItem(answer.step.to_text(), self.feedback.to_text()))

    def play(self, planner: DagPlanner, steps: int = 40) -> list[str]:
        """Steps until the planner says that it is done."""
        for _ in range(steps):
            answer = planner.step(self.seen(), self.feedback)
            self.replies.append(answer)
            self.act(answer)
            if answer.step is not None and answer.step.to_text() == "Done()":
                break
        return ["invalid" if one.step is None else one.step.to_text() for one in self.replies]


def started(script: Script, **options) -> DagPlanner:
    planner = DagPlanner(script, ChatOptions(image_size=28, **options))
    planner.reset(TaskInfo(TASK, "h1", 40), np.random.default_rng(0))
    return planner


def revised(*nodes: NodeReply) -> str:
    return reply(*nodes, cause="too far", change="another arm")


def test_one_call_gives_the_graph_and_both_arms_work_it_off() -> None:
    script, world = Script([reply(*BOTH)]), World()
    planner = started(script)
    assert isinstance(planner, Planner)
    assert world.play(planner) == [
        "GoTo(Apple_1)",
        "Pick(right, Apple_1) & Pick(left, Egg_1)",
        "GoTo(SideTable_1)",
        "Place(right, SideTable_1) & Place(left, SideTable_1)",
        "Done()",
    ]
    first, *others = world.replies
    assert (first.usage.calls, first.tokens, first.latency_s, first.usage.usd) == (1, 110, 0.5, 0.002)
    assert first.text == reply(*BOTH)
    assert all((one.usage.calls, one.tokens) == (0, 0) for one in others)
    (request,) = script.requests
    assert (request.schema, request.purpose) == (GraphReply, "plan")
    prompt = script.prompt()
    assert "Every occupy is followed by a release" in prompt
    assert f"Task: {TASK}" in prompt
    assert "Your right hand holds nothing, your left hand nothing." in prompt
    assert sum(not isinstance(part, str) for message in request.messages for part in message.content) == 1


def test_one_node_at_a_time_where_both_arms_are_not_wanted() -> None:
    steps = World().play(started(Script([reply(*BOTH)]), parallel=False))
    assert len(steps) == 9
    assert not any("&" in step or "left" in step for step in steps)


def test_a_graph_that_breaks_a_rule_is_mended_once() -> None:
    wrong, script = reply(BOTH[0], BOTH[2]), Script([reply(BOTH[0], BOTH[2]), reply(*BOTH)])
    world = World()
    assert world.play(started(script))[0] == "GoTo(Apple_1)"
    assert [request.purpose for request in script.requests] == ["plan", "repair"]
    assert "- take_a: Apple_1 is taken and never put down" in script.prompt()
    assert wrong in script.prompt()
    assert script.requests[0].messages[1].text in script.prompt()
    assert (world.replies[0].usage.calls, world.replies[0].tokens, world.replies[0].usage.reflections) == (2, 220, 0)


def test_a_graph_that_is_wrong_twice_is_an_invalid_reply() -> None:
    wrong = reply(node("o", "Open(Fridge_9)"))
    script, world = Script([wrong, wrong, reply(*SWITCHES)]), World()
    steps = world.play(started(script))
    assert steps[:2] == ["invalid", "GoTo(StoveKnob_1)"]
    assert "o: there is no Fridge_9" in world.replies[0].error
    assert world.replies[0].text == wrong
    assert [request.purpose for request in script.requests] == ["plan", "repair", "plan"]
    assert [one.usage.calls for one in world.replies[:2]] == [2, 1]


@pytest.mark.parametrize(
    ("text", "error"),
    [
        ("first the apple", "no JSON object"),
        ('{"nodes": [{"id": "a"}]}', "nodes.0.action: Field required"),
        (
            '{"nodes": [{"id": "a", "action": "Done()", "type": "end", "arms": 1, "after": []}]}',
            "nodes.0.type: Input should be",
        ),
        (ChatReply('{"nodes": [', 50, 2048, finish_reason="length"), "truncated after 2048 tokens"),
        (ChatReply("I cannot help", 50, 3, finish_reason="refusal"), "refused"),
    ],
)
def test_what_is_no_graph_at_all_is_not_mended(text: str | ChatReply, error: str) -> None:
    script, world = Script([text, reply(*SWITCHES)]), World()
    assert world.play(started(script))[0] == "invalid"
    assert error in world.replies[0].error
    assert world.replies[0].usage.calls == 1
    assert world.replies[0].tokens > 0
    assert len(script.requests) == 2


def test_without_reflection_a_failed_node_takes_its_dependents_with_it_and_the_rest_goes_on() -> None:
    script = Script([reply(*SWITCHES)])
    world = World({"Open(right, Fridge_1)": "Locked", "ToggleOn(right, StoveKnob_1)": "ok"})
    assert world.play(started(script, reflection=False)) == [
        "GoTo(StoveKnob_1)",
        "ToggleOn(right, StoveKnob_1)",
        "GoTo(Fridge_1)",
        "Open(right, Fridge_1)",
        "Done()",
    ]
    assert len(script.requests) == 1


def test_a_failed_walk_fails_its_node() -> None:
    world = World({"GoTo(StoveKnob_1)": "BlockedPath"})
    steps = world.play(started(Script([reply(*SWITCHES)]), reflection=False))
    assert steps == ["GoTo(StoveKnob_1)", "GoTo(Fridge_1)", "Open(right, Fridge_1)", "Close(right, Fridge_1)", "Done()"]


def test_with_reflection_a_failure_leads_to_a_fresh_graph() -> None:
    script = Script([reply(*SWITCHES), revised(SWITCHES[1], SWITCHES[2])])
    world = World({"ToggleOn(right, StoveKnob_1)": "Obstructed"})
    steps = world.play(started(script))
    assert steps == [
        "GoTo(StoveKnob_1)",
        "ToggleOn(right, StoveKnob_1)",
        "GoTo(Fridge_1)",
        "Open(right, Fridge_1)",
        "Close(right, Fridge_1)",
        "Done()",
    ]
    assert [(one.usage.calls, one.usage.reflections) for one in world.replies[:4]] == [(1, 0), (0, 0), (1, 1), (0, 0)]
    assert (script.requests[1].purpose, script.requests[1].schema) == ("reflection", RevisedGraph)
    prompt = script.prompt()
    assert "Failed: ToggleOn(right, StoveKnob_1): Obstructed" in prompt
    assert "Completed: GoTo(StoveKnob_1)" in prompt
    assert "Graph so far: s ToggleOn(StoveKnob_1): given up; f Open(Fridge_1): open; t Close(Fridge_1): open" in prompt
    assert '"cause"' in prompt


def test_an_arm_that_could_not_reach_is_not_asked_again() -> None:
    script = Script([reply(SWITCHES[0]), revised(SWITCHES[0])])
    steps = World({"ToggleOn(right, StoveKnob_1)": "GraspMissed"}).play(started(script))
    assert steps[1:] == ["ToggleOn(right, StoveKnob_1)", "ToggleOn(left, StoveKnob_1)", "Done()"]


@pytest.mark.parametrize("replans", [0, 2])
def test_re_plans_are_capped_and_then_the_graph_goes_on(replans: int) -> None:
    script = Script(lambda request: (revised if request.purpose == "reflection" else reply)(*SWITCHES))
    world = World({"ToggleOn(right, StoveKnob_1)": "NothingHappened " * 9})
    steps = world.play(started(script, replans=replans))
    assert [request.purpose for request in script.requests] == ["plan", *["reflection"] * replans]
    assert sum(one.usage.reflections for one in world.replies) == replans
    assert steps[-4:] == ["GoTo(Fridge_1)", "Open(right, Fridge_1)", "Close(right, Fridge_1)", "Done()"]


def test_a_reflection_without_a_graph_is_invalid_and_the_old_graph_goes_on() -> None:
    wrong = revised(node("o", "Open(Fridge_9)"))
    script = Script([reply(*SWITCHES), wrong, wrong])
    world = World({"ToggleOn(right, StoveKnob_1)": "Obstructed"})
    steps = world.play(started(script))
    assert steps[2:] == ["invalid", "GoTo(Fridge_1)", "Open(right, Fridge_1)", "Close(right, Fridge_1)", "Done()"]
    assert [request.purpose for request in script.requests] == ["plan", "reflection", "reflection"]
    assert world.replies[2].usage.reflections == 2


def test_what_the_hands_hold_is_told_and_needs_no_occupy_in_the_new_graph() -> None:
    put = node("p", "Place(CounterTop_2)", item="Apple_1")
    script = Script([reply(*BOTH[:2]), revised(put)])
    world = World({"Place(right, SideTable_1)": "ReceptacleFull"})
    assert world.play(started(script))[-3:] == ["GoTo(CounterTop_2)", "Place(right, CounterTop_2)", "Done()"]
    assert "Your right hand holds Apple_1, your left hand nothing." in script.prompt()


def test_a_node_tried_beside_another_walks_to_its_own_object_before_it_fails() -> None:
    script = Script([reply(*BOTH)])
    world = World({"Pick(left, Egg_1)": "TooFar"})
    assert world.play(started(script))[1:4] == [
        "Pick(right, Apple_1) & Pick(left, Egg_1)",
        "GoTo(Egg_1)",
        "Pick(left, Egg_1)",
    ]
    assert len(script.requests) == 1
    world = World({"Pick(left, Egg_1)": "TooFar TooFar"})
    assert world.play(started(Script([reply(*BOTH)]), reflection=False))[3:] == [
        "Pick(left, Egg_1)",
        "GoTo(SideTable_1)",
        "Place(right, SideTable_1)",
        "Done()",
    ]


def test_actions_that_exclude_each_other_are_done_one_by_one() -> None:
    codes = {"Pick(right, Apple_1)": "ArmConflict", "Pick(left, Egg_1)": "ArmConflict"}
    steps = World(codes).play(started(Script([reply(*BOTH)]), reflection=False))
    assert steps[1:5] == [
        "Pick(right, Apple_1) & Pick(left, Egg_1)",
        "Pick(right, Apple_1)",
        "GoTo(Egg_1)",
        "Pick(left, Egg_1)",
    ]


HELD_OPEN = (
    node("o", "Open(Drawer_1)", type="occupy"),
    node("r", "Release()", "o", item="Drawer_1"),
    node("s", "Close(Drawer_1)", "r"),
)


@pytest.mark.parametrize(
    ("nodes", "codes", "after"),
    [
        (SWITCHES[1:], {"Open(right, Fridge_1)": "AlreadyInState"}, "Close(right, Fridge_1)"),
        (HELD_OPEN, {"Open(right, Drawer_1)": "AlreadyInState"}, "Close(right, Drawer_1)"),
        (HELD_OPEN, {"Release(right)": "HandEmpty"}, "Close(right, Drawer_1)"),
    ],
)
def test_an_effect_that_is_there_is_no_failure(nodes: tuple[NodeReply, ...], codes: dict[str, str], after: str) -> None:
    script = Script([reply(*nodes)])
    assert World(codes).play(started(script))[-2:] == [after, "Done()"]
    assert len(script.requests) == 1


def test_an_unseen_thing_is_looked_for_where_it_is_said_to_be_and_then_elsewhere() -> None:
    graph = reply(*carried("Egg_1", "CounterTop_2", "SideTable_1"))
    steps = World(hidden={"Egg_1": "CounterTop_2"}).play(started(Script([graph])))
    assert steps[:3] == ["GoTo(CounterTop_2)", "GoTo(Egg_1)", "Pick(right, Egg_1)"]
    steps = World(hidden={"Egg_1": "DiningTable_1"}).play(started(Script([graph])))
    assert steps[:6] == [
        "GoTo(CounterTop_2)",
        "RotateLeft(45)",
        "RotateRight(90)",
        "GoTo(CounterTop_1)",
        "GoTo(SideTable_1)",
        "GoTo(DiningTable_1)",
    ]
    assert steps[6] == "GoTo(Egg_1)"


def test_what_is_found_under_another_number_is_taken_for_it() -> None:
    nodes = [node("a", "Pick(Egg_5)", at="CounterTop_2"), node("b", "Place(Fridge_1)", "a", item="Egg_5")]
    steps = World(hidden={"Egg_1": "CounterTop_2"}).play(started(Script([reply(*nodes)])))
    assert steps == [
        "GoTo(CounterTop_2)",
        "GoTo(Egg_1)",
        "Pick(right, Egg_1)",
        "GoTo(Fridge_1)",
        "Place(right, Fridge_1)",
        "Done()",
    ]


def test_what_is_nowhere_fails_in_the_end() -> None:
    hidden, codes = {"Egg_1": "nowhere"}, {"Pick(right, Egg_1)": "ObjectNotKnown"}
    script = Script([reply(*carried("Egg_1", "CounterTop_2", "SideTable_1"))])
    steps = World(codes, hidden).play(started(script, reflection=False))
    assert steps[-2:] == ["Pick(right, Egg_1)", "Done()"]
    assert {step for step in steps if step.startswith("GoTo")} == {
        f"GoTo({name})" for name in FURNITURE if not name.startswith("StoveKnob")
    }
    assert "Open(right, Drawer_1)" in steps
    assert len(steps) < 20


def test_a_door_in_the_hand_is_known_and_let_go() -> None:
    nodes = [
        node("o", "Open(Drawer_1)", type="occupy"),
        node("e", "Pick(Egg_1)", "o", at="Drawer_1"),
        node("r", "Release()", "e", item="Drawer_1"),
        node("d", "Done()", "e r"),
    ]
    expected = ["GoTo(Drawer_1)", "Open(right, Drawer_1)", "Pick(left, Egg_1)", "Release(right)", "Done()"]
    assert World().play(started(Script([reply(*nodes)]))) == expected
    script = Script([reply(*nodes), revised(nodes[2].model_copy(update={"after": []}))])
    steps = World({"Pick(left, Egg_1)": "BodyTooHigh"}).play(started(script))
    assert steps == expected, "no walk away from the door, and the new graph lets go of it"
    assert "Your right hand holds Drawer_1" in script.prompt()


def test_the_body_moves_as_the_graph_says() -> None:
    nodes = [
        node("g", "GoTo(Mug_1, 0.5, -20)"),
        node("m", "MoveDown(0.2)", "g"),
        node("t", "Pick(Mug_1)", "m"),
        node("d", "Done()", "t"),
    ]
    steps = World().play(started(Script([reply(*nodes)])))
    assert steps == ["GoTo(Mug_1, 0.5, -20)", "MoveDown(0.2)", "Pick(right, Mug_1)", "Done()"]


def test_the_same_replies_give_the_same_steps_and_a_reset_forgets() -> None:
    def episode(planner: DagPlanner) -> list[str]:
        return World({"ToggleOn(right, StoveKnob_1)": "Obstructed"}).play(planner)

    script = Script(lambda request: (revised if request.purpose == "reflection" else reply)(*SWITCHES))
    planner = started(script)
    first = episode(planner)
    asked = list(script.requests)
    planner.reset(TaskInfo(TASK, "h1", 40), np.random.default_rng(7))
    assert episode(planner) == first
    assert script.requests[len(asked) :] == asked


def test_no_reply_is_an_error_of_the_episode() -> None:
    def broken(request: ChatRequest) -> str:
        raise BackendError("gpt4o: timed out")

    with pytest.raises(BackendError, match="timed out"):
        World().play(started(Script(broken)))


def test_it_is_configured_by_name_and_only_it_knows_one_arm_at_a_time() -> None:
    cfg = build(EvalConfig, compose("eval", ["planner=dag_plan", "planner.parallel=false", "workers=0"]))
    assert cfg.backend is not None
    planner = make_chat_planner(cfg.planner, cfg.backend, Script([]))
    assert isinstance(planner, DagPlanner)
    assert ChatOptions.of(cfg.planner, cfg.backend).parallel is False
    assert not hasattr(PlainPlanner("p", "plain", "P"), "parallel")
