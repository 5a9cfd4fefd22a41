"""The table over motion tokenizers, on retargeted clips of both robots."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from configs.schema.data import DataConfig, ReplayConfig
from configs.schema.model import MotionTokenizerConfig
from data.joint_angles import JointAngles
from data.motion import N_FEATURES
from data.pipeline import build_clips
from proprio_mllm.model.motion_tokenizer import MotionTokenizer
from proprio_mllm.report import tokenizer as report
from proprio_mllm.report.tokenizer import evaluate_tokenizer, main, table, windows_of
from proprio_mllm.training.sources import Clips, held_out
from robots.spec import load_robot

FRAMES = 32


class Exact(MotionTokenizer):
    """Loses nothing: its tokens are numbers of windows."""

    def encode(self, motion: torch.Tensor) -> torch.Tensor:
        self.seen = motion
        return torch.arange(motion.shape[1] // self.cfg.stride).expand(len(motion), -1) % self.cfg.codes

    def decode(self, ids: torch.Tensor) -> torch.Tensor:
        return self.seen[: len(ids)]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Clips of which at least one is held out."""
    folder = tmp_path_factory.mktemp("motion") / "clips"
    count = 1 + next(i for i in range(100) if held_out(f"{i:06d}"))
    build_clips(DataConfig(clips=count + count % 2, workers=1, mirrored=False, replay=ReplayConfig(enabled=False)), folder)
    return folder


def saved(folder: Path, kind: str = "vq") -> str:
    torch.manual_seed(0)
    cfg = MotionTokenizerConfig(quantizer=kind, window=FRAMES, codes=64, levels=(4, 4, 4), width=16, code_dim=16, depth=1)  # type: ignore[arg-type]
    tokenizer = MotionTokenizer(cfg)
    if kind == "vq":  # the first batch in training mode makes the codebook
        tokenizer.train()(torch.randn(8, FRAMES, N_FEATURES), torch.Generator().manual_seed(0))
    tokenizer.eval().save(folder / kind)
    return str(folder / kind)


def test_windows_overlap_by_half_and_short_motions_are_filled() -> None:
    motion = np.arange(10 * N_FEATURES, dtype=np.float32).reshape(10, N_FEATURES)
    assert [window[0, 0] for window in windows_of(motion, 4)] == [motion[i, 0] for i in (0, 2, 4, 6)]
    (filled,) = windows_of(motion[:3], 5)
    np.testing.assert_array_equal(filled, motion[[0, 0, 0, 1, 2]])


def test_a_tokenizer_that_loses_nothing_has_no_error(folder: Path) -> None:
    exact = Exact(MotionTokenizerConfig(window=FRAMES, codes=16, width=16, code_dim=16, depth=1)).eval()
    motion = Clips(folder).motions[0]
    windows = {"h1": np.stack(windows_of(motion, FRAMES)[:2])}
    (row,) = evaluate_tokenizer("exact", exact, {"generated": windows}, {"h1": JointAngles(load_robot("h1"))})
    assert row.metrics["mpjpe_mm"] == row.metrics["velocity_mm_s"] == row.joints_deg["h1"] == 0.0
    assert row.use.tolist() == [2] * 8 + [0] * 8
    cells = [cell.strip() for cell in table([row]).splitlines()[2].strip("|").split("|")]
    assert cells[:8] == ["exact", "vq 1 × 16", "20", "generated (2 windows)", "0.0", "0.0", "0.0", "0.0"]
    assert cells[8:11] == ["h1 0.0", "50", "8"]


def test_rows_for_every_tokenizer_and_kind_of_clips(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    calls: list[int] = []

    def real(frames: int) -> dict[str, np.ndarray]:
        calls.append(frames)
        return {"x1": np.stack(windows_of(Clips(folder).motions[1], frames)[:1])}

    monkeypatch.setattr(report, "real_windows", real)
    arguments = [saved(tmp_path), saved(tmp_path, "fsq"), f"clips={folder}"]
    assert main([*arguments, f"out={tmp_path / 't.md'}", f"figure={tmp_path / 'figures' / 'codes.png'}"]) == 0
    printed = capsys.readouterr().out
    assert (tmp_path / "t.md").read_text() == printed
    assert [line.split("|")[4].split()[0] for line in printed.splitlines()[2:]] == ["generated", "real"] * 2
    assert "h1 " in printed.splitlines()[2]
    assert "x1 " in printed.splitlines()[2]
    assert (tmp_path / "figures" / "codes.png").stat().st_size > 1000
    assert calls == [FRAMES], "real clips are retargeted once for all tokenizers of a window's length"
    monkeypatch.setattr(report, "real_windows", lambda frames: {})
    assert main([arguments[0], arguments[2]]) == 0
    assert "make motions" in capsys.readouterr().out


def test_missing_inputs_are_named(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([str(tmp_path / "none"), f"clips={folder}"]) == 1
    assert "none" in capsys.readouterr().err
    old = Path(saved(tmp_path)) / "config.json"
    old.write_text(json.dumps(json.loads(old.read_text()) | {"format": 1}))
    assert main([str(old.parent), f"clips={folder}"]) == 1
    assert "format 1" in capsys.readouterr().err
    assert main([]) == 2
