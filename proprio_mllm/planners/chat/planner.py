"""What all planners that ask a backend share: their robot's role, an asker per episode, and when they reflect on a failure."""

from __future__ import annotations

import numpy as np

from data.robot_facts import robot_facts
from interface.feedback import Feedback
from interface.manual import action_manual, code_manual
from interface.observation import Observation
from proprio_mllm.backends.protocol import Backend
from proprio_mllm.planners.chat.asking import Answer, Asker
from proprio_mllm.planners.chat.options import ChatOptions
from proprio_mllm.planners.chat.reflection import Seen, reflect
from proprio_mllm.planners.chat.replies import Reflection
from proprio_mllm.planners.chat.view import scene_text
from proprio_mllm.planners.protocol import TaskInfo


def role(robot: str) -> str:
    """Who the model is: the robot's body in numbers. The paper gives its prompts in part; the wording here is ours."""
    facts = robot_facts(robot)
    low, high = facts.pelvis_height_m
    down, up = facts.reach_height_m
    return (
        f"You plan the steps of a household robot, the dual-arm humanoid {facts.name.upper()}. It has a left and a right arm "
        f"of {facts.arm_joints} joints and {facts.arm_length_m:g} m each, with a {facts.hand} at the end, and a camera in its "
        f"head. By bending its legs it moves its pelvis between {low:g} and {high:g} m above the floor; its hands then reach "
        f"from {down:.2g} to {up:.2g} m up. An arm carries {facts.arm_load_kg:g} kg, both {facts.two_arm_load_kg:g} kg."
    )


def system_text(robot: str) -> str:
    """Role, grammar and codes."""
    return "\n\n".join((role(robot), action_manual(), code_manual()))


class ChatPlanner:
    """The start of an episode, what was seen before a step, and reflection; a planner adds `_start` and `step`.

    Args:
        backend: who answers.
        options: see `ChatOptions`.
    """

    privileged = False

    def __init__(self, backend: Backend, options: ChatOptions) -> None:
        self._backend, self._options = backend, options
        self.image_size = options.image_size

    def reset(self, task: TaskInfo, rng: np.random.Generator) -> None:
        """Forgets the last episode."""
        options = self._options
        self._asker = Asker(self._backend, options.max_tokens, options.temperature, int(rng.integers(2**31)))
        self._system = system_text(task.robot)
        self._before: Seen | None = None
        self._replans = 0
        self._start(task, rng)

    def _start(self, task: TaskInfo, rng: np.random.Generator) -> None:
        """Forgets what is the planner's own."""
        raise NotImplementedError

    def _look(self, observation: Observation) -> Seen | None:
        """What was seen before this observation, None at the first one."""
        before, self._before = self._before, Seen.of(observation)
        return before

    def _reflects(self) -> bool:
        """Whether a failure is reflected on now; counts it if so."""
        if not self._options.reflection or self._replans >= self._options.replans:
            return False
        self._replans += 1
        return True

    def _reflection(
        self, observation: Observation, feedback: Feedback, before: Seen | None, extra: str = ""
    ) -> Answer[Reflection]:
        """The reflecting call; see `reflect`."""
        options = self._options
        return reflect(self._asker, self._system, observation, feedback, before, options.history, options.body, extra)

    def _scene(self, observation: Observation) -> str:
        """The situation in words."""
        return scene_text(observation, self._options.history, self._options.body)
