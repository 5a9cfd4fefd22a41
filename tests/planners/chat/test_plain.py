"""Plain prompting: when it asks, what it shows, what it counts."""

from __future__ import annotations

import numpy as np
import pytest

from proprio_mllm.backends.protocol import BackendError, ChatReply, ChatRequest
from proprio_mllm.planners.chat.options import ChatOptions
from proprio_mllm.planners.chat.plain import PlainPlanner
from proprio_mllm.planners.protocol import Planner
from tests.planners.chat.script import INFO, Script, acted, observation, plan, thought


def started(script: Script, **options) -> PlainPlanner:
    planner = PlainPlanner(script, ChatOptions(image_size=28, **options))
    planner.reset(INFO, np.random.default_rng(0))
    return planner


def test_it_asks_with_picture_and_schema_and_counts_the_call() -> None:
    script = Script([plan("GoTo(Mug_1)")])
    planner = started(script)
    assert isinstance(planner, Planner)
    reply = planner.step(observation(), None)
    assert reply.step is not None
    assert reply.step.to_text() == "GoTo(Mug_1)"
    assert (reply.tokens, reply.latency_s, reply.usage.calls, reply.usage.usd) == (110, 0.5, 1, 0.002)
    assert reply.usage.models == ("script-1",)
    (request,) = script.requests
    assert [message.role for message in request.messages] == ["system", "user"]
    assert sum(not isinstance(part, str) for message in request.messages for part in message.content) == 1
    assert request.schema is not None
    assert (request.temperature, request.max_tokens, request.sample) == (0.0, 2048, 0)


def test_further_steps_of_a_reply_cost_nothing_until_one_fails() -> None:
    script = Script([plan("GoTo(Mug_1)", "Pick(left, Mug_1)", "Done()"), plan("MoveDown(0.1)")])
    planner = started(script, horizon=3, reflection=False)
    first = observation()
    planner.step(first, None)
    second, feedback = acted(first, "GoTo(Mug_1)")
    reply = planner.step(second, feedback)
    assert (reply.text, reply.usage.calls, reply.tokens) == ("Pick(left, Mug_1)", 0, 0)
    third, feedback = acted(second, "Pick(left, Mug_1)", "BodyTooHigh")
    reply = planner.step(third, feedback)
    assert reply.step is not None
    assert reply.step.to_text() == "MoveDown(0.1)"
    assert len(script.requests) == 2
    assert "BodyTooHigh" in script.prompt()


def test_a_failure_is_reflected_on_as_often_as_allowed() -> None:
    script = Script(lambda request: (thought if request.purpose == "reflection" else plan)("MoveAhead(0.1)"))
    planner = started(script, replans=2)
    seen, feedback = observation(), None
    reflections = 0
    for _ in range(5):
        reflections += planner.step(seen, feedback).usage.reflections
        seen, feedback = acted(seen, "MoveAhead(0.1)", "BlockedPath")
    assert [request.purpose for request in script.requests] == ["plan", "reflection", "reflection", "plan", "plan"]
    assert reflections == 2
    prompt = script.prompt(1)
    assert "Failed: MoveAhead(0.1): BlockedPath" in prompt
    assert "Completed: nothing" in prompt


def test_a_reflection_tells_what_changed_in_view_and_what_is_done() -> None:
    script = Script([plan("GoTo(Mug_1)"), plan("Pick(left, Mug_1)"), thought("Done()")])
    planner = started(script)
    first = observation(visible=("Mug_1", "Table_1"))
    planner.step(first, None)
    second, feedback = acted(observation(visible=("Mug_1", "Table_1")), "GoTo(Mug_1)")
    planner.step(second, feedback)
    third, feedback = acted(second, "Pick(left, Mug_1)", "TooFar")
    planner.step(observation(third.history, visible=("Mug_1", "Fridge_1")), feedback)
    assert "Changed: now in view: Fridge_1; no longer in view: Table_1" in script.prompt()
    assert "Completed: GoTo(Mug_1)" in script.prompt()


@pytest.mark.parametrize(
    ("reply", "error"),
    [
        ("walk to the mug", "no JSON object"),
        ('{"steps": ["Fly()"]}', "unknown action 'Fly'"),
        (ChatReply('{"steps"', 9, 7, finish_reason="length"), "truncated after 7 tokens"),
    ],
)
def test_a_wrong_reply_is_no_step_and_is_paid_for(reply: str | ChatReply, error: str) -> None:
    script = Script([reply, plan("Done()")])
    planner = started(script)
    answer = planner.step(observation(), None)
    assert answer.step is None
    assert error in answer.error
    assert answer.usage.calls == 1
    assert answer.tokens > 0
    assert planner.step(observation(), None).step is not None


def test_no_reply_is_an_error_of_the_episode() -> None:
    def broken(request: ChatRequest) -> str:
        raise BackendError("gpt4o: timed out")

    with pytest.raises(BackendError, match="timed out"):
        started(Script(broken)).step(observation(), None)


def test_episodes_draw_different_samples_only_above_temperature_zero() -> None:
    script = Script(lambda request: plan("Done()"))
    planner = started(script, temperature=0.5)
    planner.step(observation(), None)
    planner.step(observation(), None)
    planner.reset(INFO, np.random.default_rng(1))
    planner.step(observation(), None)
    assert len({request.sample for request in script.requests}) == 3


def test_a_new_episode_forgets_the_last_one() -> None:
    script = Script([plan("GoTo(Mug_1)", "Done()"), plan("MoveAhead(1)")])
    planner = started(script, horizon=5)
    planner.step(observation(), None)
    planner.reset(INFO, np.random.default_rng(0))
    reply = planner.step(observation(), None)
    assert reply.step is not None
    assert reply.step.to_text() == "MoveAhead(1)"
