"""What a planner gets of what there is to see, to feel and to read: all of it, or less, to measure what each is worth.

A picture that is hidden is grey; a body that is hidden has zeros for its motion, its joints and its key bodies. Names of what
is in view stay: they are words. With `feedback=bit` every failed action reads `Failed`, whatever its code; the code stays in
the ledger and decides the failure's type.

Paper: none. AsgardBench (arXiv 2603.15888) tells failures as one bit to set seeing apart from reading.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from configs.schema.eval import FeedbackName
from configs.schema.planner import BlindName
from interface.failures import FAILED
from interface.feedback import ActionOutcome, Feedback
from interface.observation import HistoryItem, Observation, Proprioception

_GREY = 128


@dataclass(frozen=True, slots=True)
class Showing:
    """What is hidden from a planner.

    Attributes:
        blind: inputs that are hidden.
        feedback: `codes` tells why an action failed, `bit` only that it did.
    """

    blind: BlindName = "none"
    feedback: FeedbackName = "codes"

    def observation(self, observation: Observation) -> Observation:
        """What the planner sees of an observation."""
        if self.blind in ("image", "both"):
            observation = dataclasses.replace(observation, image=grey(observation.image))
        if self.blind in ("motion", "both"):
            observation = dataclasses.replace(observation, proprioception=_numb(observation.proprioception))
        if self.feedback == "bit":
            observation = dataclasses.replace(observation, history=tuple(map(as_bit, observation.history)))
        return observation

    def outcome(self, feedback: Feedback | None) -> Feedback | None:
        """What the planner is told of the last step."""
        if feedback is None:
            return None
        feedback = feedback.public()
        if self.feedback == "codes":
            return feedback
        return dataclasses.replace(feedback, outcomes=tuple(map(_bit, feedback.outcomes)))


def grey(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """A picture (H, W, 3) in which nothing is seen."""
    return np.full_like(image, _GREY)


def _numb(body: Proprioception) -> Proprioception:
    joints, bodies = np.zeros_like(body.joint_positions), np.zeros_like(body.key_bodies_in_pelvis)
    return Proprioception(np.zeros_like(body.motion), body.fps, joints, bodies)


def as_bit(item: HistoryItem) -> HistoryItem:
    """A step with `Failed` in place of every failure code."""
    parts = [part.rpartition(" ") for part in item.feedback.split("; ")]
    return HistoryItem(item.step, "; ".join(f"{action} {code if code == 'ok' else FAILED}" for action, _, code in parts))


def _bit(outcome: ActionOutcome) -> ActionOutcome:
    return outcome if outcome.success else ActionOutcome(outcome.action, False, FAILED)
