"""Whole episodes in words: every decision of an episode is learnt in one pass over it.

The log of an episode is encoded once; each decision hangs beside it as a branch with what it was shown and the teacher's answer
(`proprio_mllm.model.branches`), so that every step is learnt from, those after mistakes too, and no mistake is imitated. The
paper starts from a language model that can read; this is what stands in for its pretraining.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Final

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from proprio_mllm.model.batch import IGNORE, Movable
from proprio_mllm.model.branches import Branches, with_branches
from proprio_mllm.model.modeling import ProprioMLLM
from proprio_mllm.model.word_tokens import WordTokens
from proprio_mllm.model.wording import WordEpisode

__all__ = ["Lessons", "WordBatch", "WordsObjective", "collate", "held_out", "rows_of", "words_loss"]

#: The episode of a seed.
Lessons = Callable[[int], WordEpisode]
#: Decisions of a row, and rows that are computed together.
_TURNS: Final = 6
_ROWS: Final = 8
#: Lengths of logs and of branches, tokens. Few lengths: kernels are prepared anew for every shape. What is longer is left out.
_LOGS: Final = (128, 256)
_BRANCHES: Final = (40, 72)


@dataclass(frozen=True, slots=True)
class _Row:
    """Decisions of one episode: the log's tokens, and (anchor, tokens, first token of the answer) of each branch."""

    log: list[int]
    branches: list[tuple[int, list[int], int]]

    @property
    def shape(self) -> tuple[int, int]:
        """Lengths of the log and of a branch, padded."""
        width = max(len(tokens) for _, tokens, _ in self.branches)
        return _bucket(len(self.log), _LOGS), _bucket(width, _BRANCHES)


@dataclass(frozen=True, slots=True)
class WordBatch(Movable):
    """Rows of log and branches.

    Attributes:
        input_ids: (B, S).
        position_ids: (B, S).
        labels: (B, S), the token that each position has to predict, -100 where nothing is learnt.
        layout: where the branches are.
    """

    input_ids: Tensor
    position_ids: Tensor
    labels: Tensor
    layout: Branches


def rows_of(episode: WordEpisode, words: WordTokens) -> list[_Row]:
    """An episode's rows, each of some decisions of similar length."""
    log = words.tokens(episode.prefix)
    branches: list[tuple[int, list[int], int]] = []
    for turn in episode.turns:
        now = words.tokens(turn.now)
        tokens = [*now, *words.tokens(turn.answer)]
        if turn.answer and len(tokens) <= _BRANCHES[-1] and len(log) <= _LOGS[-1]:
            branches.append((len(log), tokens, len(now)))
        log += words.tokens(turn.taken)
    rows: list[_Row] = []
    for low, high in pairwise((0, *_BRANCHES)):
        same = [branch for branch in branches if low < len(branch[1]) <= high]
        count = -(-len(same) // _TURNS)
        cuts = [len(same) * row // count for row in range(count + 1)] if count else [0]
        rows += [_Row(log[: same[end - 1][0]], same[first:end]) for first, end in pairwise(cuts)]
    return rows


def collate(rows: Sequence[_Row], pad: int) -> WordBatch:
    """One batch of rows, `_ROWS` of them: where there are fewer, the rest is padding."""
    log, width = (max(sizes) for sizes in zip(*(row.shape for row in rows), strict=True))
    size = log + _TURNS * width
    ids = np.full((_ROWS, size), pad)
    places = np.zeros((_ROWS, size), dtype=np.int64)
    labels = np.full((_ROWS, size), IGNORE)
    anchors = np.ones((_ROWS, _TURNS), dtype=np.int64)
    for number, row in enumerate(rows):
        ids[number, : len(row.log)] = row.log
        places[number, :log] = np.arange(log)
        for index, (anchor, tokens, answer) in enumerate(row.branches):
            start = log + index * width
            ids[number, start : start + len(tokens)] = tokens
            places[number, start : start + width] = anchor + np.arange(width)
            labels[number, start + answer - 1 : start + len(tokens) - 1] = tokens[answer:]
            anchors[number, index] = anchor
    layout = Branches(log, torch.from_numpy(anchors))
    return WordBatch(torch.from_numpy(ids), torch.from_numpy(places), torch.from_numpy(labels), layout)


def _bucket(size: int, sizes: Sequence[int]) -> int:
    return next(one for one in sizes if one >= size)


def words_loss(model: ProprioMLLM, batch: WordBatch) -> tuple[Tensor, int, int, Tensor]:
    """Summed cross-entropy, learnt tokens, those predicted right, and which positions (B, S) were right."""
    core: Any = model.core
    text: Any = core.model.language_model
    with with_branches(text):
        hidden = text(
            input_ids=batch.input_ids,
            attention_mask={"full_attention": batch.layout},
            position_ids=batch.position_ids,
            use_cache=False,
        )[0]  # (B, S, D)
    chosen = batch.labels != IGNORE
    picked = batch.labels[chosen]
    logits = core.lm_head(hidden[chosen]).float()  # (targets, V)
    right = logits.detach().argmax(-1) == picked
    found = torch.zeros_like(chosen)
    found[chosen] = right
    return functional.cross_entropy(logits, picked, reduction="sum"), int(picked.numel()), int(right.sum()), found


class WordsObjective:
    """Episodes drawn anew in every batch.

    Args:
        model: all of its language model trains.
        lessons: the source of episodes.
        key: of the checkpoint.
    """

    name = "words"

    def __init__(self, model: ProprioMLLM, lessons: Lessons, key: str) -> None:
        self.model, self._lessons, self.key = model, lessons, key
        self._pad = int(model.processor.tokenizer.pad_token_id)

    @property
    def module(self) -> nn.Module:
        """The whole model."""
        return self.model

    def batch(self, rng: np.random.Generator, size: int) -> tuple[WordBatch, ...]:
        """Rows of `size` episodes in parts of few shapes; what does not fill a part is left out where others do."""
        rows: list[_Row] = []
        for _ in range(size):
            episode = self._lessons(int(rng.integers(2**62)))
            rows += rows_of(episode, WordTokens(self.model.processor.tokenizer, rng))
        shapes: dict[tuple[int, int], list[_Row]] = {}
        for row in rows:
            shapes.setdefault(row.shape, []).append(row)
        return tuple(
            collate(same[first : first + _ROWS], self._pad)
            for _, same in sorted(shapes.items())
            for first in range(0, len(same), _ROWS)
            if len(same) - first >= _ROWS or first == 0
        )

    def loss(
        self, module: nn.Module, batch: tuple[WordBatch, ...], generator: torch.Generator
    ) -> tuple[Tensor, Mapping[str, float]]:
        """Mean over the learnt tokens, and the share of decisions whose tokens are all right."""
        del generator
        made: Any = module
        total, count, right, whole, decisions = torch.zeros(()), 0, 0, 0, 0
        for part in batch:
            loss, tokens, correct, found = words_loss(made, part)
            total, count, right = total + loss, count + tokens, right + correct
            missed = ((part.labels != IGNORE) & ~found)[:, part.layout.log :].unflatten(1, (_TURNS, -1)).any(-1)
            there = (part.labels != IGNORE)[:, part.layout.log :].unflatten(1, (_TURNS, -1)).any(-1)
            whole, decisions = whole + int((there & ~missed).sum()), decisions + int(there.sum())
        values = {"accuracy": right / max(count, 1), "exact": whole / max(decisions, 1), "decisions": float(decisions)}
        return total / max(count, 1), values


@torch.no_grad()
def held_out(model: ProprioMLLM, lessons: Lessons, episodes: int = 64) -> dict[str, float]:
    """Exactness on episodes whose seeds training does not draw: negative ones."""
    objective = WordsObjective(model, lambda seed: lessons(-1 - seed % 2**31), "")
    batch = objective.batch(np.random.default_rng(0), episodes)
    loss, values = objective.loss(model, batch, torch.Generator())
    return {"held_out_loss": float(loss), "held_out_exact": values["exact"], "held_out_accuracy": values["accuracy"]}
