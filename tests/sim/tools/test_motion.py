"""Films of retargeted clips: a picture per frame, clips by number, id or file, titles that fit."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import pytest
from PIL import ImageFont

from data.generator import generate_clip, write_dataset
from data.humanml3d import DatasetError
from data.retarget import Retargeter
from robots.spec import load_robot
from sim.tools.motion import film, find_clip, main, title_lines


def test_every_frame_is_filmed_with_ground_and_figures(tmp_path: Path) -> None:
    clip = generate_clip(0, 0)
    clip = dataclasses.replace(clip, joints=clip.joints[20:26], hand_opening=None)
    path = tmp_path / "new" / "walk.mp4"
    assert film(clip, [Retargeter(load_robot("x1"))], path) == 6
    frames = np.asarray(iio.imread(path, plugin="pyav"))
    assert frames.shape == (6, 488, 640, 3)
    assert [item.name for item in path.parent.iterdir()] == ["walk.mp4"]
    figures = frames[0, 88:].astype(int)
    for panel in (figures[:, :320], figures[:, 320:]):
        floor = panel[300:, :60]  # beside the feet: chequered, so neither sky nor one colour
        assert floor.std() > 3.0 and 120 < floor.mean() < 235
        assert (panel.min(axis=2) < 110).any(axis=1).sum() > 120  # something dark stands there
    red = figures[:, :320]
    assert ((red[..., 0] - red[..., 2]) > 60).sum() > 50  # left limbs
    assert np.abs(frames[0].astype(int) - frames[-1].astype(int)).mean() > 0.1


def test_clips_by_number_id_and_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert find_clip("3", None, None).name == generate_clip(0, 3).name
    folder = write_dataset(tmp_path / "set", 2, 5)
    assert find_clip("000001", folder, None).captions == generate_clip(5, 1).captions
    with pytest.raises(DatasetError, match="not a readable array"):
        find_clip(str(tmp_path / "none.npy"), None, None)
    with pytest.raises(DatasetError, match="'walk': neither a generated clip's number"):
        find_clip("walk", None, None)
    assert main(["walk", "robots=[x1]", f"out={tmp_path}"]) == 1
    assert "'walk'" in capsys.readouterr().err


def test_titles_fit() -> None:
    font = ImageFont.load_default(15)
    assert title_lines("a person walks", 600, font) == ["a person walks"]
    lines = title_lines("walks and " * 100, 300, font)
    assert len(lines) == 3 and lines[-1].endswith(" …")
    assert all(font.getlength(line) <= 300 for line in lines)
    assert title_lines("", 300, font) == [""]
