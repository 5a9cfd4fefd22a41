"""The doctor: a healthy machine passes, each fault is told with what to do about it, a driver that crashes is a line."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

from sim.tools import doctor
from sim.tools.doctor import CHECKS, Finding, main


def test_this_machine_draws(capsys: pytest.CaptureFixture[str]) -> None:
    assert main([]) == 0
    lines = capsys.readouterr().out.splitlines()
    told = {line.split()[1]: line for line in lines if "->" not in line}
    assert list(told) == list(CHECKS)
    assert told["python"].startswith("ok")
    assert any("draws" in told[name] or told[name].startswith("ok") for name in ("egl", "osmesa"))


def test_quiet_tells_faults_alone(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "CHECKS", {name: lambda: Finding("fine") for name in CHECKS})
    assert main(["quiet=true"]) == 0
    assert capsys.readouterr().out == ""


@pytest.mark.parametrize("code", ["import os; os.abort()", "raise RuntimeError('no display')", "import time; time.sleep(60)"])
def test_without_a_backend_the_packages_are_named(
    code: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(doctor, "_DRAW", code)
    monkeypatch.setattr(doctor, "_PATIENCE_S", 1)
    monkeypatch.setattr(doctor.ctypes.util, "find_library", lambda name: name)
    assert main(["quiet=true"]) == 1
    told = capsys.readouterr().out
    assert told.count("fault") == 2
    assert "apt-get install libegl1" in told or "MUJOCO_GL" in told


def test_a_library_that_is_not_there_is_not_tried(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor.ctypes.util, "find_library", lambda name: None)
    monkeypatch.setattr(sys, "executable", "/nowhere")
    found = doctor.examine()
    assert found["egl"] == Finding("no library libEGL", "apt-get install libegl1 libgl1-mesa-dri", True)


def test_other_and_missing_versions_are_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert not doctor._packages().remedy
    lock, project = tmp_path / "requirements.lock", tmp_path / "pyproject.toml"
    project.write_text(
        '[project]\ndependencies = ["numpy>=2"]\noptional-dependencies = {train = ["no-such-thing"], llm = [], play = []}\n'
    )
    lock.write_text("numpy==0.1\n")
    assert "numpy" in doctor._packages().found
    assert not doctor._packages().fatal
    lock.write_text(f"numpy=={np.__version__}\nno-such-thing==1.0\n")
    assert doctor._packages() == Finding("1 as pinned, without the extras train")
    project.write_text(
        '[project]\ndependencies = ["no-such-thing>1"]\noptional-dependencies = {train = [], llm = [], play = []}\n'
    )
    assert doctor._packages() == Finding("missing: no-such-thing", "run `make setup`", True)
    assert "train.py" in doctor._weights().remedy


def test_a_cache_that_cannot_be_written_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    assert "XDG_CACHE_HOME" in doctor._cache().remedy
