"""Reach maps are computed once per machine; a cache that is broken or cannot be written changes nothing."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from robots.build_solver import robot_kit
from sim.skills import reach_map


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(reach_map, "_SAMPLES", 400)
    return tmp_path / "proprio-mllm"


def _arrays() -> dict[str, np.ndarray]:
    maps = reach_map.reach_maps.__wrapped__(robot_kit("x1"))
    return {
        f"{side}/{name}": getattr(found, name)
        for side, found in maps.items()
        for name in ("q", "positions", "x_axes", "shoulder")
    }


def _same(first: dict[str, np.ndarray], second: dict[str, np.ndarray]) -> bool:
    return all(np.array_equal(first[key], second[key]) for key in first)


def test_the_second_time_it_is_read(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    first = _arrays()
    files = list(folder.iterdir())
    assert [file.suffix for file in files] == [".npz"]
    monkeypatch.setattr(reach_map, "_sampled", lambda kit: pytest.fail("sampled again"))
    assert _same(first, _arrays())


def test_another_count_is_another_file(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    _arrays()
    monkeypatch.setattr(reach_map, "_SAMPLES", 500)
    _arrays()
    assert len(list(folder.iterdir())) == 2


def test_a_broken_file_is_computed_again(folder: Path) -> None:
    first = _arrays()
    file = next(folder.iterdir())
    for content in (b"", b"nonsense", file.read_bytes()[:200]):
        file.write_bytes(content)
        assert _same(first, _arrays())


def test_a_folder_that_cannot_be_made_does_no_harm(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").write_text("no folder")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    monkeypatch.setattr(reach_map, "_SAMPLES", 400)
    assert len(_arrays()["left/q"]) > 10
