"""F3D looked up by name: a word behind a picture gets what the cells hold that look like it."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from torch.nn import functional

from proprio_mllm.model.batch import Batch, Collator, Example, Places
from proprio_mllm.model.building import build_model, build_processor, load_model, save_model
from proprio_mllm.model.chat import IMAGE, Message
from proprio_mllm.model.cse import NamedPoints
from proprio_mllm.model.modeling import ProprioMLLM
from proprio_mllm.model.word_tokens import add_word_tokens, tokens_of
from tests.model.conftest import TEXTS, TYPES, make_view, small


@pytest.fixture
def lookup() -> NamedPoints:
    """One that gives what it looks up as it is, in the first channels."""
    module = NamedPoints(2, 8)
    with torch.no_grad():
        module.put = torch.nn.Sequential(torch.nn.Linear(2, 8, bias=False))
        module.put[0].weight.copy_(torch.eye(8, 2))
        module.scale.fill_(4.0)  # the peak alone counts
        module.bias.fill_(-25.0)
    return module


def places(keys: torch.Tensor, values: torch.Tensor) -> Places:
    """Cells that count alike."""
    return Places(keys, values, torch.zeros(keys.shape[:2]))


def test_a_word_gets_what_the_cell_holds_that_looks_like_it(lookup: NamedPoints) -> None:
    cells = torch.eye(8)[:4][None]  # four cells, each of another look
    held = torch.tensor([[[1.0, 2.0], [3.0, 4.0], [5.0, 6.0], [7.0, 8.0]]])
    words = torch.stack([torch.eye(8)[6], 9.0 * cells[0, 2], 9.0 * cells[0, 1]])[None]  # the first looks like none
    with torch.no_grad():
        given = lookup(words, places(3.0 * cells, held))[0]
    assert float(given[0].abs().max()) < 1e-3
    torch.testing.assert_close(given[1, :2], held[0, 2], atol=1e-3, rtol=1e-3)
    torch.testing.assert_close(given[2, :2], held[0, 1], atol=1e-3, rtol=1e-3)
    assert float(given[:, 2:].abs().max()) == 0.0


def test_a_name_of_several_words_is_looked_up_as_a_whole(lookup: NamedPoints) -> None:
    coffee, table, machine, number, washing = torch.eye(8)[:5]
    cells = torch.stack([coffee + table, coffee + machine, washing + machine])[None]
    held = torch.tensor([[[1.0, 0.0], [2.0, 0.0], [3.0, 0.0]]])
    with torch.no_grad():
        lookup.bias.fill_(25.0)
        given = lookup(torch.stack([coffee, machine, number])[None], places(cells, held))[0]
        other = lookup(torch.stack([washing, machine, number])[None], places(cells, held))[0]
    assert float(given[1, 0]) == pytest.approx(2.0, abs=1e-3)  # coffee machine, and not the machine by itself
    assert float(given[2, 0]) == pytest.approx(2.0, abs=1e-3)  # its number still belongs to it
    assert float(other[1, 0]) == pytest.approx(3.0, abs=1e-3)


@pytest.fixture
def model() -> ProprioMLLM:
    cfg = small()
    cfg = dataclasses.replace(cfg, cse=dataclasses.replace(cfg.cse, named=True))
    processor = build_processor(cfg, TEXTS, TYPES)
    add_word_tokens(processor.tokenizer, ("pick", "mug", "_1"))
    model = build_model(cfg, processor, 0).eval()
    assert model.cse is not None
    assert model.cse.named is not None
    torch.nn.init.constant_(model.cse.named.bias, 5.0)
    return model


def ask(model: ProprioMLLM, *texts: str) -> Batch:
    """Rows, each with as many pictures as it names."""
    messages = [(Message("user", text), Message("assistant", "left")) for text in texts]
    rng = np.random.default_rng(0)
    examples = [
        Example(said, tuple(make_view(rng) for _ in range(text.count(IMAGE))))
        for said, text in zip(messages, texts, strict=True)
    ]
    return model.look(Collator(model.processor, model.cfg)(examples))


def test_words_behind_a_picture_are_looked_up_and_no_others(model: ProprioMLLM) -> None:
    batch = ask(model, f"pick  mug  _1 {IMAGE} pick  mug  _1", "pick  mug  _1", f"{IMAGE} pick {IMAGE}  mug ")
    given = model.named(batch)
    assert given is not None
    words = tokens_of(model.processor.tokenizer).tokens(["pick", "mug", "_1"])
    image = Collator(model.processor, model.cfg).image_token
    for row, ids in enumerate(batch.input_ids.tolist()):
        last = max((at for at, token in enumerate(ids) if token == image), default=len(ids))
        looked_up = [at for at, value in enumerate(given[row]) if bool(value.any())]
        assert looked_up == [at for at, token in enumerate(ids) if token in words and at > last]
    assert [int(one) for one in batch.sight.last] == [0, -1, 2]


def test_it_is_the_rows_own_picture_that_is_looked_at(model: ProprioMLLM) -> None:
    text = f"{IMAGE} pick  mug  _1"
    both, second = ask(model, text, text), ask(model, "pick", text)
    both = dataclasses.replace(second, **{name: getattr(both, name) for name in ("input_ids", "sight")})
    given = model.named(both)
    alone = model.look(dataclasses.replace(ask(model, text), sight=None))
    assert given is not None
    assert not torch.allclose(given[0], given[1], atol=1e-4)
    torch.testing.assert_close(given[0], model.named(alone)[0])


def test_what_is_looked_up_reaches_the_answer_and_teaches_the_way(model: ProprioMLLM) -> None:
    batch = dataclasses.replace(ask(model, f"{IMAGE} pick  mug  _1"), sight=None)
    out = model(batch)
    out.loss.backward()
    named = model.cse.named
    assert all(float(one.grad.abs().sum()) > 0.0 for one in named.parameters())
    torch.nn.init.zeros_(named.put[2].weight)
    torch.nn.init.zeros_(named.put[2].bias)
    with torch.no_grad():
        silent = model(batch).loss
        model.cse.named = None
        torch.testing.assert_close(silent, model(batch).loss)
    assert not torch.allclose(silent, out.loss, atol=1e-4)


def test_a_stored_model_looks_up_the_same(model: ProprioMLLM, tmp_path) -> None:
    batch = ask(model, f"{IMAGE} pick  mug  _1")
    save_model(model, tmp_path / "model")
    torch.testing.assert_close(load_model(tmp_path / "model").named(batch), model.named(batch))
    assert functional.mse_loss(model.named(batch), torch.zeros_like(model.named(batch))) > 0
