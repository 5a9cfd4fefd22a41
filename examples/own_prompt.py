"""A prompt of one's own, asked of any language model:

    python eval.py planner=file planner.source=examples/own_prompt.py:Brief planner.name=brief backend=gpt4o robot=h1

The backend comes from the run: its replies are cached and priced, its calls, tokens and money are counted in the ledger, and
failures of the server are no scores. Copy it, and write a prompt of your own. A class that inherits from a planner of
`proprio_mllm.planners.chat`, such as `PlainPlanner`, is made in the same way.
"""

import numpy as np
from pydantic import BaseModel

from interface.feedback import Feedback
from interface.manual import action_manual
from interface.observation import Observation
from proprio_mllm.backends.protocol import Backend
from proprio_mllm.planners.chat.asking import Asker
from proprio_mllm.planners.chat.options import ChatOptions
from proprio_mllm.planners.chat.planner import role
from proprio_mllm.planners.chat.view import encoded
from proprio_mllm.planners.protocol import PlannerReply, TaskInfo


class NextStep(BaseModel):
    """What the model is asked to reply, as JSON; a reply that is anything else costs a step."""

    step: str


class Brief:
    """Tells the robot, the grammar, the task, the names and the last five steps, shows the picture, and asks for one step."""

    privileged = False  # it sees what an Observation holds: pictures, joints, names, feedback

    def __init__(self, backend: Backend, options: ChatOptions) -> None:
        """Takes the run's backend and its options (`backend.image_size`, `backend.max_tokens`, `planner.history` and so on)."""
        self.backend, self.options = backend, options
        self.image_size = options.image_size

    def reset(self, task: TaskInfo, rng: np.random.Generator) -> None:
        """A new episode with an asker of its own; `rng` is its only source of randomness, samples above temperature 0 too."""
        seed = int(rng.integers(2**31))
        self.asker = Asker(self.backend, self.options.max_tokens, self.options.temperature, seed)
        self.rules = f'{role(task.robot)}\n\n{action_manual()}\n\nReply with one JSON object: {{"step": "..."}}'

    def step(self, observation: Observation, feedback: Feedback | None) -> PlannerReply:
        """One call for one plan step; what is outside the grammar costs a step and comes back as `InvalidOutput`."""
        log = "\n".join(f"{item.step} -> {item.feedback}" for item in observation.history[-5:])
        scene = f"Task: {observation.instruction}\nNames: {', '.join(observation.known_objects)}\nLog:\n{log or 'none'}"
        answer = self.asker.ask(self.rules, (scene, encoded(observation.image)), NextStep)
        if answer.value is None:
            return self.asker.reply(answer.text, None, answer.error)
        return self.asker.parsed(answer.value.step)
