"""The floor of every table: legal actions at random.

Each step draws an action name uniformly from the grammar, then an arm, an object among those in view (or known, when none is in
view; GoTo always among the known) and an amount from the action's range. `Done` is left out: quitting early at random would
only hide what the rest of the budget achieves. Paper: not in its tables; added here as a reference.
"""

from __future__ import annotations

import time

import numpy as np

from interface.actions import ACTIONS, ActionKind
from interface.bodies import Arm
from interface.feedback import Feedback
from interface.observation import Observation
from interface.steps import Action, PlanStep
from proprio_mllm.planners.protocol import PlannerReply, TaskInfo


class RandomPlanner:
    """Draws legal actions.

    Args:
        image_size: side of the head view it is shown and ignores, pixels.
    """

    privileged = False

    def __init__(self, image_size: int = 112) -> None:
        self.image_size = image_size
        self._rng = np.random.default_rng(0)

    def reset(self, task: TaskInfo, rng: np.random.Generator) -> None:
        """Takes the episode's generator."""
        self._rng = rng

    def step(self, observation: Observation, feedback: Feedback | None) -> PlannerReply:
        """A legal step over the names in the observation."""
        started = time.perf_counter()
        step = self._draw(observation)
        return PlannerReply(step.to_text(), step, latency_s=time.perf_counter() - started)

    def _draw(self, observation: Observation) -> PlanStep:
        nameless = not (observation.visible_objects or observation.known_objects)
        names = [name for name, spec in ACTIONS.items() if name != "Done" and not (nameless and spec.takes_object)]
        action = self._action(str(self._rng.choice(names)), observation, None)
        if action.spec.kind is ActionKind.ARM and self._rng.random() < 0.5:
            assert action.arm is not None
            arms = [name for name in names if ACTIONS[name].kind is ActionKind.ARM]
            return PlanStep((action, self._action(str(self._rng.choice(arms)), observation, action.arm.other)))
        return PlanStep((action,))

    def _action(self, name: str, observation: Observation, arm: Arm | None) -> Action:
        spec = ACTIONS[name]
        if spec.kind is ActionKind.ARM and arm is None:
            arm = Arm(str(self._rng.choice([arm.value for arm in Arm])))
        target: str | None = None
        if spec.takes_object:
            known, visible = observation.known_objects, observation.visible_objects
            names = (known or visible) if name == "GoTo" else (visible or known)
            target = str(self._rng.choice(names))
        amount: float | None = None
        if len(spec.amounts) == 1:
            low, high = spec.amounts[0].low, spec.amounts[0].high
            amount = round(float(self._rng.uniform(low, min(high, 1.0) if spec.amounts[0].unit == "m" else high)), 2)
        return Action(name, arm=arm if spec.kind is ActionKind.ARM else None, object_id=target, amount=amount)
