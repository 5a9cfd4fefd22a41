"""What a place on the way tells of positions: all where it holds them, nothing where it does not."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from benchmarks.trace import explained, main, traced
from configs.schema.model import ModelConfig, MotionTokenizerConfig, PointMapConfig, TinyTextConfig, TinyVisionConfig
from proprio_mllm.model.batch import IGNORE, Collator
from proprio_mllm.model.building import build_model, build_processor, save_model
from proprio_mllm.model.modeling import ProprioMLLM
from proprio_mllm.training.base import looking_around
from proprio_mllm.training.sources import Views
from tests.training.conftest import TYPES, write_views


def test_positions_are_explained_where_they_are_held_and_only_there() -> None:
    torch.manual_seed(0)
    truth, noise = torch.randn(400, 3), torch.randn(400, 20)
    held = torch.cat([noise, truth[:, :2] @ torch.randn(2, 5)], 1)
    x, y, z = explained(held, truth)
    assert x > 0.9
    assert y > 0.9
    assert z < 0.1


@pytest.fixture
def model() -> ProprioMLLM:
    cfg = ModelConfig(
        name="test",
        vocab_size=400,
        text=TinyTextConfig(hidden=64, layers=2, heads=2, kv_heads=1, intermediate=96),
        vision=TinyVisionConfig(hidden=32, depth=2, heads=2, intermediate=48),
        point_map=PointMapConfig(encoder="sim", width=32, depth=1),
        motion=MotionTokenizerConfig(codes=16, code_dim=8, width=16, depth=1),
    )
    return build_model(cfg, build_processor(cfg, ["side lamp _1 left ahead right"] * 3, TYPES)).eval()


def test_names_and_what_stands_before_their_answers_are_read(tmp_path: Path, model: ProprioMLLM) -> None:
    views = Views(write_views(tmp_path / "views", 10), model.cfg)
    examples = [looking_around(views, views.row(i), 3, np.random.default_rng(0)) for i in views.split.train[:3]]
    batch = Collator(model.processor, model.cfg)(examples)
    found = traced(model, batch)
    for k, (row, place) in enumerate(zip(batch.named.row.tolist(), batch.named.place.tolist(), strict=True)):
        answer = next(at for at in range(place, batch.labels.shape[1]) if batch.labels[row, at] != IGNORE)
        ids = batch.input_ids[row]
        torch.testing.assert_close(found["name, layer 0"][k], model.table[ids[place]].detach())
        torch.testing.assert_close(found["answer, layer 0"][k], model.table[ids[answer - 1]].detach())
    visual = model.enrich(model.visual_tokens(batch.images), batch.images).detach()
    expected = (visual[batch.named.row] * batch.named.cells[..., None]).sum(1)
    torch.testing.assert_close(found["visual tokens, layer 0"], expected)


def test_the_way_is_printed_place_by_place(tmp_path: Path, model: ProprioMLLM, capsys: pytest.CaptureFixture[str]) -> None:
    write_views(tmp_path / "views", 60)
    save_model(model, tmp_path / "model")
    assert main([f"views={tmp_path / 'views'}", f"model={tmp_path / 'model'}", "rows=30"]) == 0
    first, head, *lines = capsys.readouterr().out.splitlines()
    assert "things in 30 views" in first
    assert head.split() == ["x", "y", "z", "size"]
    places = [line[:24].strip() for line in lines]
    layers = range(model.cfg.text.layers)
    assert places == ["points", *(f"{what}, layer {n}" for what in ("visual tokens", "name", "answer") for n in layers)]
