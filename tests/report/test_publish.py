"""What is kept of a run that the docs give figures of."""

from __future__ import annotations

from pathlib import Path

import pytest

from proprio_mllm.report.stored import load_run
from tests.report.conftest import make_record, store_run
from tools import publish


def test_a_run_is_kept_task_by_task_without_its_machine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(publish, "FOLDER", tmp_path / "results")
    (tmp_path / "results").mkdir()
    solved, in_time = (True, True, False, True), (True, False, False, False)
    pairs = zip(solved, in_time, strict=True)
    records = [make_record(f"t{n}", "single", success, in_time=early) for n, (success, early) in enumerate(pairs)]
    folder = tmp_path / "random-h1-easy-abc123"
    folder.mkdir()
    store_run(folder, records, command="python eval.py planner=random robot=h1 workers=3 output=/home/me/runs")
    assert publish.main([str(folder)]) == 0
    (name, kept), *others = publish.results().items()
    assert not others and name == "random-h1-easy"
    assert kept["command"] == "python eval.py planner=random robot=h1"
    assert (kept["solved"], kept["in_time"]) == ("1101", "1000")
    assert kept["rows"]["all"]["successes"] == 3 and kept["rows"]["single"]["in_time"] == 1
    assert publish.main([str(folder), "below=seed_1"]) == 0
    assert publish.results("seed_1") == publish.results()


def test_a_run_under_way_is_not_published(tmp_path: Path) -> None:
    store_run(tmp_path, [make_record("t0", "single", True)], planned=[["t0", "single", 0, "c"], ["t1", "single", 0, "c"]])
    with pytest.raises(ValueError, match="1 of 2 episodes; a whole run is published"):
        publish.published(load_run(tmp_path))
