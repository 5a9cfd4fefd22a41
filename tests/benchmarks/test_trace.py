"""What a place on the way tells of positions: all where it holds them, nothing where it does not."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from benchmarks.trace import Question, explained, main, name_ends, traced
from configs.schema.model import ModelConfig, MotionTokenizerConfig, PointMapConfig, TinyTextConfig, TinyVisionConfig
from proprio_mllm.model.batch import IGNORE, Collator
from proprio_mllm.model.building import build_model, build_processor, save_model
from proprio_mllm.model.modeling import ProprioMLLM
from proprio_mllm.training.sources import CELL, Views
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
    rng = np.random.default_rng(0)
    rows = [views.row(int(i)) for i in views.split.train[:3]]
    questions = [Question.of(views, row, one) for row in rows for one in views.asked(row, ("side",), 3, rng)]
    batch = model.look(Collator(model.processor, model.cfg)([question.example(views) for question in questions]))
    found = traced(model, questions, views)
    for k, (question, ids, place) in enumerate(
        zip(questions, batch.input_ids, name_ends(model, batch, questions), strict=True)
    ):
        answer = next(at for at in range(place, len(ids)) if batch.labels[k, at] != IGNORE)
        asked = model.processor.tokenizer.decode(ids[: place + 1]).rpartition("<|im_start|>user")[2]
        assert asked.endswith(question.asked.name)
        torch.testing.assert_close(found["name, layer 0"][k], model.table[ids[place]].detach())
        torch.testing.assert_close(found["answer, layer 0"][k], model.table[ids[answer - 1]].detach())
    cells = torch.tensor(np.stack([question.cells for question in questions]))
    torch.testing.assert_close(found["visual tokens, layer 0"], (batch.sight.tokens.detach() * cells[..., None]).sum(1))


def test_things_are_where_their_boxes_are(tmp_path: Path, model: ProprioMLLM) -> None:
    views = Views(write_views(tmp_path / "views", 6), model.cfg)
    row = views.row(0)
    for one in views.asked(row, ("side",), 8, np.random.default_rng(0)):
        left, top, right, bottom = one.thing["bbox"]
        grid = Question.of(views, row, one).cells.reshape(row.segmentation.shape[0] // CELL, -1)
        rows, columns = np.nonzero(grid)
        assert grid.sum() == pytest.approx(1.0)
        assert top // CELL <= rows.min() <= rows.max() <= (bottom - 1) // CELL
        assert left // CELL <= columns.min() <= columns.max() <= (right - 1) // CELL


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
