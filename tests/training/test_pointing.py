"""The pointing head is taught by where things are, and its loss is that of the attention that the model computes."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from configs.schema.model import ModelConfig
from proprio_mllm.model.batch import Batch, Collator
from proprio_mllm.model.building import build_model, build_processor
from proprio_mllm.model.chat import render
from proprio_mllm.model.modeling import ProprioMLLM
from proprio_mllm.model.word_tokens import WordTokens, add_word_tokens
from proprio_mllm.model.wording import id_words
from proprio_mllm.training.base import looking_around
from proprio_mllm.training.pointing import HEAD, LAYER, Pointing
from proprio_mllm.training.sources import CELL, Views


@pytest.fixture
def asked(shards, cfg: ModelConfig) -> tuple[ProprioMLLM, Batch, list[str]]:
    """A model, a batch of questions about four views, and the things that are asked about."""
    views, rng = Views(shards / "views", cfg), np.random.default_rng(0)
    examples = [looking_around(views, views.row(i), 4, rng) for i in views.split.train[:4]]
    processor = build_processor(cfg, [render(example.messages) for example in examples] * 3)
    add_word_tokens(processor.tokenizer, {word for name in views.type_names for word in id_words(f"{name}_1")})
    model = build_model(cfg, processor, 0)
    return model, Collator(processor, cfg)(examples), [one.name for example in examples for one in example.shown]


def test_names_end_where_the_head_looks_from(asked: tuple[ProprioMLLM, Batch, list[str]]) -> None:
    model, batch, names = asked
    assert batch.named is not None
    for name, row, place in zip(names, batch.named.row, batch.named.place, strict=True):
        asked_about = model.processor.tokenizer.decode(batch.input_ids[row, : place + 1]).rpartition("<|im_start|>user")[2]
        assert asked_about.endswith(name)
        assert "<|im_end|>" not in asked_about


def test_questions_name_things_in_the_tokens_of_episodes(asked: tuple[ProprioMLLM, Batch, list[str]]) -> None:
    model, batch, names = asked
    tokenizer = model.processor.tokenizer
    blank = tokenizer(" ", add_special_tokens=False)["input_ids"]
    for name, row, place in zip(names, batch.named.row, batch.named.place, strict=True):
        wanted = WordTokens(tokenizer).tokens(name.split())
        before = [int(token) for token in batch.input_ids[row, : place + 1] if [int(token)] != blank]
        assert before[-len(wanted) :] == wanted


def test_cells_are_those_of_the_thing(shards, cfg: ModelConfig) -> None:
    views = Views(shards / "views", cfg)
    row = views.row(int(views.split.train[0]))
    for one in views.asked(row, ("side",), 9, np.random.default_rng(0)):
        (shown,) = views.shown(row, [one])
        left, top, right, bottom = one.thing["bbox"]
        grid = shown.cells.reshape(row.segmentation.shape[0] // CELL, -1)
        rows, columns = np.nonzero(grid)
        assert grid.sum() == pytest.approx(1.0)
        assert top // CELL <= rows.min() <= rows.max() <= (bottom - 1) // CELL
        assert left // CELL <= columns.min() <= columns.max() <= (right - 1) // CELL


def test_loss_is_of_the_attention_that_the_model_computes(asked: tuple[ProprioMLLM, Batch, list[str]]) -> None:
    model, batch, _ = asked
    named, text = batch.named, model.core.model.language_model
    model.core.set_attn_implementation("eager")
    weights: list[torch.Tensor] = []
    layer = min(LAYER, len(text.layers) - 1)
    text.layers[layer].self_attn.register_forward_hook(lambda _, __, out: weights.append(out[1]))
    out, loss, metrics = Pointing(model, 0.5)(model, batch)
    (shares,) = weights
    cells = named.first[:, None] + torch.arange(named.cells.shape[1])
    told = shares[named.row, HEAD, named.place].gather(1, cells)
    expected = -(named.cells * told.log()).sum(1).mean()
    assert metrics["point_loss"] == pytest.approx(expected.item(), rel=1e-4)
    torch.testing.assert_close(loss, out.loss + 0.5 * expected, rtol=1e-4, atol=1e-5)


def test_the_head_learns_to_point(asked: tuple[ProprioMLLM, Batch, list[str]]) -> None:
    model, batch, _ = asked
    pointing, optimizer = Pointing(model, 1.0), torch.optim.AdamW(model.parameters(), lr=1e-2)
    before = pointing(model, batch)[2]
    for _ in range(25):
        optimizer.zero_grad()
        pointing(model, batch)[1].backward()
        optimizer.step()
    after = pointing(model, batch)[2]
    assert after["point_loss"] < 0.6 * before["point_loss"]
    assert after["pointed"] > max(0.7, before["pointed"])


def test_without_a_weight_nothing_is_added(asked: tuple[ProprioMLLM, Batch, list[str]]) -> None:
    model, batch, _ = asked
    out, loss, metrics = Pointing(model, 0.0)(model, batch)
    assert loss is out.loss
    assert not metrics


def test_a_name_that_is_not_there_is_refused(shards, cfg: ModelConfig, asked: tuple[ProprioMLLM, Batch, list[str]]) -> None:
    views = Views(shards / "views", cfg)
    example = looking_around(views, views.row(int(views.split.train[0])), 2, np.random.default_rng(0))
    other = replace(example.shown[0], name=" sofa  _7")
    with pytest.raises(ValueError, match="does not name ' sofa  _7'"):
        Collator(asked[0].processor, cfg)([replace(example, shown=(other,))])
