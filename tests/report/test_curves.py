"""Learning curves: a panel for every loop, of the loss and the shares of right answers; and what is no metrics."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

from configs.schema.train import LoggerConfig
from proprio_mllm.report.curves import draw_curves, main, read_metrics
from proprio_mllm.training.metrics import MetricWriter


@pytest.fixture
def training(tmp_path: Path) -> Path:
    for name, other in (("shared/words/loop", "exact"), ("full/alignment/text", "pairs_accuracy")):
        writer = MetricWriter(tmp_path / name, "t", LoggerConfig(wandb="disabled"))
        writer.write(20, {"loss": 4.0, "lr": 0.1})
        writer.write(40, {"loss": 2.0, other: 0.25})
        writer.write(60, {"loss": 1.0, other: 0.75})
    return tmp_path


def test_a_panel_for_every_loop(training: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture) -> None:
    drawn = {}

    def kept(loops, path: Path) -> Path:
        drawn.update(loops)
        return draw_curves(loops, path)

    monkeypatch.setattr("proprio_mllm.report.curves.draw_curves", kept)
    assert main([str(training), f"out={training / 'a' / 'curves.png'}"]) == 0
    assert capsys.readouterr().out == f"{training / 'a' / 'curves.png'}\n"
    assert (training / "a" / "curves.png").read_bytes().startswith(b"\x89PNG")
    assert list(drawn) == ["full/alignment/text", "shared/words"]
    np.testing.assert_array_equal(drawn["shared/words"]["exact"], [np.nan, 0.25, 0.75])


def test_loops_are_told_apart_and_named(training: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture) -> None:
    for name in ("a", "b"):
        shutil.copytree(training / "shared", training / "seeds" / name)
    drawn = []
    monkeypatch.setattr("proprio_mllm.report.curves.draw_curves", lambda loops, path: drawn.append(list(loops)) or path)
    for folders in (["seeds/a", "seeds/b"], ["shared/words"], ["shared/words/loop"]):
        assert main([*(str(training / folder) for folder in folders), f"out={training / 'x.png'}"]) == 0
    assert drawn == [["a/words", "b/words"], ["words"], ["loop"]]


def test_a_share_is_drawn_in_percent_and_where_it_is_known(training: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    figures = []
    monkeypatch.setattr("proprio_mllm.report.curves.save_figure", lambda figure, path, source: figures.append(figure) or path)
    draw_curves({"words": read_metrics(training / "shared/words/loop/metrics.csv")}, training / "x.png")
    loss, share = figures[0].axes
    np.testing.assert_allclose(loss.lines[0].get_xydata(), [[20, 4], [40, 2], [60, 1]])
    np.testing.assert_allclose(share.lines[0].get_xydata(), [[40, 25], [60, 75]])


@pytest.mark.parametrize("text", ["", "step,loss\n", "name,value\na,1\n", "step,loss\n20,many\n", "step,loss\n20\n"])
def test_what_is_no_metrics_is_named(tmp_path: Path, text: str, capsys: pytest.CaptureFixture) -> None:
    (tmp_path / "metrics.csv").write_text(text)
    assert main([str(tmp_path)]) == 2
    assert capsys.readouterr().err.startswith(f"{tmp_path / 'metrics.csv'}: ")


def test_a_folder_without_training(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    assert main([str(tmp_path)]) == 2
    assert "no metrics.csv here; expected a folder of training" in capsys.readouterr().err
