"""RAP: at most two calls per step, what each of them sees of memory, and what a wrong reply is."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from configs.schema.backend import BackendConfig
from configs.schema.planner import MemoryPlanner
from proprio_mllm.backends.protocol import BackendError, ChatReply, ChatRequest
from proprio_mllm.backends.structured import strict_schema
from proprio_mllm.planners.chat.options import ChatOptions
from proprio_mllm.planners.chat.rap import Outline, RapPlanner, Thought
from proprio_mllm.planners.chat.replies import Reflection
from proprio_mllm.planners.memory import MemoryFileError
from proprio_mllm.planners.protocol import Planner, TaskInfo
from proprio_mllm.planners.registry import make_chat_planner
from tests.planners.chat.script import INFO, Script, followed, observation, thought
from tests.planners.demonstrations import DEMOS, LAMP, PICK, SLICE, STOW


def outline(*plan: str, kind: str = "object", text: str = "mug") -> str:
    return json.dumps({"plan": list(plan), "key": {"kind": kind, "text": text}})


def idea(*steps: str, kind: str = "action", text: str = "pick up the mug") -> str:
    return json.dumps({"thought": "the mug is near", "key": {"kind": kind, "text": text}, "steps": list(steps)})


def answers(request: ChatRequest) -> str:
    """A valid reply of the kind that is asked for."""
    replies = {
        Outline: outline("find the mug", "take it"),
        Thought: idea("MoveAhead(0.1)"),
        Reflection: thought("MoveBack(0.1)"),
    }
    assert request.schema is not None
    return replies[request.schema]


@pytest.fixture(params=["seeing", "blind"])
def start(request: pytest.FixtureRequest, memory_folder: Path, blind_memory_folder: Path):
    """Makes a planner in a new episode, with a memory that has pictures or has none."""

    def make(script: Script, seed: int = 0, info: TaskInfo = INFO, examples: int = 3, **options) -> RapPlanner:
        memory = str(memory_folder if request.param == "seeing" else blind_memory_folder)
        planner = RapPlanner(script, ChatOptions(image_size=28, memory=memory, examples=examples, **options))
        planner.reset(info, np.random.default_rng(seed))
        return planner

    return make


def kinds(script: Script) -> list[str]:
    return [request.schema.__name__ for request in script.requests if request.schema is not None]


def test_the_first_step_takes_the_overall_plan_and_one_call(start) -> None:
    script = Script([outline("find the mug", "take it in the left hand"), idea("GoTo(Mug_1)")])
    planner = start(script)
    assert isinstance(planner, Planner)
    (reply,) = followed(planner, [""])
    assert reply.step is not None
    assert reply.step.to_text() == "GoTo(Mug_1)"
    assert (reply.usage.calls, reply.tokens, reply.usage.usd) == (2, 220, 0.004)
    assert kinds(script) == ["Outline", "Thought"]
    for request in script.requests:
        assert sum(not isinstance(part, str) for message in request.messages for part in message.content) == 1


def test_the_overall_plan_sees_similar_tasks_with_their_plans(start) -> None:
    script = Script(answers)
    followed(start(script, examples=2), [""])
    prompt = script.prompt(0)
    assert f"Experience 1, of the robot H1. Task: {PICK.instruction}\nPlan: GoTo(CounterTop_1); Pick(left, Mug_1)" in prompt
    assert sum(demo.instruction in prompt for demo in DEMOS) == 2


def test_a_step_sees_the_plan_and_moments_of_the_last_key(start) -> None:
    script = Script(
        [
            outline("find the mug", "take it", kind="object", text="mug"),
            idea("GoTo(Mug_1)", kind="action", text="open the drawer"),
            idea("Pick(left, Mug_1)", kind="object", text="knife"),
            idea("Done()"),
        ]
    )
    replies = followed(start(script), ["", "", ""])
    assert [reply.usage.calls for reply in replies] == [2, 1, 1]
    first, second, third = (script.prompt(number) for number in (1, 2, 3))
    assert "Your overall plan:\n1. find the mug\n2. take it" in first
    assert "Experience of the object 'mug':" in first
    assert "In view: CounterTop_1, Mug_1. Step: Pick(left, Mug_1) ok" in first
    assert "Experience of the action 'open the drawer':" in second
    assert "Step: Open(left, Drawer_1) ok" in second
    assert "Experience of the object 'knife':" in third
    assert "1. GoTo(Mug_1) ok" in third  # the log


def test_only_the_first_step_of_a_reply_is_taken(start) -> None:
    script = Script([outline("x"), idea("MoveAhead(0.1)", "Done()"), idea("MoveBack(0.1)")])
    replies = followed(start(script), ["", ""])
    assert [reply.step.to_text() for reply in replies if reply.step is not None] == ["MoveAhead(0.1)", "MoveBack(0.1)"]


def test_a_reply_without_a_step_looks_its_key_up_and_asks_once_more(start) -> None:
    script = Script([outline("x"), idea("MoveAhead(0.1)"), idea(kind="action", text="slice the bread"), idea("Done()")])
    replies = followed(start(script), ["", ""])
    assert [reply.usage.calls for reply in replies] == [2, 2]
    assert "Experience of the action 'slice the bread':" in script.prompt()
    assert "Step: Slice(right, Bread_1) ok" in script.prompt()
    assert "You have looked this up just now: give the next step." in script.prompt()
    assert "looked this up" not in script.prompt(2)


def test_a_step_takes_two_calls_at_most(start) -> None:
    script = Script(lambda request: outline("x") if request.schema is Outline else idea())
    replies = followed(start(script), [""] * 4)
    assert [reply.usage.calls for reply in replies] == [2, 2, 2, 2]
    assert all(reply.step is None and reply.error == "no steps" for reply in replies)


def test_failures_are_reflected_on_with_plan_and_moments_as_often_as_allowed(start) -> None:
    script = Script(answers)
    replies = followed(start(script, replans=2), ["BlockedPath"] * 5)
    assert kinds(script) == ["Outline", "Thought", "Reflection", "Reflection", "Thought", "Thought"]
    assert sum(reply.usage.reflections for reply in replies) == 2
    assert "Failed: MoveAhead(0.1): BlockedPath" in script.prompt(2)
    assert "Your overall plan:\n1. find the mug" in script.prompt(2)
    assert "Experience of the action 'pick up the mug':" in script.prompt(2)
    assert replies[1].step is not None
    assert replies[1].step.to_text() == "MoveBack(0.1)"


def test_without_reflection_a_failure_is_one_more_step(start) -> None:
    script = Script(answers)
    followed(start(script, reflection=False), ["BlockedPath"] * 3)
    assert kinds(script) == ["Outline", "Thought", "Thought", "Thought"]
    assert "1. MoveAhead(0.1) BlockedPath" in script.prompt()


@pytest.mark.parametrize(
    ("reply", "error"),
    [
        ("think hard", "no JSON object"),
        ('{"plan": ["x"]}', "key: Field required"),
        (outline(), "empty plan"),
        (outline("x", kind="place"), "key.kind: Input should be 'object' or 'action'"),
        (ChatReply('{"plan"', 9, 7, finish_reason="length"), "truncated after 7 tokens"),
    ],
)
def test_a_wrong_overall_plan_is_no_step_and_is_asked_again(start, reply: str | ChatReply, error: str) -> None:
    script = Script([reply, outline("x"), idea("Done()")])
    wrong, right = followed(start(script), ["", ""])
    assert wrong.step is None
    assert error in wrong.error
    assert wrong.usage.calls == 1
    assert wrong.tokens > 0
    assert right.step is not None


@pytest.mark.parametrize(
    ("reply", "error"),
    [
        ("think hard", "no JSON object"),
        (idea("Fly()"), "unknown action 'Fly'"),
        ('{"steps": ["Done()"]}', "key: Field required"),
        (ChatReply(idea("Done()"), 9, 7, finish_reason="length"), "truncated after 7 tokens"),
    ],
)
def test_a_wrong_thought_is_no_step_and_the_plan_stays(start, reply: str | ChatReply, error: str) -> None:
    script = Script([outline("x"), reply, idea("Done()")])
    wrong, right = followed(start(script), ["", ""])
    assert wrong.step is None
    assert error in wrong.error
    assert wrong.usage.calls == 2
    assert right.step is not None
    assert kinds(script) == ["Outline", "Thought", "Thought"]


def test_a_wrong_reflection_is_no_step(start) -> None:
    script = Script([outline("x"), idea("MoveAhead(0.1)"), "no", idea("Done()")])
    replies = followed(start(script), ["BlockedPath", "", ""])
    assert [reply.step is None for reply in replies] == [False, True, False]
    assert replies[1].usage.reflections == 1


def test_no_reply_is_an_error_of_the_episode(start) -> None:
    def broken(request: ChatRequest) -> str:
        raise BackendError("gpt4o: timed out")

    with pytest.raises(BackendError, match="timed out"):
        start(Script(broken)).step(observation(), None)


@pytest.mark.parametrize(
    ("instruction", "task"), [("Turn on the lamp.", LAMP), ("Slice the lettuce.", SLICE), ("Stow the phone.", STOW)]
)
def test_experience_is_of_the_related_task(start, instruction: str, task) -> None:
    script = Script(answers)
    planner = start(script, info=TaskInfo(instruction, "h1", 9), examples=1)
    planner.step(observation(), None)
    assert f"Experience 1, of the robot {task.robot.upper()}. Task: {task.instruction}" in script.prompt(0)


def test_the_same_episode_asks_the_same(start) -> None:
    def requests() -> list[ChatRequest]:
        script = Script(answers)
        followed(start(script), ["", "TooFar", ""])
        return script.requests

    assert requests() == requests()


def test_a_new_episode_forgets_the_last_one(start) -> None:
    script = Script(answers)
    planner = start(script)
    followed(planner, ["", ""])
    planner.reset(INFO, np.random.default_rng(1))
    followed(planner, [""])
    assert kinds(script) == ["Outline", "Thought", "Thought", "Outline", "Thought"]


@pytest.mark.parametrize(("kind", "names"), [(Outline, ["plan", "key"]), (Thought, ["thought", "key", "steps"])])
def test_strict_servers_take_the_schemas(kind: type[Outline | Thought], names: list[str]) -> None:
    assert strict_schema(kind)["required"] == names


def test_it_needs_a_memory() -> None:
    with pytest.raises(MemoryFileError, match="RAP needs a memory, got None"):
        RapPlanner(Script([]), ChatOptions())


@pytest.mark.parametrize("kind", ["llm_planner", "rap"])
def test_the_registry_makes_both(kind, blind_memory_folder: Path) -> None:
    cfg = MemoryPlanner("p", kind, "P", examples=2, memory=str(blind_memory_folder))
    backend = BackendConfig("scripted", "b", source="x.py:f")
    assert isinstance(make_chat_planner(cfg, backend, Script([])), Planner)
