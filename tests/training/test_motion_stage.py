"""The tokenizer's stage: windows, metrics, and that a stopped run goes on as if nothing had happened, codebooks included."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from configs.schema.data import DataConfig, ReplayConfig
from configs.schema.model import MotionTokenizerConfig
from configs.schema.train import LoggerConfig, LoopConfig
from data.pipeline import build_clips
from proprio_mllm.model.motion_tokenizer import MotionTokenizer
from proprio_mllm.training.loop import run_loop
from proprio_mllm.training.metrics import MetricWriter
from proprio_mllm.training.motion_stage import (
    MotionObjective,
    MotionWindows,
    codebook_use,
    reconstruction_metrics,
    tokenizer_metrics,
)
from proprio_mllm.training.sources import Clips

SMALL = {"window": 32, "width": 16, "code_dim": 16, "depth": 1}
KINDS = {"vq": {"codes": 32}, "rvq": {"codes": 16}, "fsq": {"codes": 64, "levels": (4, 4, 4)}}
LOOP = LoopConfig(steps=8, batch=16, lr=1e-3, warmup=2, checkpoint_every=3, log_every=4)


@pytest.fixture(scope="module")
def clips(tmp_path_factory: pytest.TempPathFactory) -> Clips:
    folder = tmp_path_factory.mktemp("motion") / "clips"
    cfg = DataConfig(clips=24, part_size=24, workers=1, robots=("x1",), replay=ReplayConfig(enabled=False))
    build_clips(cfg, folder)
    return Clips(folder)


def _tokenizer(kind: str) -> MotionTokenizer:
    torch.manual_seed(0)
    return MotionTokenizer(MotionTokenizerConfig(quantizer=kind, **SMALL, **KINDS[kind]))  # type: ignore[arg-type]


def _train(folder: Path, clips: Clips, kind: str, steps: int) -> dict[str, Tensor]:
    windows = MotionWindows(clips, [], 32)
    tokenizer = _tokenizer(kind)
    tokenizer.set_normalisation(*windows.statistics())
    loop = LoopConfig(**{**vars(LOOP), "steps": steps})
    run_loop(MotionObjective(tokenizer, windows, "k"), loop, folder, 3, MetricWriter(folder, "t", LoggerConfig("disabled")))
    return {name: value.clone() for name, value in tokenizer.state_dict().items()}


@pytest.mark.parametrize("kind", sorted(KINDS))
def test_a_stopped_run_ends_with_the_same_weights_and_codebooks(clips: Clips, tmp_path: Path, kind: str) -> None:
    whole = _train(tmp_path / "whole", clips, kind, 8)
    folder = tmp_path / "stopped"

    class Stopped(Exception):  # noqa: N818
        pass

    objective_loss = MotionObjective.loss
    calls = iter(range(100))

    def loss(self: MotionObjective, *arguments: object) -> object:
        if next(calls) == 5:
            raise Stopped
        return objective_loss(self, *arguments)  # type: ignore[arg-type]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(MotionObjective, "loss", loss)
        with pytest.raises(Stopped):
            _train(folder, clips, kind, 8)
    assert (folder / "checkpoint" / "state.json").is_file()
    resumed = _train(folder, clips, kind, 8)
    assert all(torch.equal(resumed[name], value) for name, value in whole.items())
    assert any("embed" in name for name in whole) == (kind != "fsq")


def test_metrics_against_their_definition(clips: Clips, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(clips.split, "test", clips.split.train[:2])
    tokenizer = _tokenizer("vq")
    windows = MotionWindows(clips, [], 32)
    tokenizer.set_normalisation(*windows.statistics())
    tokenizer.train()(torch.from_numpy(windows.draw(np.random.default_rng(0), 32)), torch.Generator().manual_seed(0))
    tokenizer.eval()
    rows = windows.draw(np.random.default_rng(1), 6)
    found = reconstruction_metrics(tokenizer, rows)
    rebuilt = tokenizer.decode(tokenizer.encode(torch.from_numpy(rows))).numpy()
    away = (rebuilt - rows)[..., :42].reshape(6, 32, 14, 3)
    assert found["mpjpe_mm"] == pytest.approx(1000 * np.linalg.norm(away, axis=-1).mean(), rel=1e-5)
    assert found["hands_mm"] == pytest.approx(1000 * np.linalg.norm(away[:, :, [4, 7]], axis=-1).mean(), rel=1e-5)
    assert found["feet_mm"] == pytest.approx(1000 * np.linalg.norm(away[:, :, [10, 13]], axis=-1).mean(), rel=1e-5)
    speed = np.linalg.norm(np.diff(away, axis=1), axis=-1) * 20.0
    assert found["velocity_mm_s"] == pytest.approx(1000 * speed.mean(), rel=1e-5)
    assert found["count"] == 6
    assert codebook_use(tokenizer, rows).sum() == 6 * 8
    summary = tokenizer_metrics(tokenizer, windows)
    assert summary["bits_per_s"] == pytest.approx(5.0 * 5.0)
    assert 0.0 < summary["codes_used"] <= 1.0
    assert {"clips_hands_mm", "clips_velocity_mm_s", "clips_count"} <= set(summary)
