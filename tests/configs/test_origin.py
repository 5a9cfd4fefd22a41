"""Results say what made them."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest

from configs import origin


def git(folder: Path, *words: str) -> str:
    own = ("-c", "user.name=n", "-c", "user.email=e@e")
    return subprocess.run(["git", "-C", str(folder), *own, *words], capture_output=True, text=True, check=True).stdout.strip()


def test_a_commit_is_told_and_whether_files_differ_from_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    root = tmp_path / "checkout"
    root.mkdir()
    git(root, "init", "-q")
    (root / "a").write_text("1")
    git(root, "add", "a")
    git(root, "commit", "-qm", "first")
    monkeypatch.setattr(origin, "_ROOT", root)
    head = git(root, "rev-parse", "HEAD")
    assert origin.origin()["commit"] == head
    (root / "b").write_text("what nobody tracks")
    assert origin.origin()["commit"] == head
    (root / "a").write_text("2")
    assert origin.origin()["commit"] == f"{head}+"
    inside = root / "site-packages"
    inside.mkdir()
    monkeypatch.setattr(origin, "_ROOT", inside)
    assert origin.origin()["commit"] is None  # the commit of somebody else


def test_a_processor_is_named() -> None:
    assert origin.origin()["processor"]
