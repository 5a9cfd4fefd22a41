"""A run that is watched has the same ledger as one that is not."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

import eval as evaluation
from proprio_mllm.evaluation import watching


def ledger(folder: Path) -> list[dict]:
    (path,) = folder.rglob("ledger.jsonl")
    timed = ("planner_s", "wall_s")
    return [{key: value for key, value in json.loads(line).items() if key not in timed} for line in path.open()]


def test_episodes_are_shown_and_stay_as_they_are(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(watching, "_SPEED", 1000.0)
    shown = list[str]()
    make = watching.LiveView

    class Counted(make):
        def show(self) -> None:
            shown.append(self._session.task.instruction)
            super().show()

    monkeypatch.setattr(watching, "LiveView", Counted)
    words = ["planner=scripted", "category=single", "limit=2"]
    assert evaluation.main([*words, "watch=true", f"output={tmp_path / 'watched'}"]) == 0
    told = capsys.readouterr()
    said = told.out + told.err
    assert said.count("watch: http://127.0.0.1:") == 1
    assert len(shown) == 1, "the second episode's world"
    records = ledger(tmp_path / "watched")
    for record in records:
        moved = [step["step"] for step in record["trace"] if step["duration_s"]]
        assert moved and all(f"  {text}" in said for text in moved)
    assert evaluation.main([*words, "workers=0", f"output={tmp_path / 'plain'}"]) == 0
    assert ledger(tmp_path / "plain") == records
