"""A planner in one file: `python eval.py planner=file planner.source=examples/own_planner.py:Nearby robot=h1`.

It walks to something that its instruction names, and picks it up. Copy it, and answer with a model or rules of your own.
"""

import numpy as np

from data.interface.feedback import Feedback
from data.interface.observation import Observation
from proprio_mllm.planners.protocol import PlannerReply, TaskInfo, parse_reply


class Nearby:
    """Goes to a named object and picks it up with the arm that is free; anything at random when nothing is named."""

    privileged = False  # it sees what an Observation holds: pictures, joints, names, feedback
    image_size = 112  # side of the head camera's picture, pixels

    def reset(self, task: TaskInfo, rng: np.random.Generator) -> None:
        """A new episode; `rng` is its only source of randomness."""
        self.words = task.instruction.lower().replace(" ", "")
        self.rng = rng

    def step(self, observation: Observation, feedback: Feedback | None) -> PlannerReply:
        """One plan step as text; what is outside the grammar costs a step and comes back as `InvalidOutput`."""
        named = [name for name in observation.known_objects if name.split("_")[0].lower() in self.words]
        target = str(self.rng.choice(named or observation.known_objects))
        gone = observation.history and observation.history[-1].step == f"GoTo({target})"
        return parse_reply(f"Pick({self.rng.choice(['left', 'right'])}, {target})" if gone else f"GoTo({target})")
