"""Branches beside a log: each decision is predicted as if the log up to it and its own branch were all there is."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from configs.compose import compose
from configs.schema.train import TrainConfig
from configs.validate import build
from proprio_mllm.evaluation.lessons import Lessons
from proprio_mllm.model.branches import read_branches
from proprio_mllm.model.building import build_model, build_processor
from proprio_mllm.model.modeling import ProprioMLLM
from proprio_mllm.model.word_tokens import EnglishTokens, WordTokens, add_word_tokens, tokens_of
from proprio_mllm.training.pipeline import base_model_config
from proprio_mllm.training.words import WordsObjective, collate, rows_of


@pytest.fixture(scope="module")
def model() -> ProprioMLLM:
    cfg = base_model_config(build(TrainConfig, compose("train", ["stage=words"])).model)
    words = Lessons().words()
    processor = build_processor(cfg, [" ".join(words)] * 2)
    add_word_tokens(processor.tokenizer, words)
    return build_model(cfg, processor, 3).eval()


def test_a_branch_reads_what_text_would(model: ProprioMLLM) -> None:
    episode = Lessons().episode(7)
    rows = rows_of(episode, WordTokens(model.processor.tokenizer))
    text = model.core.model.language_model
    for row in rows:
        batch = collate([row], 0)
        with torch.no_grad():
            packed = read_branches(text, batch.input_ids, batch.position_ids, batch.layout, batch.input_ids != 0)[0]
        log, width = batch.layout.log, (batch.input_ids.shape[1] - batch.layout.log) // batch.layout.anchors.shape[1]
        for index, (anchor, tokens, _) in enumerate(row.branches):
            with torch.no_grad():
                plain = text(input_ids=torch.tensor([[*row.log[:anchor], *tokens]]), use_cache=False)[0][0, anchor:]
            start = log + index * width
            torch.testing.assert_close(packed[start : start + len(tokens)], plain, atol=2e-5, rtol=1e-4)


def test_a_branch_is_learnt_from_as_text_would_be(model: ProprioMLLM) -> None:
    text, words = model.core.model.language_model, WordTokens(model.processor.tokenizer)
    rows = [row for seed in (7, 8) for row in rows_of(Lessons().episode(seed), words)][:4]  # padding, and rows without branches
    batch = collate(rows, 0)
    width = (batch.labels.shape[1] - batch.layout.log) // batch.layout.anchors.shape[1]
    packed = plain = torch.zeros(())
    hidden = read_branches(text, batch.input_ids, batch.position_ids, batch.layout, batch.input_ids != 0)
    for number, row in enumerate(rows):
        for index, (anchor, tokens, _) in enumerate(row.branches):
            start = batch.layout.log + index * width
            packed = packed + hidden[number, start : start + len(tokens), 0].sum()
            plain = (
                plain + text(input_ids=torch.tensor([[*row.log[:anchor], *tokens]]), use_cache=False)[0][0, anchor:, 0].sum()
            )
    parameters = [one for one in text.parameters() if one.requires_grad]
    for one, other in zip(torch.autograd.grad(packed, parameters), torch.autograd.grad(plain, parameters), strict=True):
        torch.testing.assert_close(one, other, atol=2e-4, rtol=1e-3)


def test_every_learnt_decision_is_in_one_row(model: ProprioMLLM) -> None:
    episode = Lessons().episode(11)
    words = WordTokens(model.processor.tokenizer)
    branches = [branch for row in rows_of(episode, words) for branch in row.branches]
    expected = [words.tokens((*turn.now, *turn.answer)) for turn in episode.turns]
    assert sorted(tokens for _, tokens, _ in branches) == sorted(tokens for tokens in expected if len(tokens) <= 96)
    assert len(branches) > 2


@pytest.mark.parametrize("spelt", [False, True], ids=["words", "spelt"])
def test_few_decisions_are_too_long_to_be_learnt(model: ProprioMLLM, spelt: bool) -> None:
    tokenizer = build_processor(model.cfg, [" ".join(Lessons().words())] * 2).tokenizer if spelt else model.processor.tokenizer
    words, episodes = tokens_of(tokenizer), [Lessons().episode(seed) for seed in range(60)]
    assert isinstance(words, EnglishTokens if spelt else WordTokens)
    learnt = sum(len(row.branches) for one in episodes for row in rows_of(one, words))
    assert learnt > 0.95 * sum(len(one.turns) for one in episodes)


def test_only_answers_are_learnt(model: ProprioMLLM) -> None:
    objective = WordsObjective(model, Lessons().episode, "")
    for part in objective.batch(np.random.default_rng(0), 6):
        for ids, labels in zip(part.input_ids, part.labels, strict=True):
            places = (labels != -100).nonzero()[:, 0]
            assert bool((places >= part.layout.log).all())
            assert torch.equal(labels[places], ids[places + 1])


def test_an_answer_is_learnt_from_its_first_word_to_its_last(model: ProprioMLLM) -> None:
    for row in rows_of(Lessons().episode(7), WordTokens(model.processor.tokenizer)):
        batch = collate([row], 0)
        width = (batch.labels.shape[1] - batch.layout.log) // batch.layout.anchors.shape[1]
        for index, (_, tokens, answer) in enumerate(row.branches):
            labels = batch.labels[0, batch.layout.log + index * width :][:width]
            assert labels[labels != -100].tolist() == tokens[answer:]
            assert int((labels != -100).nonzero()[0]) == answer - 1


def test_the_batch_depends_on_its_generator_alone(model: ProprioMLLM) -> None:
    objective = WordsObjective(model, Lessons().episode, "")
    one, two, other = (objective.batch(np.random.default_rng(seed), 4) for seed in (1, 1, 2))
    assert all(torch.equal(a.input_ids, b.input_ids) for a, b in zip(one, two, strict=True))
    assert one[0].input_ids.shape != other[0].input_ids.shape or not torch.equal(one[0].input_ids, other[0].input_ids)
