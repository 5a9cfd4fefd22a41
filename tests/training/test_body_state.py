"""What the body feels: the state of hands and pelvis in words, and that the tokenizer is told to keep it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from configs.schema.model import ModelConfig
from data.motion import HAND_OPENING, N_FEATURES, PELVIS_HEIGHT
from proprio_mllm.training.alignment import body_state
from proprio_mllm.training.motion_stage import FEATURE_BIAS, MotionWindows
from proprio_mllm.training.phrases import phrase
from proprio_mllm.training.sources import Clips


@pytest.mark.parametrize(
    ("openings", "height", "expected"),
    [
        ((1.0, 1.0), 0.98, ("left right", "1.00")),
        ((0.5, 1.0), 0.851, ("right", "0.85")),
        ((0.98, 0.93), 0.576, ("left", "0.60")),
        ((0.2, 0.0), 0.45, ("none", "0.45")),
    ],
)
def test_the_last_frame_in_words(openings: tuple[float, float], height: float, expected: tuple[str, str]) -> None:
    motion = np.full((8, N_FEATURES), 0.3, dtype=np.float32)
    motion[-1, HAND_OPENING], motion[-1, PELVIS_HEIGHT] = openings, height
    assert body_state(motion) == expected


def test_hands_and_height_weigh_more_than_single_coordinates(shards: Path, cfg: ModelConfig) -> None:
    clips = Clips(shards / "clips")
    mean, scale = MotionWindows(clips, [], cfg.motion.window).statistics()
    frames = np.concatenate([clips.motions[int(i)] for i in clips.split.train])
    assert np.allclose(mean, frames.mean(axis=0), atol=1e-5)
    assert np.allclose((scale * FEATURE_BIAS)[42:], frames.std(axis=0)[42:], atol=1e-4)
    assert np.allclose(scale[:42], np.sqrt(frames.var(axis=0)[:42].mean()), atol=1e-4), "one scale for all bodies' coordinates"
    assert (FEATURE_BIAS[HAND_OPENING] > FEATURE_BIAS[PELVIS_HEIGHT]).all()
    assert FEATURE_BIAS[PELVIS_HEIGHT] > FEATURE_BIAS[0]


def test_phrases_teach_the_words_without_motion(shards: Path, cfg: ModelConfig) -> None:
    clips, rng = Clips(shards / "clips"), np.random.default_rng(0)
    drawn = [phrase(clips, rng, "terse") for _ in range(60)]
    assert not any(example.views or "<motion" in message.text for example in drawn for message in example.messages)
    captions = {caption for index in clips.split.train for caption in clips.captions[int(index)]}
    told = [example for example in drawn if example.messages[1].text != "say "]
    assert 15 < len(told) < 45
    assert all(example.messages[-1].text in captions for example in drawn if example not in told)
    for example in told:
        words = example.messages[1].text.split()
        opened = [hand for hand in ("left", "right") if words[words.index(hand) + 1] == "open"]
        assert example.messages[2].text == (" ".join(opened) or "none")
        assert example.messages[-1].text == words[words.index("height") + 1]
