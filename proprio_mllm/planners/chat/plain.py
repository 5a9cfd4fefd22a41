"""Plain prompting: picture, task, names, log and action grammar in one prompt, the next step or steps in the reply.

The reply's first `horizon` steps are carried out in order; a failure, an invalid reply or the end of them asks again. With
reflection, the call after a failure is the reflecting one, at most `replans` times in an episode. Paper: baselines GPT-4o,
Gemini-1.5-Pro, Qwen2.5-VL-7B-Instruct and InternVL2.5-8B of Table II; how many steps they plan at once is not said.
"""

from __future__ import annotations

from collections import deque

import numpy as np

from interface.feedback import Feedback
from interface.observation import Observation
from interface.steps import PlanStep
from proprio_mllm.planners.chat.asking import Answer
from proprio_mllm.planners.chat.planner import ChatPlanner
from proprio_mllm.planners.chat.replies import Plan, Reflection, ReplyError, read_steps
from proprio_mllm.planners.chat.view import encoded
from proprio_mllm.planners.protocol import PlannerReply, TaskInfo

PLAN_RULES = (
    "Look at the picture, the names and the log, and decide what comes next. What you need and do not know has to be looked "
    "for: turn, walk, open things.\n"
    'Reply with one JSON object: {"reasoning": "...", "steps": ["...", ...]}'
)


class PlainPlanner(ChatPlanner):
    """Asks for the next steps until they are done or fail."""

    def _start(self, task: TaskInfo, rng: np.random.Generator) -> None:
        self._queue: deque[PlanStep] = deque()

    def step(self, observation: Observation, feedback: Feedback | None) -> PlannerReply:
        """The next step.

        Raises:
            BackendError: when the backend gives no reply.
        """
        failure = feedback if feedback is not None and not feedback.success else None
        if failure is not None:
            self._queue.clear()
        before = self._look(observation)
        if self._queue:
            step = self._queue.popleft()
            return self._asker.reply(step.to_text(), step)
        answer: Answer[Plan] | Answer[Reflection]
        if failure is not None and self._reflects():
            answer = self._reflection(observation, failure, before)
        else:
            content = self._scene(observation), encoded(observation.image)
            answer = self._asker.ask(f"{self._system}\n\n{PLAN_RULES}", content, Plan)
        if answer.value is None:
            return self._asker.reply(answer.text, None, answer.error)
        try:
            steps = read_steps(answer.value.steps, self._options.horizon)
        except ReplyError as error:
            return self._asker.reply(answer.text, None, str(error))
        self._queue.extend(steps[1:])
        return self._asker.reply(answer.text, steps[0])
