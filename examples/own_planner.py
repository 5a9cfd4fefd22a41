"""A planner in one file: `python eval.py planner=file planner.source=examples/own_planner.py:Nearby robot=h1`.

It walks to something that its instruction names, and picks it up. Copy it, and answer with a model or rules of your own.
"""

import numpy as np

from interface.feedback import Feedback
from interface.observation import Observation
from proprio_mllm.planners.protocol import PlannerReply, TaskInfo, parse_reply


class Nearby:
    """Goes to what the instruction names first, as far as it has been seen, and picks it up with either arm."""

    privileged = False  # it sees what an Observation holds: pictures, joints, names, feedback
    image_size = 112  # side of the head camera's picture, pixels

    def reset(self, task: TaskInfo, rng: np.random.Generator) -> None:
        """A new episode; `rng` is its only source of randomness."""
        self.words = task.instruction.lower().replace(" ", "")
        self.rng = rng

    def step(self, observation: Observation, feedback: Feedback | None) -> PlannerReply:
        """One plan step as text; what is outside the grammar costs a step and comes back as `InvalidOutput`."""
        last = observation.history[-1].feedback if observation.history else ""  # "Pick(left, Mug_1) TooFar"
        if last.endswith(("BodyTooHigh", "BodyTooLow")):
            return parse_reply("MoveDown(0.1)" if last.endswith("High") else "MoveUp(0.1)")
        places = {name: self.words.find(name.split("_")[0].lower()) for name in observation.known_objects}
        named = sorted((name for name in places if places[name] >= 0), key=lambda name: places[name])
        target = named[0] if named and not last.endswith("NotPickupable") else str(self.rng.choice(observation.known_objects))
        if (target in last and not last.endswith("TooFar")) or last.startswith("Move"):
            return parse_reply(f"Pick({self.rng.choice(['left', 'right'])}, {target})")
        return parse_reply(f"GoTo({target})")
