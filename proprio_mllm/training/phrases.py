"""Phrases without pictures or motion: the words that stage 2 answers with, which a pretrained language model knows.

A model that has met neither the captions' words nor "left right" as an answer would have to learn them in stage 2, where its
rows of words are frozen. Captions are written without their motion, and body states are read from words instead of motion.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from proprio_mllm.model.batch import Example
from proprio_mllm.model.prompts import Style, body_state_prompt, described_motion
from proprio_mllm.training.sources import Clips

#: Pelvis heights are said in multiples of this, metres.
_HEIGHT_STEP_M: Final = 0.05
_LOWEST_M, _HIGHEST_M = 0.3, 1.2


def body_state_words(left_open: bool, right_open: bool, pelvis_height_m: float) -> tuple[str, str]:
    """Which hands are open, and the pelvis' height in metres, in words."""
    hands = [name for name, is_open in (("left", left_open), ("right", right_open)) if is_open]
    return " ".join(hands) or "none", f"{round(pelvis_height_m / _HEIGHT_STEP_M) * _HEIGHT_STEP_M:.2f}"


def phrase(clips: Clips, rng: np.random.Generator, style: Style) -> Example:
    """A caption of a training clip, or questions about a body state that words tell."""
    if rng.random() < 0.5:
        clip = int(rng.choice(clips.split.train))
        return Example(described_motion(None, clips.caption(clip, rng), style=style))
    left, right = (bool(rng.random() < 0.5) for _ in range(2))
    hands, height = body_state_words(left, right, float(rng.uniform(_LOWEST_M, _HIGHEST_M)))
    told = f"left {'open' if left else 'closed'} right {'open' if right else 'closed'} height {height}"
    return Example(body_state_prompt(told, hands, height, style))
