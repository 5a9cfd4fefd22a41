"""RAP: retrieval-augmented planning. Experience is looked up for the task, and again for what each thought is about.

Calls: one per episode writes the overall plan from the `examples` stored tasks that are most alike in instruction and category,
and says what to look up first. Every step is then one call that sees the plan and, for the key of the last thought, the moments
of memory that fit best (`recall.MomentRecall`); it replies with a thought, the thought's key, and the next step. A reply that
has no step looks its key up and asks once more. So a step takes at most two calls; the first step's are the overall plan and
one. The call after a failure is the reflecting one, at most `replans` times; it sees plan and moments too. A task's category is
that of the nearest stored task, never the benchmark's label.

Where the memory has pictures, likeness of the view counts in the second retrieval. The paper's RAP thinks in turns of its own,
without a bound; its released code reports the best of three trials, with a memory of the evaluated games. Here there is one
trial, and the memory is of training tasks.

Paper: baseline RAP of Tables II and III; Kagaya et al., 2024.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from interface.feedback import Feedback
from interface.observation import Observation
from proprio_mllm.backends.protocol import Backend, ChatImage
from proprio_mllm.planners.chat.asking import Answer
from proprio_mllm.planners.chat.options import ChatOptions
from proprio_mllm.planners.chat.planner import ChatPlanner
from proprio_mllm.planners.chat.recall import Key, Moment, load_moments
from proprio_mllm.planners.chat.replies import Reflection, ReplyError, read_steps
from proprio_mllm.planners.chat.view import encoded
from proprio_mllm.planners.memory import MemoryEpisode, MemoryFileError
from proprio_mllm.planners.protocol import PlannerReply, TaskInfo

_KEY: Final = '"key": {"kind": "object" or "action", "text": "..."}'
OUTLINE_RULES: Final = (
    "The experiences are similar tasks that were done before. Write the overall plan of your task, one line per step, and say "
    "what to look up first in the memory of such tasks: an object that you look for, or an action that you intend.\n"
    'Reply with one JSON object: {"plan": ["...", ...], ' + _KEY + "}"
)
STEP_RULES: Final = (
    "The experiences are moments of similar tasks that were done before: take over how it was done, not names and distances. "
    "Think about what comes next, and name what the thought is about, which is looked up for you: an object that you look for, "
    "or an action that you intend. Give the next step, in the action grammar; leave steps empty only to see first what is "
    "found for a new key.\n"
    'Reply with one JSON object: {"thought": "...", ' + _KEY + ', "steps": ["..."]}'
)
_NOW: Final = "You have looked this up just now: give the next step."


class SearchKey(BaseModel):
    """What to look up."""

    model_config = ConfigDict(extra="ignore")

    kind: Literal["object", "action"] = Field(description="whether an object is sought or an action intended")
    text: str = Field(description="name of the object, or the action in a few words")


class Outline(BaseModel):
    """The overall plan."""

    model_config = ConfigDict(extra="ignore")

    plan: list[str] = Field(description="the overall plan, one line per step")
    key: SearchKey = Field(description="what to look up first")


class Thought(BaseModel):
    """A thought, what it is about, and the step that follows from it."""

    model_config = ConfigDict(extra="ignore")

    thought: str = Field(default="", description="what the situation is and what comes next")
    key: SearchKey = Field(description="what the thought is about")
    steps: list[str] = Field(description="the next step, written in the action grammar; empty to look the key up first")


class RapPlanner(ChatPlanner):
    """Looks up experience before it acts.

    Args:
        backend: who answers.
        options: see `ChatOptions`; `memory` and `examples` are needed.

    Raises:
        MemoryFileError: when there is no memory or it cannot be read.
        EmbeddingError: when a package is not installed.
        SightError: when the memory has pictures and their encoder is not there.
    """

    def __init__(self, backend: Backend, options: ChatOptions) -> None:
        if options.memory is None:
            raise MemoryFileError("RAP needs a memory, got None: set planner.memory=FOLDER")
        super().__init__(backend, options)
        self._moments = load_moments(options.memory)

    def _start(self, task: TaskInfo, rng: np.random.Generator) -> None:
        """Predicts the category of the new task."""
        self._instruction, self._family = task.instruction, self._moments.tasks.family(task.instruction)
        self._plan: tuple[str, ...] = ()
        self._key: Key | None = None

    def step(self, observation: Observation, feedback: Feedback | None) -> PlannerReply:
        """The next step.

        Raises:
            BackendError: when the backend gives no reply.
        """
        before = self._look(observation)
        if not self._plan:
            outline = self._outline(observation)
            if outline.value is None or not outline.value.plan:
                return self._asker.reply(outline.text, None, outline.error or "empty plan")
            self._plan, self._key = tuple(outline.value.plan), _key(outline.value.key)
            return self._reply(self._think(observation, _NOW))
        if feedback is not None and not feedback.success and self._reflects():
            return self._reply(self._reflection(observation, feedback, before, self._experience(observation)))
        answer = self._think(observation)
        if answer.value is not None and not answer.value.steps:
            answer = self._think(observation, _NOW)
        return self._reply(answer)

    def _outline(self, observation: Observation) -> Answer[Outline]:
        """Asks for the overall plan."""
        stored = self._moments.tasks.similar(self._instruction, self._family, self._options.examples)
        text = "\n\n".join(task_text(number, one) for number, one in enumerate(stored, start=1))
        return self._asker.ask(f"{self._system}\n\n{OUTLINE_RULES}", self._content(observation, text), Outline)

    def _think(self, observation: Observation, note: str = "") -> Answer[Thought]:
        """Asks for the next thought; its key is what the next call sees experience of."""
        text = "\n\n".join(part for part in (self._experience(observation), note) if part)
        answer = self._asker.ask(f"{self._system}\n\n{STEP_RULES}", self._content(observation, text), Thought)
        if answer.value is not None:
            self._key = _key(answer.value.key)
        return answer

    def _content(self, observation: Observation, text: str) -> tuple[str | ChatImage, ...]:
        return text, f"Now your task.\n{self._scene(observation)}", encoded(observation.image)

    def _experience(self, observation: Observation) -> str:
        """The overall plan, and what memory has on the key."""
        assert self._key is not None
        found = self._moments.moments(
            self._instruction, self._family, self._plan, self._key, observation.image, self._options.examples
        )
        moments = [moment_text(number, one) for number, one in enumerate(found, start=1)]
        plan = "\n".join(f"{number}. {line}" for number, line in enumerate(self._plan, start=1))
        looked_up = f"Experience of the {self._key.kind} {self._key.text!r}:"
        return "\n\n".join((f"Your overall plan:\n{plan}", looked_up, *moments))

    def _reply(self, answer: Answer[Thought] | Answer[Reflection]) -> PlannerReply:
        """The first step of an answer."""
        if answer.value is None:
            return self._asker.reply(answer.text, None, answer.error)
        try:
            return self._asker.reply(answer.text, read_steps(answer.value.steps, 1)[0])
        except ReplyError as error:
            return self._asker.reply(answer.text, None, str(error))


def task_text(number: int, episode: MemoryEpisode) -> str:
    """A stored task with its plan."""
    return f"{_title(number, episode)}\nPlan: {'; '.join(episode.plan)}"


def moment_text(number: int, moment: Moment) -> str:
    """The steps of a stored moment, each with what was in view before it and its result."""
    return "\n".join((_title(number, moment.episode), *_lines(moment)))


def _title(number: int, episode: MemoryEpisode) -> str:
    return f"Experience {number}, of the robot {episode.robot.upper()}. Task: {episode.instruction}"


def _lines(moment: Moment) -> Sequence[str]:
    return [f"In view: {', '.join(step.visible) or 'nothing'}. Step: {step.feedback}" for step in moment.steps]


def _key(found: SearchKey) -> Key:
    return Key(found.kind, found.text[:200])
