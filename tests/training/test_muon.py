"""Muon: orthogonal updates of matrices, AdamW's of everything else, checkpoints that continue it."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import nn

from configs.schema.train import LoggerConfig, LoopConfig
from proprio_mllm.training.loop import run_loop
from proprio_mllm.training.metrics import MetricWriter
from proprio_mllm.training.muon import Muon, linear_weights, orthogonalised
from tests.training.test_loop import Line

CFG = LoopConfig(steps=24, batch=8, lr=1e-2, warmup=3, checkpoint_every=8, log_every=8, optimizer="muon")


@pytest.mark.parametrize("shape", [(8, 32), (32, 8), (16, 16)])
def test_singular_values_become_about_one(shape: tuple[int, int]) -> None:
    generator = torch.Generator().manual_seed(0)
    update = torch.randn(*shape, generator=generator)
    left, _, right = torch.linalg.svd(update, full_matrices=False)
    near = orthogonalised(update)
    values = torch.linalg.svdvals(near)
    assert float(values.min()) > 0.3
    assert float(values.max()) < 1.3
    assert torch.nn.functional.cosine_similarity(near.flatten(), (left @ right).flatten(), dim=0) > 0.95


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_matrices_of_all_shapes_move_as_each_would_alone(dtype: torch.dtype) -> None:
    generator = torch.Generator().manual_seed(0)
    grads = [torch.randn(*shape, generator=generator) for shape in ((8, 32), (16, 16), (8, 32), (32, 8), (16, 16))]
    weights = [nn.Parameter(torch.zeros_like(grad)) for grad in grads]
    optimizer = Muon(weights, [], 0.01, weight_decay=0.0, dtype=dtype)
    for weight, grad in zip(weights, grads, strict=True):
        weight.grad = grad
    optimizer.step()
    for weight, grad in zip(weights, grads, strict=True):
        expected = -0.01 * 0.4 * max(grad.shape) ** 0.5 * orthogonalised(grad)
        tolerance = 1e-6 if dtype is torch.float32 else 0.05 * float(expected.abs().max())
        assert torch.allclose(weight, expected, atol=tolerance), float((weight - expected).abs().max())


def test_tables_and_the_output_layer_are_no_matrices() -> None:
    model = nn.ModuleDict({"embed": nn.Embedding(5, 4), "mlp": nn.Linear(4, 3), "lm_head": nn.Linear(4, 5, bias=False)})
    assert [id(one) for one in linear_weights(model)] == [id(model["mlp"].weight)]
    model["lm_head"].weight = model["embed"].weight  # type: ignore[assignment]
    assert [id(one) for one in linear_weights(model)] == [id(model["mlp"].weight)]
    model["mlp"].weight.requires_grad_(False)
    assert linear_weights(model) == []


def test_other_parameters_follow_adamw() -> None:
    torch.manual_seed(0)
    start = torch.randn(6)
    mine, theirs = nn.Parameter(start.clone()), nn.Parameter(start.clone())
    muon = Muon([], [{"params": [mine], "weight_decay": 0.1}], 1e-2)
    adamw = torch.optim.AdamW([theirs], lr=1e-2, betas=(0.9, 0.99), weight_decay=0.1)
    for number in range(5):
        for parameter in (mine, theirs):
            parameter.grad = torch.sin(start + number)
        muon.step()
        adamw.step()
    assert torch.allclose(mine, theirs, atol=1e-6)


def test_a_step_moves_a_matrix_as_far_as_adamw_would() -> None:
    weight = nn.Parameter(torch.zeros(64, 64))
    weight.grad = torch.randn(64, 64, generator=torch.Generator().manual_seed(1))
    Muon([weight], [], 1e-3, weight_decay=0.0).step()
    assert 2e-4 < float(weight.detach().square().mean().sqrt()) < 6e-4


def _run(folder: Path, objective: Line, cfg: LoopConfig) -> list[torch.Tensor]:
    run_loop(objective, cfg, folder, 5, MetricWriter(folder, "line", LoggerConfig("disabled")))
    return [tensor.clone() for tensor in objective.module.state_dict().values()]


def test_other_parameters_may_have_a_rate_of_their_own() -> None:
    def moved(share: float) -> tuple[float, float]:
        matrix, vector = nn.Parameter(torch.ones(4, 4)), nn.Parameter(torch.ones(4))
        optimizer = Muon([matrix], [{"params": [vector], "weight_decay": 0.0}], 0.01, weight_decay=0.0, adam_share=share)
        matrix.grad, vector.grad = torch.eye(4), torch.ones(4)
        optimizer.step()
        return float((matrix - 1.0).detach().abs().max()), float((vector - 1.0).detach().abs().max())

    (matrix, vector), (same, less) = moved(1.0), moved(0.25)
    assert same == matrix
    assert less == pytest.approx(vector / 4.0, rel=1e-3)


def test_a_run_continues_from_its_checkpoint(tmp_path: Path) -> None:
    whole = _run(tmp_path / "whole", Line(), CFG)

    class Dies(Line):
        def batch(self, rng: np.random.Generator, size: int, kind: None = None) -> torch.Tensor:
            if self.seen >= 12:
                raise KeyboardInterrupt
            return super().batch(rng, size)

    with pytest.raises(KeyboardInterrupt):
        _run(tmp_path / "cut", Dies(), CFG)
    rest = Line()
    again = _run(tmp_path / "cut", rest, CFG)
    assert rest.seen == 16
    assert all(torch.equal(x, y) for x, y in zip(whole, again, strict=True))
    plain = _run(tmp_path / "adamw", Line(), dataclasses.replace(CFG, optimizer="adamw"))
    assert not all(torch.equal(x, y) for x, y in zip(whole, plain, strict=True))
