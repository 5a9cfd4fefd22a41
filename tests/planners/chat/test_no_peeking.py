"""Planners with a memory see observations and their memory only: the same calls with everything unseen scrambled."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from proprio_mllm.backends.protocol import ChatRequest
from proprio_mllm.evaluation.sessions import SimSession
from proprio_mllm.planners.chat.llm_planner import LlmPlanner
from proprio_mllm.planners.chat.options import ChatOptions
from proprio_mllm.planners.chat.rap import Outline, RapPlanner, Thought
from sim.session.session import Session
from tests.planners.chat.script import Script, plan, thought
from tests.planners.test_no_peeking import TASK, Kept, Scrambled, episode


def answer(request: ChatRequest) -> str:
    """A reply that depends on all of the prompt, so that a change anywhere in it shows."""
    number = sum(len(message.text) for message in request.messages) % 2
    step, key = ("GoTo(CounterTop_1)", "RotateLeft(45)")[number], {"kind": "object", "text": ("mug", "apple")[number]}
    if request.schema is Outline:
        return json.dumps({"plan": [step], "key": key})
    if request.schema is Thought:
        return json.dumps({"thought": "", "key": key, "steps": [step]})
    return (thought if request.purpose == "reflection" else plan)(step)


@pytest.mark.parametrize("kind", [LlmPlanner, RapPlanner])
def test_calls_do_not_depend_on_what_is_not_shown(kind: type[LlmPlanner | RapPlanner], memory_folder: Path) -> None:
    sessions = Session("h1", "easy", 112), Session("h1", "easy", 112)
    scripts = Script(answer), Script(answer)
    options = ChatOptions(image_size=112, memory=str(memory_folder), examples=2)
    kept = Kept(SimSession(sessions[0], TASK))
    first = episode(kind(scripts[0], options), kept)
    assert first == episode(kind(scripts[1], options), Scrambled(sessions[1], kept.shown))
    assert len(first) == TASK.time_limit
    assert scripts[0].requests == scripts[1].requests
    assert scripts[0].requests
    for session in sessions:
        session.close()
