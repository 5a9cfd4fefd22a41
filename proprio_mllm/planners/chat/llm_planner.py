"""LLM-Planner: a whole plan from the nearest tasks of memory, carried out in order, re-planned where it breaks.

One call makes the plan, with the `examples` tasks in the prompt whose instructions have the greatest cosine with this one. Its
steps are carried out without further calls until one fails, is outside the grammar, or the plan is used up without `Done()`;
then the remaining plan is asked for, with names in view, log and completed steps as they are now, and with reflection in a
reflecting call. After `replans` such calls the rest of the plan is carried out as it stands, and `Done()` ends it. An object
that is not known is taken for the known one whose type's words have the greatest cosine with its own, from 0.8 on.

Each example is shown from a random point of its plan on, as in the released code; there the point is drawn without a seed and
re-planning is off, here the episode's generator draws it and re-planning is on.

Paper: baseline LLM-Planner of Tables II and III; Song et al., ICCV 2023.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from interface.feedback import Feedback
from interface.observation import Observation
from interface.steps import Action, ActionError, PlanStep
from proprio_mllm.backends.protocol import Backend, ChatImage
from proprio_mllm.planners.chat.asking import Answer
from proprio_mllm.planners.chat.embedding import Embedder
from proprio_mllm.planners.chat.options import ChatOptions
from proprio_mllm.planners.chat.planner import ChatPlanner
from proprio_mllm.planners.chat.recall import load_tasks
from proprio_mllm.planners.chat.reflection import Seen, completed_steps
from proprio_mllm.planners.chat.replies import Plan, Reflection
from proprio_mllm.planners.chat.spoken import type_words
from proprio_mllm.planners.chat.view import encoded
from proprio_mllm.planners.memory import MemoryEpisode, MemoryFileError
from proprio_mllm.planners.protocol import PlannerReply, TaskInfo

#: Least cosine at which an unknown object is taken for a known one.
LEAST_LIKENESS: Final = 0.8
WHOLE_PLAN_RULES: Final = (
    "Write the whole plan that remains, from now to the end of the task, in order, with Done() as its last step. The examples "
    "are tasks that were done in other situations: take over how they are done, not their names and distances.\n"
    'Reply with one JSON object: {"reasoning": "...", "steps": ["...", ...]}'
)
_DONE: Final = "Done()"


class LlmPlanner(ChatPlanner):
    """Plans to the end and follows the plan.

    Args:
        backend: who answers.
        options: see `ChatOptions`; `memory` and `examples` are needed.

    Raises:
        MemoryFileError: when there is no memory or it cannot be read.
        EmbeddingError: when a package is not installed.
    """

    def __init__(self, backend: Backend, options: ChatOptions) -> None:
        if options.memory is None:
            raise MemoryFileError("LLM-Planner needs a memory, got None: set planner.memory=FOLDER")
        super().__init__(backend, options)
        self._tasks = load_tasks(options.memory)

    def _start(self, task: TaskInfo, rng: np.random.Generator) -> None:
        """Looks up examples for the new episode."""
        self._queue: deque[str] = deque()
        self._asked = 0
        self._wrong = False
        nearest = self._tasks.nearest(task.instruction, self._options.examples)
        examples = [example_text(n, one, int(rng.integers(len(one.plan)))) for n, one in enumerate(nearest, start=1)]
        self._examples = "\n\n".join(examples)

    def step(self, observation: Observation, feedback: Feedback | None) -> PlannerReply:
        """The next step of the plan, or of a new one.

        Raises:
            BackendError: when the backend gives no reply.
        """
        failed = feedback is not None and not feedback.success
        before = self._look(observation)
        broken = failed or self._wrong or not self._queue
        self._wrong = False
        if broken and self._asked <= self._options.replans:
            return self._plan(observation, feedback if failed else None, before)
        if not self._queue:
            return self._asker.reply(_DONE, PlanStep.parse(_DONE))
        return self._next(observation)

    def _plan(self, observation: Observation, failure: Feedback | None, before: Seen | None) -> PlannerReply:
        """Asks for the remaining plan and takes its first step; without a valid one the old plan stays."""
        self._asked += 1
        answer: Answer[Plan] | Answer[Reflection]
        if failure is not None and self._options.reflection:
            extra = f"Your next steps must be the whole remaining plan, with {_DONE} as its last.\n\n{self._examples}"
            answer = self._reflection(observation, failure, before, extra)
        else:
            done = "; ".join(completed_steps(observation.history)) or "nothing"
            now = f"Now your task.\nCompleted: {done}\n{self._scene(observation)}"
            content: tuple[str | ChatImage, ...] = (self._examples, now, encoded(observation.image))
            answer = self._asker.ask(f"{self._system}\n\n{WHOLE_PLAN_RULES}", content, Plan)
        if answer.value is None or not answer.value.steps:
            self._wrong = True
            return self._asker.reply(answer.text, None, answer.error or "no steps")
        self._queue = deque(answer.value.steps)
        return self._next(observation, answer.text)

    def _next(self, observation: Observation, text: str = "") -> PlannerReply:
        """Takes the next step off the plan; `text` is the reply it came with."""
        written = self._queue.popleft()
        try:
            step = PlanStep.parse(written)
        except ActionError as error:
            self._wrong = True
            return self._asker.reply(text or written, None, str(error))
        known = dict.fromkeys((*observation.visible_objects, *observation.known_objects))
        step = with_known_names(step, tuple(known), self._tasks.embedder)
        return self._asker.reply(text or step.to_text(), step)


def example_text(number: int, episode: MemoryEpisode, cut: int) -> str:
    """A stored task as if the first `cut` steps of its plan were done."""
    moments = [step for step in episode.steps if step.success]
    rest = [*episode.plan[cut:], *([] if episode.plan[-1] == _DONE else [_DONE])]
    lines = (
        f"Example {number}, done by the robot {episode.robot.upper()}.",
        f"Task: {episode.instruction}",
        f"Completed: {'; '.join(episode.plan[:cut]) or 'nothing'}",
        f"Objects in view: {', '.join(moments[cut].visible) or 'none'}",
        f"Remaining plan: {'; '.join(rest)}",
    )
    return "\n".join(lines)


def with_known_names(step: PlanStep, known: Sequence[str], embedder: Embedder) -> PlanStep:
    """A step whose unknown objects are replaced by the known ones that are most alike, if they are alike enough.

    Args:
        step: as planned.
        known: ids; of equals the first is taken.
        embedder: of the types' words.
    """
    return PlanStep(tuple(_with_known_name(action, known, embedder) for action in step.actions))


def _with_known_name(action: Action, known: Sequence[str], embedder: Embedder) -> Action:
    if action.object_id is None or action.object_id in known or not known:
        return action
    likeness = embedder.embed([type_words(one) for one in known]) @ embedder.embed([type_words(action.object_id)])[0]
    best = int(np.argmax(likeness))
    return replace(action, object_id=known[best]) if likeness[best] >= LEAST_LIKENESS else action
