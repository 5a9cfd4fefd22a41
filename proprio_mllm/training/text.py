"""What the tiny model starts from: the text that its tokenizer is trained on, rows of type names that mean their words, and
rows of places that are in order.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Final

import numpy as np
import torch
from torch.nn import functional

from configs.schema.model import ModelConfig
from interface.actions import ACTIONS
from proprio_mllm.model.chat import render
from proprio_mllm.model.modeling import ProprioMLLM
from proprio_mllm.model.prompts import looking, self_ask_prompt
from proprio_mllm.model.word_tokens import tokens_of
from proprio_mllm.model.wording import MARKERS, PLACE_SCALES, name_words
from proprio_mllm.training.phrases import phrase
from proprio_mllm.training.sources import BODY_RELATIVE, GROUNDING, Clips, Views

#: Waves over a scale of values.
_WAVES: Final = torch.tensor([0.25, 0.5, 1.0, 2.0, 4.0])


def corpus(
    cfg: ModelConfig,
    views: Views,
    clips: Clips,
    seed: int = 0,
    limit: int = 4000,
) -> list[str]:
    """Texts of every kind that the model will read or write beside episodes, whose words are tokens already.

    Args:
        cfg: prompt style.
        views: shards.
        clips: shards.
        seed: of the choice of rows.
        limit: rows per kind.
    """
    rng = np.random.default_rng(seed)
    texts = [caption for captions in clips.captions[:limit] for caption in captions]
    texts.extend(render(phrase(clips, rng, cfg.prompt).messages) for _ in range(limit // 4))
    for index in _some(views.split.train, limit // 4, rng):
        row = views.row(int(index))
        asked = views.asked(row, (*GROUNDING, *BODY_RELATIVE), 10, rng)
        pairs = [views.listing(row), *((one.question, one.answer) for one in asked)]
        texts.append(render(looking(pairs, None, cfg.prompt)))
    texts.append(render(self_ask_prompt("held", (), (), None, cfg.prompt)) + " none open closed on off in lifted")
    return texts


def whole_words(views: Views) -> list[str]:
    """Words that get a token of their own: object types and action names."""
    return [*views.type_names, *ACTIONS]


@torch.no_grad()
def start_from_words(model: ProprioMLLM, names: Sequence[str]) -> None:
    """Lets the embedding of each type name start as that of its words: `PaperTowelRoll` as `paper`, `towel`, `roll`.

    What an instruction calls a thing and the thing's id then resemble each other before any training, as the two do in a
    pretrained model. The sum over n words is divided by √n, which keeps the scale of a fresh row.

    Args:
        model: with fresh weights.
        names: object types, each a token of its own.

    Raises:
        ValueError: when a name is not one token.
    """
    embeddings: Any = model.core.get_input_embeddings()
    tokenizer, rows = model.processor.tokenizer, embeddings.weight
    spelt = tokens_of(tokenizer)
    for name in names:
        own = tokenizer(name, add_special_tokens=False).input_ids
        if len(own) != 1:
            raise ValueError(f"type {name!r} is {len(own)} tokens; it must be one")
        words = spelt.tokens(name_words(name))
        rows[own[0]] = rows[words].sum(0) / len(words) ** 0.5


@torch.no_grad()
def order_places(model: ProprioMLLM, seed: int = 0) -> None:
    """Lets the rows of the words of places start so that near values resemble each other, as numbers do in a pretrained model.

    A row is a direction that all of a scale share, and waves over the scale, the longest four times as long as it. Rows that
    are never learnt all come to look the same: without this a language model cannot tell 1.1 arm lengths from 1.3.

    Args:
        model: has been given the rows of a language model that has learnt; theirs is the length of these.
        seed: of the directions.
    """
    embeddings: Any = model.core.get_input_embeddings()
    tokens, rows = tokens_of(model.processor.tokenizer), embeddings.weight
    generator = torch.Generator().manual_seed(seed)
    length = rows[tokens.tokens(MARKERS)].norm(dim=1).median()
    for scale in PLACE_SCALES:
        turns = torch.linspace(0.0, 2.0 * math.pi, len(scale))[:, None] * _WAVES
        values = torch.cat([torch.ones(len(scale), 1), turns.cos(), turns.sin()], dim=1)
        directions = functional.normalize(torch.randn(values.shape[1], rows.shape[1], generator=generator), dim=1)
        for word, row in zip(scale, functional.normalize(values @ directions, dim=1), strict=True):
            if len(own := tokens.tokens([word])) == 1:  # a pretrained tokenizer spells them, and knows numbers
                rows[own[0]] = length * row.to(rows)


@torch.no_grad()
def adopt(model: ProprioMLLM, source: ProprioMLLM) -> None:
    """Takes over a language model: its layers, and its rows for every token that both tokenizers have.

    Raises:
        ValueError: when the two are of different shapes.
    """
    own, theirs = model.core.model.language_model.state_dict(), source.core.model.language_model.state_dict()
    for name, tensor in theirs.items():
        if name == "embed_tokens.weight":
            continue
        if name not in own or own[name].shape != tensor.shape:
            raise ValueError(f"{name} is {tuple(tensor.shape)} in the language model that is to be taken over, and not so here")
        own[name].copy_(tensor)
    mine, other = model.processor.tokenizer.get_vocab(), source.processor.tokenizer.get_vocab()
    shared = [(mine[text], other[text]) for text in mine.keys() & other.keys()]
    to, at = (torch.tensor(column) for column in zip(*shared, strict=True))
    pairs: list[tuple[Any, Any]] = [(model.core.get_input_embeddings(), source.core.get_input_embeddings())]
    pairs += [(model.core.lm_head, source.core.lm_head)]  # the same where they are tied
    for rows, given in pairs:
        rows.weight[to] = given.weight[at]


def _some(indices: np.ndarray, limit: int, rng: np.random.Generator) -> np.ndarray:
    return indices if len(indices) <= limit else rng.choice(indices, limit, replace=False)
