"""Whole episodes in words: every decision of an episode is learnt in one pass over it.

The log of an episode is encoded once; each decision hangs beside it as a branch with what it was shown and the teacher's answer
(`proprio_mllm.model.branches`), so that every step is learnt from, those after mistakes too, and no mistake is imitated. The
paper starts from a language model that can read; this is what stands in for its pretraining.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, Final

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from proprio_mllm.model.batch import IGNORE, Movable
from proprio_mllm.model.branches import Branches, read_branches
from proprio_mllm.model.modeling import ProprioMLLM
from proprio_mllm.model.observing import LONGEST_LOG
from proprio_mllm.model.word_tokens import Tokens, first_word, tokens_of
from proprio_mllm.model.wording import WordEpisode
from proprio_mllm.training.loop import Objective, Parts

#: The episode of a seed.
Source = Callable[[int], WordEpisode]
#: Decisions of a row, and rows that are computed together.
_TURNS: Final = 6
_ROWS: Final = 8
#: Lengths of logs and of branches, words. Few lengths: kernels are prepared anew for every shape. What is longer is left out.
_LOGS: Final = (128, LONGEST_LOG)
_BRANCHES: Final = (48, 96)


@dataclass(frozen=True, slots=True)
class _Row:
    """Decisions of one episode: the log's tokens, (anchor, tokens, first token of the answer) of each branch, tokens a word."""

    log: list[int]
    branches: list[tuple[int, list[int], int]]
    length: float

    @property
    def shape(self) -> tuple[int, int]:
        """Lengths of the log and of a branch, padded."""
        width = max(len(tokens) for _, tokens, _ in self.branches)
        return _bucket(len(self.log), _LOGS, self.length), _bucket(width, _BRANCHES, self.length)


@dataclass(frozen=True, slots=True)
class WordBatch(Movable):
    """Rows of log and branches.

    Attributes:
        input_ids: (B, S).
        position_ids: (B, S).
        labels: (B, S), the token that each position has to predict, -100 where nothing is learnt.
        layout: where the branches are.
        answers: answer tokens of the whole step, of which these rows are a part.
        decisions: decisions of the whole step.
        parts: parts of the step.
    """

    input_ids: Tensor
    position_ids: Tensor
    labels: Tensor
    layout: Branches
    answers: int = 1
    decisions: int = 1
    parts: int = 1


def rows_of(episode: WordEpisode, words: Tokens) -> list[_Row]:
    """An episode's rows, each of some decisions of similar length."""
    log = words.tokens(episode.prefix)
    branches: list[tuple[int, list[int], int]] = []
    for turn in episode.turns:
        now = words.tokens(turn.now)
        tokens = [*now, *words.tokens(turn.answer)]
        if turn.answer and len(tokens) <= _BRANCHES[-1] * words.length and len(log) <= LONGEST_LOG * words.length:
            branches.append((len(log), tokens, len(now)))
        log += words.tokens(turn.taken)
    rows: list[_Row] = []
    for low, high in pairwise((0, *_BRANCHES)):
        same = [branch for branch in branches if low < len(branch[1]) / words.length <= high]
        count = -(-len(same) // _TURNS)
        cuts = [len(same) * row // count for row in range(count + 1)] if count else [0]
        rows += [_Row(log[: same[end - 1][0]], same[first:end], words.length) for first, end in pairwise(cuts)]
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


def _bucket(size: int, sizes: Sequence[int], length: float) -> int:
    return next(tokens for one in sizes if (tokens := round(one * length)) >= size)


@dataclass(frozen=True, slots=True)
class WordsLoss:
    """Of one batch.

    Attributes:
        answers: summed cross-entropy of the answers' tokens.
        reading: mean cross-entropy of the tokens that are read; 0 where it was not asked for.
        right: (B, S), learnt positions that were predicted right.
    """

    answers: Tensor
    reading: Tensor
    right: Tensor


def words_loss(model: ProprioMLLM, batch: WordBatch, reading: bool = False) -> WordsLoss:
    """Losses of a batch.

    Args:
        model: the model.
        batch: rows of log and branches.
        reading: whether to predict what is read, too.
    """
    core: Any = model.core
    padding = batch.input_ids == int(model.processor.tokenizer.pad_token_id)
    hidden = read_branches(core.model.language_model, batch.input_ids, batch.position_ids, batch.layout, ~padding)  # (B, S, D)
    first = first_word(model.processor.tokenizer)
    table = core.lm_head.weight[first:]  # words are the last tokens that were added, and all that is ever predicted here
    chosen = batch.labels != IGNORE
    picked = batch.labels[chosen] - first
    logits = functional.linear(hidden[chosen], table).float()  # (targets, words)
    right = torch.zeros_like(chosen)
    right[chosen] = logits.detach().argmax(-1) == picked
    read = logits.new_zeros(())
    if reading:
        following = batch.input_ids.roll(-1, 1)
        told = ~padding & ~padding.roll(-1, 1) & ~chosen
        told[:, batch.layout.log - 1 :: _width(batch)] = False  # the last position of the log and of each branch
        read = functional.cross_entropy(functional.linear(hidden[told], table).float(), following[told] - first)
    return WordsLoss(functional.cross_entropy(logits, picked, reduction="sum"), read, right)


def _width(batch: WordBatch) -> int:
    """Tokens of a branch, W."""
    return (batch.input_ids.shape[1] - batch.layout.log) // batch.layout.anchors.shape[1]


def mixed(rest: Source, *others: tuple[float, Source]) -> Source:
    """Episodes of several sources, each of some with a share, the rest of one."""

    def episode(seed: int) -> WordEpisode:
        draw = seed % 1000 / 1000
        for share, source in others:
            if draw < share:
                return source(seed)
            draw -= share
        return rest(seed)

    return episode


class WordsObjective(Objective):
    """Episodes drawn anew in every batch.

    Args:
        model: all of its language model trains.
        episode: the episode of a seed.
        key: of the checkpoint.
        reading: weight of predicting what is read.
    """

    name = "words"

    def __init__(self, model: ProprioMLLM, episode: Source, key: str, reading: float = 0.0) -> None:
        self.module: nn.Module = model
        self._episode, self.key, self._reading = episode, key, reading
        self._tokenizer = model.processor.tokenizer
        self._pad = int(model.processor.tokenizer.pad_token_id)

    def batch(self, rng: np.random.Generator, size: int, kind: None = None) -> Parts:
        """Rows of `size` episodes in parts of few shapes; what does not fill a part is left out where others do."""
        rows: list[_Row] = []
        for _ in range(size):
            episode = self._episode(int(rng.integers(2**62)))
            rows += rows_of(episode, tokens_of(self._tokenizer, rng))
        shapes: dict[tuple[int, int], list[_Row]] = {}
        for row in rows:
            shapes.setdefault(row.shape, []).append(row)
        made = [
            collate(same[first : first + _ROWS], self._pad)
            for _, same in sorted(shapes.items())
            for first in range(0, len(same), _ROWS)
            if len(same) - first >= _ROWS or first == 0
        ]
        answers = sum(int((part.labels != IGNORE).sum()) for part in made)
        decisions = sum(int(_learnt(part).any(-1).sum()) for part in made)
        return Parts(replace(part, answers=answers, decisions=decisions, parts=len(made)) for part in made)

    def weight(self, batch: Parts) -> float:
        """Tokens of the answers."""
        return float(batch[0].answers)

    def loss(self, module: nn.Module, batch: WordBatch, generator: torch.Generator) -> tuple[Tensor, Mapping[str, float]]:
        """A part's contribution to the mean over the answers' tokens, and to the share of decisions that are all right."""
        del generator
        made: Any = module
        losses = words_loss(made, batch, self._reading > 0.0)
        answers, reading = losses.answers / max(batch.answers, 1), losses.reading / batch.parts
        learnt = _learnt(batch)
        missed = learnt & ~losses.right[:, batch.layout.log :].unflatten(1, (_TURNS, -1))
        exact = int((learnt.any(-1) & ~missed.any(-1)).sum())
        values = {
            "answers": float(answers.detach()),
            "reading": float(reading.detach()),
            "exact": exact / max(batch.decisions, 1),
            "decisions": float(learnt.any(-1).sum()),
        }
        return answers + self._reading * reading, values


def _learnt(batch: WordBatch) -> Tensor:
    """(B, N, W), which positions of each branch have something to predict."""
    return (batch.labels != IGNORE)[:, batch.layout.log :].unflatten(1, (_TURNS, -1))


@torch.no_grad()
def held_out_metrics(model: ProprioMLLM, sources: Mapping[str, Source], count: int = 64) -> dict[str, float]:
    """Loss and exactness on episodes whose seeds training does not draw: negative ones.

    Args:
        model: the model.
        sources: episodes by the ending of the metrics' names.
        count: episodes of each.
    """
    found: dict[str, float] = {}
    for ending, episode in sources.items():
        objective = WordsObjective(model, lambda seed, made=episode: made(-1 - seed % 2**31), "")
        parts = objective.batch(np.random.default_rng(0), count)
        values = [objective.loss(model, part.to(model.device), torch.Generator())[1] for part in parts]
        found[f"held_out_loss{ending}"] = sum(value["answers"] for value in values)
        found[f"held_out_exact{ending}"] = sum(value["exact"] for value in values)
    return found
