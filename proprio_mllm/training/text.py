"""The text that the tiny tokenizer is trained on: the project's own prompts, answers and captions, from the shards."""

from __future__ import annotations

import numpy as np

from configs.schema.model import ModelConfig
from data.records import ACTIONS
from proprio_mllm.model.chat import render
from proprio_mllm.model.prompts import critic_prompt, looking, self_ask_prompt
from proprio_mllm.training.sources import BODY_RELATIVE, GROUNDING, Clips, Demos, Views

__all__ = ["corpus", "whole_words"]


def corpus(cfg: ModelConfig, views: Views, demos: Demos, clips: Clips, seed: int = 0, limit: int = 4000) -> list[str]:
    """Texts of every kind that the model will read or write.

    Args:
        cfg: prompt style.
        views: shards.
        demos: shards.
        clips: shards.
        seed: of the choice of rows.
        limit: rows per kind.
    """
    rng = np.random.default_rng(seed)
    texts = [caption for captions in clips.captions[:limit] for caption in captions]
    for index in _some(demos.split.train, limit, rng):
        example = demos.example(int(index), None)
        texts.append(render(example.messages))
    for index in _some(views.split.train, limit // 4, rng):
        row = views.row(int(index))
        pairs = [views.listing(row), *views.pairs(row, (*GROUNDING, *BODY_RELATIVE), 10, rng)]
        texts.append(render(looking(pairs, None, cfg.prompt)))
    texts.append(render(critic_prompt("pick up the mug", (), (), None, cfg.prompt)) + " yes no none")
    texts.append(render(self_ask_prompt("held", (), (), None, cfg.prompt)) + " open closed on off in lifted")
    return texts


def whole_words(views: Views) -> list[str]:
    """Words that get a token of their own: object types and action names."""
    return [*views.type_names, *ACTIONS]


def _some(indices: np.ndarray, limit: int, rng: np.random.Generator) -> np.ndarray:
    return indices if len(indices) <= limit else rng.choice(indices, limit, replace=False)
