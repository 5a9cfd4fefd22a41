"""The picture of the motion tokenizer's reconstruction."""

from __future__ import annotations

from pathlib import Path

import imageio.v3 as iio
import numpy as np
import pytest

from configs.schema.model import MotionTokenizerConfig
from data.motion import N_FEATURES, decode_key_bodies
from proprio_mllm.model.motion_tokenizer import MotionTokenizer
from proprio_mllm.report.reconstruction import main
from proprio_mllm.training.reconstruction import draw_reconstruction, draw_use, film_reconstruction, reconstruct


def test_the_figure_has_a_row_per_clip() -> None:
    tokenizer = MotionTokenizer(MotionTokenizerConfig(codes=16, code_dim=8, width=16, depth=1)).eval()
    window = np.random.default_rng(0).normal(size=(tokenizer.cfg.window, N_FEATURES)).astype(np.float32)
    truth, rebuilt = reconstruct(tokenizer, window)
    np.testing.assert_allclose(truth, decode_key_bodies(window))
    assert rebuilt.shape == truth.shape
    assert not np.allclose(rebuilt, truth)
    figure = draw_reconstruction([("h1: waves", truth, rebuilt), ("x1: waves", truth, truth)])
    titles = [axes.get_title() for axes in figure.axes]
    assert sum("x1: waves" in title and "MPJPE 0 mm" in title for title in titles) == 1
    assert len(figure.axes) == 14


def test_missing_inputs_are_named(tmp_path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([str(tmp_path / "none"), str(tmp_path)]) == 1
    assert "none" in capsys.readouterr().err
    assert main([]) == 2


def test_the_film_has_a_frame_per_frame(tmp_path: Path) -> None:
    bodies = np.random.default_rng(0).normal(scale=0.3, size=(5, 14, 3)).astype(np.float32)
    path = film_reconstruction("h1: waves", bodies, bodies + 0.05, tmp_path / "films" / "a.mp4")
    frames = iio.imread(path, plugin="pyav")
    assert len(frames) == 5
    assert list(path.parent.iterdir()) == [path]
    orange = (frames[..., 0] > 200) & (frames[..., 2] < 150)
    assert orange.any(axis=(1, 2)).all()


def test_codes_that_are_not_used_end_the_line() -> None:
    (axes,) = draw_use([("clips", np.array([0, 5, 3, 0, 2])), ("windows", np.array([1, 1, 1, 1, 1]))]).axes
    assert [len(line.get_xdata()) for line in axes.get_lines()] == [3, 5]
    assert axes.get_legend().get_texts()[0].get_text() == "clips: 60 % of 5"
