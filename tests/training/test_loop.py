"""The loop: schedule, budgets, and that a killed and resumed run ends with the same weights."""

from __future__ import annotations

import dataclasses
import os
import signal
import subprocess
import sys
import textwrap
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import load_file
from torch import Tensor, nn

from configs.schema.train import LoggerConfig, LoopConfig
from proprio_mllm.training import loop
from proprio_mllm.training.loop import Objective, Parts, learning_rate, run_loop
from proprio_mllm.training.metrics import MetricWriter

CFG = LoopConfig(steps=30, batch=8, lr=1e-2, warmup=3, checkpoint_every=4, log_every=5)


class Line(Objective):
    """Fits a line; the loss also draws, so that the generator's state matters."""

    name = "line"

    def __init__(self, key: str = "k", bad: bool = False) -> None:
        torch.manual_seed(0)
        self.module: nn.Module = nn.Sequential(nn.Linear(3, 8), nn.Tanh(), nn.Linear(8, 1))
        self.key, self.bad, self.seen = key, bad, 0

    def batch(self, rng: np.random.Generator, size: int, kind: None = None) -> Tensor:
        return torch.from_numpy(rng.normal(size=(size, 3)).astype(np.float32))

    def loss(self, module: nn.Module, batch: Tensor, generator: torch.Generator) -> tuple[Tensor, Mapping[str, float]]:
        self.seen += 1
        noise = torch.randn(len(batch), 1, generator=generator).to(batch.device) * 0.1
        loss = (module(batch) - batch.sum(1, keepdim=True) + noise).square().mean()
        return loss * float("nan") if self.bad else loss, {"extra": 1.0}


def weights(module: nn.Module) -> list[Tensor]:
    return [tensor.clone() for tensor in module.state_dict().values()]


def run(folder: Path, objective: Line, cfg: LoopConfig = CFG, seed: int = 5) -> list[Tensor]:
    run_loop(objective, cfg, folder, seed, MetricWriter(folder, "line", LoggerConfig("disabled")))
    return weights(objective.module)


def test_same_seed_same_weights(tmp_path: Path) -> None:
    first, second = run(tmp_path / "a", Line()), run(tmp_path / "b", Line())
    assert all(torch.equal(x, y) for x, y in zip(first, second, strict=True))
    other = run(tmp_path / "c", Line(), seed=6)
    assert not all(torch.equal(x, y) for x, y in zip(first, other, strict=True))


class InParts(Line):
    """The same line, its batches in two parts; without noise, which would be drawn for each part."""

    def batch(self, rng: np.random.Generator, size: int, kind: None = None) -> Parts:
        whole = super().batch(rng, size)
        return Parts((whole[: size // 4], whole[size // 4 :]))

    def loss(self, module: nn.Module, batch: Tensor, generator: torch.Generator) -> tuple[Tensor, Mapping[str, float]]:
        share = len(batch) / CFG.batch
        return share * (module(batch) - batch.sum(1, keepdim=True)).square().mean(), {"share": share}


class Whole(InParts):
    """Its batches in one."""

    def batch(self, rng: np.random.Generator, size: int, kind: None = None) -> Tensor:
        return Line.batch(self, rng, size)


def test_parts_add_up_to_their_batch(tmp_path: Path) -> None:
    parts, whole = run(tmp_path / "parts", InParts()), run(tmp_path / "whole", Whole())
    for ours, theirs in zip(parts, whole, strict=True):
        torch.testing.assert_close(ours, theirs, atol=1e-4, rtol=1e-3)
    rows = [(tmp_path / name / "metrics.csv").read_text().splitlines() for name in ("parts", "whole")]
    first = [dict(zip(lines[0].split(","), lines[1].split(","), strict=True)) for lines in rows]
    assert float(first[0]["share"]) == float(first[1]["share"]) == 1.0
    assert float(first[0]["loss"]) == pytest.approx(float(first[1]["loss"]), rel=1e-3)


class TwoKinds(Line):
    """Three of four batches pull a number up, softly; the others pull it down, hard."""

    def __init__(self) -> None:
        super().__init__()
        self.module = nn.Linear(1, 1, bias=False)
        nn.init.zeros_(self.module.weight)

    def kind(self, rng: np.random.Generator) -> str:
        return "soft" if rng.random() < 0.75 else "hard"

    def batch(self, rng: np.random.Generator, size: int, kind: str | None = None) -> Tensor:
        return torch.tensor(-0.2 if kind == "soft" else 50.0)

    def loss(self, module: nn.Module, batch: Tensor, generator: torch.Generator) -> tuple[Tensor, Mapping[str, float]]:
        return batch * module(torch.ones(1, 1)).sum(), {}


@pytest.mark.parametrize(("clip", "up"), [(0.1, True), (10.0, False)])
def test_kinds_pull_alike_below_a_small_clip(tmp_path: Path, clip: float, up: bool) -> None:
    cfg = dataclasses.replace(CFG, clip=clip, steps=40)
    objective = TwoKinds()
    assert (float(run(tmp_path, objective, cfg)[0]) > 0.0) is up
    rows = [line.split(",") for line in (tmp_path / "metrics.csv").read_text().splitlines()]
    found = {name: {row[i] for row in rows[1:]} - {""} for i, name in enumerate(rows[0])}
    assert "grad_norm" not in found
    assert [float(value) for value in found["soft_grad_norm"]] == pytest.approx([0.2])
    assert [float(value) for value in found["hard_grad_norm"]] == pytest.approx([50.0])


def test_as_many_batches_are_made_as_steps_are_taken(tmp_path: Path) -> None:
    made: list[int] = []

    class Counted(Line):
        def batch(self, rng: np.random.Generator, size: int, kind: None = None) -> Tensor:
            made.append(size)
            return super().batch(rng, size)

    run_loop(Counted(), CFG, tmp_path, 5, None, micro_batches=2)
    assert made == [CFG.batch // 2] * (2 * CFG.steps)


def test_a_resumed_run_counts_its_own_examples_and_all_seconds(tmp_path: Path) -> None:
    first = run_loop(Line(), dataclasses.replace(CFG, steps=8, log_every=8), tmp_path, 5, None)
    assert (first.steps, first.examples) == (8, 8 * CFG.batch)
    assert first.last["examples_per_s"] * first.seconds >= first.examples  # writing the checkpoint takes its time as well
    second = run_loop(Line(), dataclasses.replace(CFG, steps=12), tmp_path, 5, None)
    assert (second.steps, second.examples) == (12, 4 * CFG.batch)
    assert second.seconds > first.seconds


def test_passes_that_keep_others_company_teach_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A process with fewer parts than others repeats its first one, here one without a loss."""

    class Learnt(InParts):
        def batch(self, rng: np.random.Generator, size: int, kind: None = None) -> Parts:
            return Parts((torch.zeros(2, 3), Line.batch(self, rng, size)))

        def loss(self, module: nn.Module, batch: Tensor, generator: torch.Generator) -> tuple[Tensor, Mapping[str, float]]:
            self.seen += 1
            told = module(batch)
            return (told - (batch.sum(1, keepdim=True) if batch.any() else told.detach())).square().mean(), {}

    found = []
    for idle in (0, 3):
        monkeypatch.setattr(loop, "is_sharded", lambda module: True)
        monkeypatch.setattr(loop, "largest", lambda own, idle=idle: own + idle)
        objective = Learnt()
        found.append(run(tmp_path / str(idle), objective))
        assert objective.seen == (2 + idle) * CFG.steps
    assert all(torch.equal(x, y) for x, y in zip(*found, strict=True))


SCRIPT = """
import sys, time
from pathlib import Path
import importlib.util
spec = importlib.util.spec_from_file_location("test_loop", {file!r})
module = importlib.util.module_from_spec(spec)
spec.loader.exec_module(module)
class Slow(module.Line):
    def loss(self, *args):
        time.sleep(0.15)
        return super().loss(*args)
module.run(Path({folder!r}), Slow())
"""


def test_kill_and_resume_gives_the_same_weights(tmp_path: Path) -> None:
    whole = run(tmp_path / "whole", Line())
    folder = tmp_path / "killed"
    script = textwrap.dedent(SCRIPT).format(file=__file__, folder=str(folder))
    root = str(Path(__file__).parents[2])
    process = subprocess.Popen([sys.executable, "-c", script], env={**os.environ, "PYTHONPATH": root}, cwd=root)
    state = folder / "checkpoint" / "state.json"
    for _ in range(600):
        if state.is_file():
            break
        torch.tensor(0).item()
        __import__("time").sleep(0.05)
    process.send_signal(signal.SIGKILL)
    process.wait()
    assert state.is_file()
    objective = Line()
    resumed = run(folder, objective)
    assert 0 < objective.seen < CFG.steps
    assert all(torch.equal(x, y) for x, y in zip(whole, resumed, strict=True))
    rows = (folder / "metrics.csv").read_text().splitlines()
    assert [row.split(",")[0] for row in rows] == ["step", *(str(s) for s in range(5, 31, 5))]


def test_weights_of_any_memory_format_are_restored(tmp_path: Path) -> None:
    class Planes(Line):
        """The same line by a convolution over pictures of one pixel, channels last."""

        def __init__(self) -> None:
            super().__init__()
            plane = nn.Conv2d(3, 8, 3, padding=1)
            module: Any = nn.Sequential(nn.Unflatten(1, (3, 1, 1)), plane, nn.Flatten(), nn.Linear(8, 1))
            self.module = module.to(memory_format=torch.channels_last)
            assert any(not parameter.is_contiguous() for parameter in self.module.parameters())

    learnt, again = run(tmp_path, Planes()), run(tmp_path, Planes())
    assert all(torch.equal(x, y) for x, y in zip(learnt, again, strict=True))


def test_checkpoint_of_another_key_is_not_resumed(tmp_path: Path) -> None:
    run(tmp_path, Line("one"))
    again = Line("two")
    run(tmp_path, again)
    assert again.seen == CFG.steps
    assert load_file(tmp_path / "checkpoint" / "model.safetensors")


def test_time_budget_ends_a_run(tmp_path: Path) -> None:
    objective = Line()
    cfg = LoopConfig(steps=10_000, batch=2, lr=1e-3, minutes=0.01, log_every=100, checkpoint_every=1000)
    result = run_loop(objective, cfg, tmp_path, 0, MetricWriter(tmp_path, "line", LoggerConfig("disabled")))
    assert 0 < result.steps < cfg.steps
    assert result.steps == objective.seen


def test_learning_rate_warms_up_and_decays() -> None:
    cfg = LoopConfig(steps=100, batch=1, lr=1.0, warmup=10, minutes=1.0)
    assert learning_rate(cfg, 0) == pytest.approx(0.1)
    assert learning_rate(cfg, 10) == pytest.approx(1.0)
    assert [learning_rate(cfg, step) for step in (55, 100, 120)] == pytest.approx([0.55, 0.1, 0.1])
    assert learning_rate(cfg, 10, seconds=60.0) == pytest.approx(0.1)
    share = [learning_rate(cfg, 10, seconds=seconds) for seconds in (15.0, 30.0, 45.0)]
    assert share == pytest.approx([0.1 + 0.45 * (1.0 + 0.5**0.5), 0.55, 0.1 + 0.45 * (1.0 - 0.5**0.5)])  # a cosine, no line


def test_loss_that_is_not_finite_stops(tmp_path: Path) -> None:
    with pytest.raises(FloatingPointError, match="line: loss nan at step 0"):
        run(tmp_path, Line(bad=True))


def test_nothing_to_train(tmp_path: Path) -> None:
    objective = Line()
    objective.module.requires_grad_(False)
    with pytest.raises(ValueError, match="'line' trains no parameter"):
        run(tmp_path, objective)


@pytest.mark.parametrize(("field", "value"), [("steps", 0), ("lr", 0.0), ("minutes", -1.0)])
def test_loop_config_refuses(field: str, value: float) -> None:
    with pytest.raises(ValueError, match=f"{field} {value}"):
        LoopConfig(**{"steps": 1, "batch": 1, "lr": 0.1, field: value})
