"""Decisions of whole episodes with what was seen and felt: logs of the simulator in the sequence that planners read.

A row of `demos` shards is the moment before a step. The teacher's answer to it, and the words of its log, come from the same
source as in stage `words`; its picture and its motion stand before the answer, as they do at run time
(`proprio_mllm.model.observing`). A batch holds several decisions of each of its episodes, so that a log is read once for all of
them (`Collator.beside`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray

from proprio_mllm.model.batch import Batch, Collator, Example
from proprio_mllm.model.modeling import ProprioMLLM
from proprio_mllm.model.motion_tokenizer import MotionTokenizer
from proprio_mllm.model.observing import LONGEST_LOG, pictured_turn
from proprio_mllm.model.placing import finder_of
from proprio_mllm.model.word_tokens import tokens_of
from proprio_mllm.model.wording import WordEpisode
from proprio_mllm.training.sources import Demos

#: Decisions of an episode in a batch, and episodes that are computed together.
TURNS: Final = 6
_EPISODES: Final = 4
#: How often a decision at which an arm would be tried is drawn for one at which words tell what to do.
_TRIED: Final = 3.0


class Turns:
    """Decisions with pictures, by row of the demonstrations that they come from.

    Args:
        model: gives the tokenizer.
        demos: the rows, in the order of their folders.
        episodes: the teacher's answers to every episode of them; the k-th turn is the k-th row's.
        tokens: the motion tokenizer; None for models without proprioception.

    Attributes:
        episodes: those that are learnt from.
        train: rows that have an answer and are learnt from.
        test: those that are held out.
        codes: (N, T / stride) motion tokens of all rows, None without proprioception.
    """

    def __init__(
        self,
        model: ProprioMLLM,
        demos: Demos,
        episodes: Sequence[WordEpisode],
        tokens: MotionTokenizer | None = None,
    ) -> None:
        self._model, self._demos = model, demos
        self.codes = None if tokens is None else demos.tokens(tokens)
        self._told: dict[int, tuple[list[int], list[int], list[int]]] = {}
        #: What of an answer the point map says.
        self._places: dict[int, slice] = {}
        placed = finder_of(model) is not None
        weights = np.ones(len(demos.motions))
        for start, episode in zip(demos.starts, episodes, strict=True):
            words = tokens_of(model.processor.tokenizer)  # unknown words are an episode's own
            log = words.tokens(episode.prefix)
            for number, turn in enumerate(episode.turns):
                if len(log) <= LONGEST_LOG * words.length:  # as in stage `words`
                    self._told[start + number] = (list(log), words.tokens(turn.now), words.tokens(turn.answer))
                    if placed and "at" in turn.answer:
                        ends = (turn.answer[: turn.answer.index(word)] for word in ("at", "do"))
                        self._places[start + number] = slice(*(len(words.tokens(part)) for part in ends))
                log += words.tokens(turn.taken)
                weights[start + number] = _TRIED if turn.tries else 1.0
        rows = np.array(sorted(self._told), dtype=np.int64)
        self.episodes = [one for start, one in zip(demos.starts, episodes, strict=True) if start in demos.split.train]
        self.train, self.test = np.intersect1d(rows, demos.split.train), np.intersect1d(rows, demos.split.test)
        self._collator = Collator(model.processor, model.cfg)
        #: Training rows of each episode.
        ends = np.searchsorted(self.train, [*demos.starts[1:], len(weights)])
        self._episodes = [rows for rows in np.split(self.train, ends[:-1]) if len(rows)]
        #: How often each of them is drawn, relative to the others.
        self._weights = [weights[rows] for rows in self._episodes]

    def draw(self, rng: np.random.Generator, size: int) -> list[Example]:
        """Training decisions."""
        return [self.example(int(row)) for row in rng.choice(self.train, size)]

    def batch(self, rng: np.random.Generator, episodes: int) -> tuple[Batch, ...]:
        """Training decisions of some episodes, longer ones more often, and tries of an arm, in parts of similar length."""
        shares = np.array([weights.sum() for weights in self._weights])
        drawn: list[NDArray[np.int64]] = []
        for i in rng.choice(len(shares), episodes, p=shares / shares.sum()):
            rows = self._episodes[i]
            drawn.append(np.sort(rng.choice(rows, TURNS, replace=len(rows) < TURNS, p=self._weights[i] / shares[i])))
        drawn.sort(key=lambda rows: len(self._told[rows[-1]][0]))
        parts: list[Batch] = []
        for some in (drawn[first : first + _EPISODES] for first in range(0, episodes, _EPISODES)):
            rows = [[self.example(int(row), len(self._told[row][0])) for row in of_one] for of_one in some]
            parts.append(self._collator.beside([self._told[of_one[-1]][0] for of_one in some], rows))
        whole = sum(part.supervised for part in parts)
        return tuple(replace(part, out_of=whole) for part in parts)

    def example(self, row: int, read: int = 0) -> Example:
        """The decision of a row, without the first tokens of its log where they have been read."""
        log, now, answer = self._told[row]
        codes = None if self.codes is None else self.codes[row].tolist()
        view, told = self._demos.view(self._demos.reader[row]), self._places.get(row, slice(0))
        return pictured_turn(self._model, log, now, view, codes, answer, read, told)


@torch.no_grad()
def turn_accuracy(model: ProprioMLLM, turns: Turns, limit: int = 200, size: int = 8) -> dict[str, float]:
    """Share of the words of held-out answers that are the likeliest after the right ones before them, and of whole answers."""
    collator = Collator(model.processor, model.cfg)
    rows: NDArray[np.int64] = turns.test[:: max(1, len(turns.test) // limit)][:limit]
    right = words = whole = 0
    for first in range(0, len(rows), size):
        for row in rows[first : first + size]:
            out = model(collator([turns.example(int(row))]).to(model.device))
            right, words, whole = right + out.correct, words + out.supervised, whole + (out.correct == out.supervised)
    return {"turn_words": right / max(words, 1), "turn_exact": whole / max(len(rows), 1), "turns": float(len(rows))}
