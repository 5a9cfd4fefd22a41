"""The picture of the motion tokenizer's reconstruction."""

from __future__ import annotations

import numpy as np
import pytest

from configs.schema.model import MotionTokenizerConfig
from data.motion import N_FEATURES, decode_key_bodies
from proprio_mllm.model.motion_tokenizer import MotionTokenizer
from proprio_mllm.report.reconstruction import draw_reconstruction, main, reconstruct


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
