"""What a table needs, and whether published figures come out again."""

from __future__ import annotations

from pathlib import Path

import pytest

from proprio_mllm.report.stored import find_runs
from tests.report.conftest import make_record, store_run
from tools.publish import results
from tools.reproduce import EXPERIMENTS, agreements, main, needed


@pytest.mark.parametrize("table", EXPERIMENTS)
def test_every_table_says_what_it_needs(table: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    wanted = list(needed(table))
    assert {one.planner for one in wanted} >= {"base", "proprio"}
    assert main([f"table={table}", "dry=true", f"output={tmp_path}"]) == 0
    printed = capsys.readouterr().out.splitlines()
    assert len(printed) == len(wanted) + 1
    runs = sum(not one.why_not for one in wanted)
    assert printed[-1].startswith(f"{runs} runs, about ")
    assert runs >= (2 if table == "ablation" else 6)  # the variants are not released
    assert {one.planner for one in wanted if not one.why_not} >= {"base", "proprio"}


def test_what_needs_an_api_is_named_and_left_out() -> None:
    reasons = {one.planner: one.why_not for one in needed("main")}
    assert reasons["dag_plan"] == reasons["gpt4o"] == "needs a backend"
    assert not any(reasons[name] for name in ("random", "scripted", "words", "proprio", "expert"))


def test_a_rerun_agrees_within_the_published_interval(tmp_path: Path) -> None:
    for planner, robot, successes in (("words", "h1", 77), ("proprio", "h1", 40), ("random", "x1", 0)):
        folder = tmp_path / "eval" / f"{planner}-{robot}"
        folder.mkdir(parents=True)
        store_run(folder, [make_record(f"t{n}", "single", n < successes, planner=planner, robot=robot) for n in range(100)])
    rows = {"words": 279, "proprio": 235, "random": 0, "scripted": 342}
    published = {
        planner: {"planner": planner, "robot": "x1" if planner == "random" else "h1", "difficulty": "easy", "category": "all"}
        | {"reflection": "on", "rows": {"all": {"successes": n, "episodes": 359, "low": low, "high": high}}}
        for (planner, n), (low, high) in zip(rows.items(), ((0.73, 0.82), (0.6, 0.7), (0.0, 0.01), (0.93, 0.97)), strict=True)
    }
    lines = list(agreements(find_runs(tmp_path), published))
    assert [line.split()[0] for line in lines] == ["words", "proprio", "random"]  # of the rules there is no run
    assert [line.split()[-1] for line in lines] == ["agrees", "DIFFERS", "agrees"]
    assert lines[0].startswith("words h1 easy all on: published 279/359 [73%, 82%], here 77/100")


def test_what_is_published_is_found(tmp_path: Path) -> None:
    folder = tmp_path / "eval" / "scripted"
    folder.mkdir(parents=True)
    store_run(folder, [make_record(f"t{n}", "single", n < 340, planner="scripted") for n in range(359)])
    (line,) = agreements(find_runs(tmp_path), results())
    assert line.startswith("scripted h1 easy all on: published 340/359") and line.endswith("here 340/359: agrees")
