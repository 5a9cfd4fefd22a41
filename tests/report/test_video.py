"""An episode of a run as a film."""

from __future__ import annotations

from pathlib import Path

import imageio.v3 as iio
import numpy as np
import pytest

from proprio_mllm.report.stored import load_run
from proprio_mllm.report.video import main


def test_an_episode_is_filmed_from_its_trace(acted_run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "new" / "plant.mp4"
    assert main([str(acted_run), "plant", f"out={out}", "size=48", "fps=5", "cameras=[behind]"]) == 0
    frames = np.asarray(iio.imread(out, plugin="pyav"))
    assert f"{len(frames)} frames" in capsys.readouterr().out
    (record,) = load_run(acted_run).records
    held_s = 0.5 + 0.8 * (record.steps + 1) + 1.0  # the instruction, every step, the outcome; things come to rest
    assert len(frames) / 5 == pytest.approx(held_s + record.makespan_s, abs=0.8)
    moving = np.abs(np.diff(frames[:, :48].astype(int), axis=0)).mean(axis=(1, 2, 3)) > 0.05
    assert moving.sum() > 0.5 * 5 * record.makespan_s, "frames between the steps"
    assert [path.name for path in out.parent.iterdir()] == ["plant.mp4"]


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["{run}"], "expected RUN TASK"),
        (["{run}", "plant", "more"], "expected RUN TASK"),
        (["{run}", "lamp"], "no episode of task 'lamp', trial 0; allowed: plant"),
        (["{run}", "plant", "trial=3"], "trial 3"),
        (["{run}", "plant", "out=x.avi"], "out must end in .mp4, got 'x.avi'"),
        (["{run}", "plant", "cameras=[nose]"], "['nose'] must be some of head"),
        (["{run}", "plant", "size=33"], "got 33"),
        (["{run}", "plant", "fps=0"], "fps 0 outside 1..50"),
    ],
)
def test_wrong_arguments(acted_run: Path, arguments: list[str], said: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([argument.format(run=acted_run) for argument in arguments]) == 2
    assert said in capsys.readouterr().err
