"""`stage=base`: stands in for the pretraining that released Qwen2.5-VL weights bring, at the tiny size only.

Three parts, each needed (a small model trained on questions alone never binds words to image regions): dense, name-tied
pretraining of the vision tower on the simulator's truth; grounding questions packed per image and image-to-text listing;
decisions of whole episodes, with their pictures and in words alone, with judging questions about logs and phrases among them.
Its result is also the table row "Qwen2.5-VL-Ins" at this size. The paper has no such stage.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, Literal

import numpy as np
import torch
from torch import Tensor, nn

from configs.schema.train import BaseConfig
from proprio_mllm.model.batch import Batch, Collator, Example, ImageBatch, Movable
from proprio_mllm.model.dense import DenseHead, shown_shares
from proprio_mllm.model.modeling import ProprioMLLM
from proprio_mllm.model.prompts import looking
from proprio_mllm.training.asking import answer_shares
from proprio_mllm.training.judging import state_example
from proprio_mllm.training.loop import Objective, Parts
from proprio_mllm.training.phrases import phrase
from proprio_mllm.training.sources import CELL, GROUNDING, Clips, Demos, ViewRow, Views, asked_by
from proprio_mllm.training.turns import Turns
from proprio_mllm.training.words import WordBatch, WordsObjective

#: Views that take as long as an episode, in words or with pictures.
EPISODE_ROWS: Final = 4
#: Share of phrases among the judging questions.
PHRASES: Final = 0.1


class _WithDense(nn.Module):
    """Model and dense head as one module, so that one optimiser and one checkpoint hold both."""

    def __init__(self, model: ProprioMLLM, head: DenseHead) -> None:
        super().__init__()
        self.model = model
        self.head = head

    def forward(self, batch: _JointBatch) -> tuple[Tensor, dict[str, float]]:
        values: dict[str, float] = {}
        total: Tensor | None = None
        if batch.text is not None:
            out = self.model(batch.text)
            accuracy = out.correct / max(batch.text.out_of or out.supervised, 1)
            values |= {f"{batch.kind}_loss": float(out.loss.detach()), f"{batch.kind}_accuracy": accuracy}
            visual, total = out.visual, out.loss
        else:
            assert batch.images is not None
            visual = self.model.visual_tokens(batch.images)
        if batch.dense is not None:
            assert visual is not None
            dense, recall = self.head(visual, self.model.table, batch.dense)
            values |= {"dense_loss": float(dense.detach()), "dense_recall": recall}
            total = dense if total is None else total + batch.dense_weight * dense
        assert total is not None
        return total, values


_JointKind = Literal["look", "words", "plan", "judge"]


@dataclass(frozen=True, slots=True)
class _JointBatch(Movable):
    kind: Literal["dense", "look", "plan", "judge"]
    text: Batch | None
    images: ImageBatch | None
    dense: Tensor | None
    dense_weight: float


class _Base(Objective):
    """What both objectives share: the sources and the assembly of view batches."""

    def __init__(self, model: ProprioMLLM, head: DenseHead, views: Views, cfg: BaseConfig, key: str) -> None:
        self.module: nn.Module = _WithDense(model, head)
        self._model = model
        self.key = key
        self._views, self._cfg = views, cfg
        self._collator = Collator(model.processor, model.cfg)

    def loss(self, module: nn.Module, batch: _JointBatch, generator: torch.Generator) -> tuple[Tensor, Mapping[str, float]]:
        """Loss of one batch; nothing is drawn."""
        del generator
        return module(batch)

    def _view_batch(self, rng: np.random.Generator, size: int, questions: int) -> _JointBatch:
        rows = self._views.draw(rng, size)
        segmentation = torch.from_numpy(np.stack([row.segmentation for row in rows]))
        grid = segmentation.shape[1] // CELL, segmentation.shape[2] // CELL
        shares = shown_shares(segmentation, grid, len(self._views.type_names))
        if not questions:
            return _JointBatch("dense", None, self._collator.images([row.view for row in rows]), shares, 1.0)
        examples = []
        for row in rows:
            # the list comes last: its order, from left to right, would give away where things are
            examples.append(looking_around(self._views, row, questions, rng, listing=True))
        return _JointBatch("look", self._collator(examples), None, shares, self._cfg.dense_weight)


class DenseObjective(_Base):
    """Dense, name-tied pretraining: which types each visual token shows."""

    name = "base/dense"

    def batch(self, rng: np.random.Generator, size: int, kind: None = None) -> _JointBatch:
        """Views with their dense truth."""
        return self._view_batch(rng, size, 0)


class JointObjective(_Base):
    """Mixed batches: packed grounding questions and listing with the dense loss, decisions with pictures, episodes in words.

    Args:
        model: starts with the language model of stage `practice`.
        head: dense head.
        views: posed views.
        turns: decisions with pictures.
        demos: the rows that these come from, for judging questions.
        clips: captions.
        words: the objective of episodes in words.
        cfg: shares.
        key: of the checkpoint.
    """

    name = "base/joint"

    def __init__(
        self,
        model: ProprioMLLM,
        head: DenseHead,
        views: Views,
        turns: Turns,
        demos: Demos,
        clips: Clips,
        words: WordsObjective,
        cfg: BaseConfig,
        key: str,
    ) -> None:
        super().__init__(model, head, views, cfg, key)
        self._turns, self._demos, self._clips, self._words = turns, demos, clips, words

    def kind(self, rng: np.random.Generator) -> _JointKind:
        """Views, episodes in words, decisions, or judging questions and phrases."""
        if rng.random() >= self._cfg.plan_share:
            return "look"
        if rng.random() < self._cfg.text_share:
            return "words"
        return "plan" if rng.random() >= self._cfg.judge_share else "judge"

    def batch(self, rng: np.random.Generator, size: int, kind: _JointKind) -> _JointBatch | Parts:
        """A batch of a kind."""
        if kind == "look":
            return self._view_batch(rng, size, self._cfg.questions)
        if kind == "words":
            return self._words.batch(rng, max(1, size // EPISODE_ROWS))
        if kind == "plan":
            parts = self._turns.batch(rng, max(1, size // EPISODE_ROWS))
            return Parts(_JointBatch(kind, part, None, None, 0.0) for part in parts)
        examples = [
            phrase(self._clips, rng, self._demos.style) if rng.random() < PHRASES else state_example(self._demos, i, rng, None)
            for i in self._demos.draw(rng, size)
        ]
        return Parts(_JointBatch(kind, part, None, None, 0.0) for part in self._collator.in_parts(examples))

    def weight(self, batch: _JointBatch | Parts) -> float:
        """Tokens of the answers; views count alike, as most of their loss is dense."""
        if isinstance(batch, _JointBatch):
            return 1.0
        first = batch[0]
        return float(first.answers if isinstance(first, WordBatch) else first.text.out_of)

    def loss(
        self, module: nn.Module, batch: _JointBatch | WordBatch, generator: torch.Generator
    ) -> tuple[Tensor, Mapping[str, float]]:
        """Loss of one batch, or of one part of episodes in words; nothing is drawn."""
        if isinstance(batch, WordBatch):
            return self._words.loss(self._model, batch, generator)
        return super().loss(module, batch, generator)


def looking_around(
    views: Views,
    row: ViewRow,
    questions: int,
    rng: np.random.Generator,
    codes: Sequence[int] | None = None,
    listing: bool = False,
) -> Example:
    """Questions about the things in a view.

    Args:
        views: asks.
        row: the view.
        questions: most questions.
        rng: draws them.
        codes: motion tokens before the first question, or None.
        listing: whether the list of what is in view follows; it does where there is nothing to ask.
    """
    asked = views.asked(row, asked_by(views.cfg), questions, rng)
    pairs = [(one.question, one.answer) for one in asked]
    pairs += [views.listing(row)] if listing or not pairs else []
    return Example(looking(pairs, codes, views.style), (row.view,))


@torch.no_grad()
def grounding_accuracy(
    model: ProprioMLLM,
    views: Views,
    kinds: Sequence[str] = GROUNDING,
    limit: int = 200,
    seed: int = 0,
    tokens: Any = None,
) -> dict[str, float]:
    """Share of right answers about objects in held-out views, by kind, with the majority answer's share beside it.

    Args:
        model: in evaluation mode.
        views: source; only held-out rows are asked about.
        kinds: kinds of question.
        limit: number of views; each is asked one question of each kind.
        seed: of the choice of objects.
        tokens: motion tokenizer, for questions with proprioception; None asks without.
    """
    rng = np.random.default_rng(seed)
    result: dict[str, float] = {}
    rows = [views.row(i) for i in views.split.test[:limit]]
    for kind in kinds:
        asked: list[Example] = []
        answers: list[str] = []
        for row in rows:
            for one in views.asked(row, (kind,), 1, rng):
                motion = None if tokens is None else tokens.encode_window(row.motion)
                asked.append(Example(looking([(one.question, "")], motion, views.style), (row.view,)))
                answers.append(one.answer)
        if asked:
            result |= answer_shares(model, kind, asked, answers)
    result["asked_views"] = float(len(rows))
    return result
