"""A backend of a list of replies, and observations for tests of chat planners."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable, Iterable

import numpy as np

from interface.failures import FailureCategory
from interface.feedback import ActionOutcome, Feedback
from interface.observation import Camera, HistoryItem, Observation, Proprioception
from interface.steps import PlanStep
from proprio_mllm.backends.protocol import ChatReply, ChatRequest
from proprio_mllm.planners.protocol import Planner, PlannerReply, TaskInfo

INFO = TaskInfo("pick up the mug", "h1", 9)


class Script:
    """Answers from a list, or by a function; keeps the requests."""

    identity = "script"

    def __init__(self, replies: Iterable[str | ChatReply] | Callable[[ChatRequest], str | ChatReply]) -> None:
        self.requests: list[ChatRequest] = []
        left = iter(()) if callable(replies) else iter(replies)
        self._answer = replies if callable(replies) else (lambda request: next(left))

    def complete(self, request: ChatRequest) -> ChatReply:
        self.requests.append(request)
        reply = self._answer(request)
        return reply if isinstance(reply, ChatReply) else ChatReply(reply, 100, 10, 0.5, model="script-1", cost_usd=0.002)

    def close(self) -> None:
        self.requests.clear()

    def prompt(self, index: int = -1) -> str:
        """All texts of a request."""
        return "\n".join(message.text for message in self.requests[index].messages)


def plan(*steps: str) -> str:
    return json.dumps({"reasoning": "because", "steps": list(steps)})


def thought(*steps: str) -> str:
    return json.dumps({"cause": "too far", "change": "go nearer", "steps": list(steps)})


def observation(history: tuple[HistoryItem, ...] = (), visible: tuple[str, ...] = ("Mug_1",)) -> Observation:
    body = Proprioception(np.zeros((64, 48), np.float32), 20.0, np.zeros(3), np.arange(42.0).reshape(14, 3) / 100)
    camera = Camera(np.eye(3), np.eye(4), 28, 28)
    image = np.full((28, 28, 3), 7, np.uint8)
    known = ("Mug_1", "Fridge_1", "Table_1")
    return Observation(INFO.instruction, "h1", image, camera, visible, known, body, history, len(history), 9)


def acted(before: Observation, step: str, code: str = "") -> tuple[Observation, Feedback]:
    """The observation after a step, and its feedback; a code makes all its actions fail."""
    category = FailureCategory.LOGICAL if code else None
    outcomes = [ActionOutcome(action, not code, code, category) for action in PlanStep.parse(step).actions]
    feedback = Feedback(tuple(outcomes), 1.0)
    history = (*before.history, HistoryItem(step, feedback.to_text()))
    return dataclasses.replace(before, history=history, step=len(history)), feedback


def followed(planner: Planner, codes: list[str]) -> list[PlannerReply]:
    """Replies of an episode whose steps end with these codes, empty for success."""
    seen: Observation = observation()
    feedback: Feedback | None = None
    replies: list[PlannerReply] = []
    for code in codes:
        reply = planner.step(seen, feedback)
        replies.append(reply)
        if reply.step is None:
            feedback = None
        else:
            seen, feedback = acted(seen, reply.step.to_text(), code)
    return replies
