"""Plain prompting: picture, task, names, log and action grammar in one prompt, the next step or steps in the reply.

The reply's first `horizon` steps are carried out in order; a failure, an invalid reply or the end of them asks again. With
reflection, the call after a failure is the reflecting one, at most `replans` times in an episode. Paper: baselines GPT-4o,
Gemini-1.5-Pro, Qwen2.5-VL-7B-Instruct and InternVL2.5-8B of Table II; how many steps they plan at once is not said.
"""

from __future__ import annotations

from collections import deque

import numpy as np

from interface.feedback import Feedback
from interface.manual import action_manual, code_manual
from interface.observation import Observation
from interface.steps import PlanStep
from proprio_mllm.backends.protocol import Backend, ChatImage
from proprio_mllm.planners.chat.asking import Answer, Asker
from proprio_mllm.planners.chat.options import ChatOptions
from proprio_mllm.planners.chat.reflection import Seen, reflect
from proprio_mllm.planners.chat.replies import Plan, Reflection, ReplyError, read_steps
from proprio_mllm.planners.chat.role import role
from proprio_mllm.planners.chat.view import encoded, scene_text
from proprio_mllm.planners.protocol import PlannerReply, TaskInfo

PLAN_RULES = (
    "Look at the picture, the names and the log, and decide what comes next. What you need and do not know has to be looked "
    "for: turn, walk, open things.\n"
    'Reply with one JSON object: {"reasoning": "...", "steps": ["...", ...]}'
)


def system_text(robot: str) -> str:
    """Role, grammar and codes, shared by all planners of this package."""
    return "\n\n".join((role(robot), action_manual(), code_manual()))


class PlainPlanner:
    """Asks for the next steps until they are done or fail.

    Args:
        backend: who answers.
        options: see `ChatOptions`.
    """

    privileged = False

    def __init__(self, backend: Backend, options: ChatOptions) -> None:
        self._backend, self._options = backend, options
        self.image_size = options.image_size
        self._start(0, "")

    def _start(self, seed: int, system: str) -> None:
        options = self._options
        self._asker = Asker(self._backend, options.max_tokens, options.temperature, seed)
        self._system = system
        self._queue: deque[PlanStep] = deque()
        self._before: Seen | None = None
        self._replans = 0

    def reset(self, task: TaskInfo, rng: np.random.Generator) -> None:
        """Forgets the last episode."""
        self._start(int(rng.integers(2**31)), system_text(task.robot))

    def step(self, observation: Observation, feedback: Feedback | None) -> PlannerReply:
        """The next step.

        Raises:
            BackendError: when the backend gives no reply.
        """
        failed = feedback is not None and not feedback.success
        if failed:
            self._queue.clear()
        before, self._before = self._before, Seen.of(observation)
        if self._queue:
            step = self._queue.popleft()
            return self._asker.reply(step.to_text(), step)
        options = self._options
        answer: Answer[Plan] | Answer[Reflection]
        if failed and options.reflection and self._replans < options.replans:
            assert feedback is not None
            self._replans += 1
            answer = reflect(self._asker, self._system, observation, feedback, before, options.history, options.body)
        else:
            text = scene_text(observation, options.history, options.body)
            content: tuple[str | ChatImage, ...] = (text, encoded(observation.image))
            answer = self._asker.ask(f"{self._system}\n\n{PLAN_RULES}", content, Plan)
        if answer.value is None:
            return self._asker.reply(answer.text, None, answer.error)
        try:
            steps = read_steps(answer.value.steps, options.horizon)
        except ReplyError as error:
            return self._asker.reply(answer.text, None, str(error))
        self._queue.extend(steps[1:])
        return self._asker.reply(answer.text, steps[0])
