"""From an observation to an example: the one place where a planner at run time and a demonstration in training meet.

Both go through `plan_example`, so that the model sees the same text, image and robot state in training and in use.
"""

from __future__ import annotations

from configs.schema.model import ModelConfig
from data.interface.observation import Observation
from proprio_mllm.model.batch import Example, View
from proprio_mllm.model.motion_tokenizer import MotionTokenizer
from proprio_mllm.model.prompts import plan_prompt, with_answer

__all__ = ["motion_codes", "plan_example", "view_of"]


def view_of(observation: Observation) -> View:
    """The observation's image with its camera and the robot's own body."""
    return View(observation.image, observation.camera, observation.proprioception.key_bodies_in_pelvis)


def motion_codes(observation: Observation, cfg: ModelConfig, motion: MotionTokenizer | None) -> tuple[int, ...] | None:
    """Motion tokens of the observation's window, or None when the configuration shows no proprioception.

    Raises:
        ValueError: when proprioception is on without a motion tokenizer.
    """
    if not cfg.proprioception:
        return None
    if motion is None:
        raise ValueError("proprioception=true needs a motion tokenizer, got None")
    return motion.encode_window(observation.proprioception.motion)


def plan_example(
    observation: Observation, cfg: ModelConfig, motion: MotionTokenizer | None, answer: str | None = None
) -> Example:
    """The planner's prompt for an observation.

    Args:
        observation: what the planner sees.
        cfg: prompt style, history length, proprioception.
        motion: the motion tokenizer.
        answer: `PlanStep` text to learn; None leaves the prompt open for generation.
    """
    messages = plan_prompt(
        observation.instruction,
        observation.robot,
        observation.visible_objects,
        observation.known_objects,
        observation.history,
        observation.step,
        observation.time_limit,
        motion_codes(observation, cfg, motion),
        cfg.prompt,
        cfg.history,
    )
    return Example(messages if answer is None else with_answer(messages, answer), (view_of(observation),))
