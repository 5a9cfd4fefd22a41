"""LLM-Planner: examples, one call per plan, re-plans and their cap, names that are not known."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from interface.steps import PlanStep
from proprio_mllm.backends.protocol import BackendError, ChatReply, ChatRequest
from proprio_mllm.planners.chat.embedding import SentenceEmbedder
from proprio_mllm.planners.chat.llm_planner import LlmPlanner, example_text, with_known_names
from proprio_mllm.planners.chat.options import ChatOptions
from proprio_mllm.planners.memory import MemoryFileError, read_memory
from proprio_mllm.planners.protocol import Planner, PlannerReply
from tests.planners.chat.script import INFO, Script, acted, followed, observation, plan, thought
from tests.planners.demonstrations import DEMOS, PICK, SLICE, STOW


@pytest.fixture
def start(blind_memory_folder: Path):
    """Makes a planner in a new episode."""

    def make(script: Script, seed: int = 0, examples: int = 2, **options) -> LlmPlanner:
        memory = str(blind_memory_folder)
        planner = LlmPlanner(script, ChatOptions(image_size=28, memory=memory, examples=examples, **options))
        planner.reset(INFO, np.random.default_rng(seed))
        return planner

    return make


def steps(replies: list[PlannerReply]) -> list[str]:
    return ["" if reply.step is None else reply.step.to_text() for reply in replies]


def test_the_prompt_has_the_nearest_tasks_and_nothing_else_of_memory(start) -> None:
    script = Script([plan("GoTo(Mug_1)", "Done()")])
    planner = start(script)
    assert isinstance(planner, Planner)
    planner.step(observation(), None)
    prompt = script.prompt()
    nearest = [f"Task: {demo.instruction}" in prompt for demo in DEMOS]
    assert nearest == [True, True, False, False]  # the mug is picked up; the phone is put away
    assert prompt.index(PICK.instruction) < prompt.index(STOW.instruction) < prompt.index("Task: pick up the mug")
    assert "Example 1, done by the robot H1." in prompt
    assert "The picture is the view of your head camera now." in prompt
    (request,) = script.requests
    assert sum(not isinstance(part, str) for message in request.messages for part in message.content) == 1


def test_one_call_makes_the_whole_plan(start) -> None:
    script = Script([plan("GoTo(Mug_1)", "Pick(left, Mug_1)", "Done()")])
    replies = followed(start(script), ["", "", ""])
    assert steps(replies) == ["GoTo(Mug_1)", "Pick(left, Mug_1)", "Done()"]
    assert [reply.usage.calls for reply in replies] == [1, 0, 0]
    assert [reply.tokens for reply in replies] == [110, 0, 0]


def test_a_failure_asks_for_the_remaining_plan(start) -> None:
    script = Script([plan("GoTo(Mug_1)", "Pick(left, Mug_1)", "Done()"), plan("MoveDown(0.1)", "Done()")])
    planner = start(script, reflection=False)
    replies = followed(planner, ["", "BodyTooHigh", ""])
    assert steps(replies) == ["GoTo(Mug_1)", "Pick(left, Mug_1)", "MoveDown(0.1)"]
    assert [request.purpose for request in script.requests] == ["plan", "plan"]
    assert "Now your task.\nCompleted: GoTo(Mug_1)\n" in script.prompt()
    assert "2. Pick(left, Mug_1) BodyTooHigh" in script.prompt()
    assert "Write the whole plan that remains" in script.prompt()


def test_lists_are_those_of_the_moment(start) -> None:
    script = Script([plan("GoTo(Mug_1)"), plan("Done()")])
    planner = start(script, reflection=False)
    planner.step(observation(visible=("Mug_1",)), None)
    after, feedback = acted(observation(), "GoTo(Mug_1)", "BlockedPath")
    planner.step(observation(after.history, visible=("Table_1",)), feedback)
    assert "Objects in view: Mug_1\n" in script.prompt(0)
    assert "Objects in view: Table_1\n" in script.prompt(1)


def test_with_reflection_the_replan_is_the_reflecting_call(start) -> None:
    script = Script([plan("GoTo(Mug_1)", "Done()"), thought("MoveBack(0.2)", "GoTo(Mug_1)")])
    replies = followed(start(script), ["BlockedPath", "", ""])
    assert steps(replies) == ["GoTo(Mug_1)", "MoveBack(0.2)", "GoTo(Mug_1)"]
    assert [request.purpose for request in script.requests] == ["plan", "reflection"]
    assert [reply.usage.reflections for reply in replies] == [0, 1, 0]
    assert "Failed: GoTo(Mug_1): BlockedPath" in script.prompt()
    assert "whole remaining plan" in script.prompt()
    assert "Example 1" in script.prompt()


@pytest.mark.parametrize("reflection", [True, False])
def test_after_the_last_replan_the_plan_is_carried_out_as_it_is(start, reflection: bool) -> None:
    def answer(request: ChatRequest) -> str:
        return (thought if request.purpose == "reflection" else plan)("MoveAhead(0.1)", "MoveBack(0.1)", "MoveLeft(0.1)")

    script = Script(answer)
    replies = followed(start(script, replans=5, reflection=reflection), ["BlockedPath"] * 10)
    assert len(script.requests) == 6
    assert steps(replies) == ["MoveAhead(0.1)"] * 6 + ["MoveBack(0.1)", "MoveLeft(0.1)", "Done()", "Done()"]
    assert replies[-1].usage.calls == 0
    assert sum(reply.usage.reflections for reply in replies) == (5 if reflection else 0)


def test_a_plan_that_is_used_up_is_continued_as_long_as_replans_last(start) -> None:
    script = Script(lambda request: plan("MoveAhead(0.1)"))
    replies = followed(start(script, replans=2), [""] * 5)
    assert steps(replies) == ["MoveAhead(0.1)"] * 3 + ["Done()"] * 2
    assert len(script.requests) == 3
    assert "Completed: MoveAhead(0.1); MoveAhead(0.1)\n" in script.prompt()


@pytest.mark.parametrize(
    ("reply", "error"),
    [
        ("walk to the mug", "no JSON object"),
        ('{"plan": []}', "steps: Field required"),
        (plan(), "no steps"),
        (plan("Fly()", "Done()"), "unknown action 'Fly'"),
        (ChatReply('{"steps"', 9, 7, finish_reason="length"), "truncated after 7 tokens"),
    ],
)
def test_a_wrong_reply_is_no_step_is_paid_for_and_is_asked_again(start, reply: str | ChatReply, error: str) -> None:
    script = Script([reply, plan("Done()")])
    wrong, right = followed(start(script), ["", ""])
    assert wrong.step is None
    assert error in wrong.error
    assert wrong.usage.calls == 1
    assert wrong.tokens > 0
    assert steps([right]) == ["Done()"]


def test_wrong_replies_are_replans_too(start) -> None:
    script = Script(lambda request: "no")
    replies = followed(start(script, replans=2), [""] * 5)
    assert steps(replies) == ["", "", "", "Done()", "Done()"]
    assert [reply.usage.calls for reply in replies] == [1, 1, 1, 0, 0]


def test_a_wrong_step_shows_when_its_turn_comes(start) -> None:
    script = Script([plan("MoveAhead(0.1)", "Fly()", "MoveBack(0.1)"), plan("Done()")])
    replies = followed(start(script), ["", "", ""])
    assert steps(replies) == ["MoveAhead(0.1)", "", "Done()"]
    assert replies[1].text == "Fly()"
    assert [reply.usage.calls for reply in replies] == [1, 0, 1]
    script = Script([plan("MoveAhead(0.1)", "Fly()", "MoveBack(0.1)")])
    assert steps(followed(start(script, replans=0), [""] * 4)) == ["MoveAhead(0.1)", "", "MoveBack(0.1)", "Done()"]


def test_a_wrong_replan_leaves_the_old_plan(start) -> None:
    script = Script([plan("MoveAhead(0.1)", "MoveBack(0.1)"), "no"])
    replies = followed(start(script, replans=1), ["BlockedPath", "", ""])
    assert steps(replies) == ["MoveAhead(0.1)", "", "MoveBack(0.1)"]


def test_no_reply_is_an_error_of_the_episode(start) -> None:
    def broken(request: ChatRequest) -> str:
        raise BackendError("gpt4o: timed out")

    with pytest.raises(BackendError, match="timed out"):
        start(Script(broken)).step(observation(), None)


def test_unknown_names_become_the_nearest_known_ones(start) -> None:
    script = Script([plan("Pick(left, mug) & Open(right, Refrigerator_3)", "GoTo(Spaceship_1)")])
    planner = start(script)
    replies = followed(planner, ["", ""])
    assert steps(replies) == ["Pick(left, Mug_1) & Open(right, Fridge_1)", "GoTo(Spaceship_1)"]


def test_names_are_mapped_from_four_fifths_on_and_of_equals_the_first(embedder: SentenceEmbedder) -> None:
    def mapped(text: str, *known: str) -> str:
        return with_known_names(PlanStep.parse(text), known, embedder).to_text()

    assert mapped("GoTo(Mug_4)", "Mug_2", "Mug_1") == "GoTo(Mug_2)"
    assert mapped("GoTo(Mug_1)", "Mug_2", "Mug_1") == "GoTo(Mug_1)"
    assert mapped("GoTo(Table_1, 0.5, -20)", "CoffeeTable_1", "Mug_1") == "GoTo(Table_1, 0.5, -20)"
    assert mapped("GoTo(Couch_1)", "Sofa_1") == "GoTo(Sofa_1)"
    assert mapped("GoTo(Mug_1)") == "GoTo(Mug_1)"
    assert mapped("MoveAhead(1)", "Mug_1") == "MoveAhead(1)"


def test_examples_are_cut_where_the_episode_draws(start) -> None:
    def prompt(seed: int) -> str:
        script = Script(lambda request: plan("Done()"))
        start(script, seed, examples=4).step(observation(), None)
        return script.prompt()

    def cuts(text: str) -> list[int]:
        return [0 if done == "nothing" else done.count(";") + 1 for done in re.findall(r"Completed: (.*)\nObjects", text)]

    assert prompt(3) == prompt(3)
    drawn = {tuple(cuts(prompt(seed))) for seed in range(8)}
    assert len(drawn) > 3
    assert all(len(one) == 4 for one in drawn)


def test_an_example_shows_a_plan_from_a_point_on(blind_memory_folder: Path) -> None:
    stow = read_memory(blind_memory_folder).episodes[1]
    assert example_text(2, stow, 3).splitlines() == [
        "Example 2, done by the robot X1.",
        f"Task: {STOW.instruction}",
        "Completed: GoTo(CellPhone_1); Pick(right, CellPhone_1); GoTo(Drawer_1)",
        "Objects in view: Drawer_1",
        "Remaining plan: Open(left, Drawer_1); Place(right, Drawer_1); Done()",
    ]
    assert "Completed: nothing" in example_text(1, stow, 0)


def test_a_new_episode_forgets_the_last_one(start) -> None:
    script = Script(lambda request: plan("MoveAhead(0.1)", "MoveBack(0.1)"))
    planner = start(script, replans=0)
    followed(planner, ["", "", ""])
    planner.reset(INFO, np.random.default_rng(1))
    assert steps(followed(planner, ["", "", ""])) == ["MoveAhead(0.1)", "MoveBack(0.1)", "Done()"]
    assert len(script.requests) == 2


def test_examples_follow_the_instruction(blind_memory_folder: Path) -> None:
    script = Script(lambda request: plan("Done()"))
    planner = LlmPlanner(script, ChatOptions(image_size=28, memory=str(blind_memory_folder), examples=1))
    planner.reset(INFO.__class__("Slice the lettuce.", "x1", 9), np.random.default_rng(0))
    planner.step(observation(), None)
    assert f"Task: {SLICE.instruction}" in script.prompt()
    assert "Example 2" not in script.prompt()


def test_it_needs_a_memory(tmp_path: Path) -> None:
    with pytest.raises(MemoryFileError, match="LLM-Planner needs a memory, got None"):
        LlmPlanner(Script([]), ChatOptions())
    with pytest.raises(MemoryFileError, match="no memory at"):
        LlmPlanner(Script([]), ChatOptions(memory=str(tmp_path), examples=9))
