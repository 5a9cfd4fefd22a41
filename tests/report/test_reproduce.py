"""What a table needs, and whether published figures come out again."""

from __future__ import annotations

from pathlib import Path

import pytest

from proprio_mllm.report.stored import find_runs
from tests.report.conftest import make_record, store_run
from tools.reproduce import EXPERIMENTS, PUBLISHED, agreements, main, needed


@pytest.mark.parametrize("table", EXPERIMENTS)
def test_every_table_says_what_it_needs(table: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    wanted = list(needed(table))
    assert {one.planner for one in wanted} >= {"base", "proprio"}
    assert main([f"table={table}", "dry=true", f"output={tmp_path}"]) == 0
    printed = capsys.readouterr().out.splitlines()
    assert len(printed) == len(wanted) + 1
    runs = sum(not one.why_not for one in wanted)
    assert printed[-1].startswith(f"{runs} runs, about ") and runs >= 6


def test_what_needs_an_api_is_named_and_left_out() -> None:
    reasons = {one.planner: one.why_not for one in needed("main")}
    assert reasons["dag_plan"] == reasons["gpt4o"] == "needs a backend"
    assert not any(reasons[name] for name in ("random", "scripted", "words", "proprio", "expert"))


def test_a_rerun_agrees_within_the_published_interval(tmp_path: Path) -> None:
    for planner, robot, successes in (("words", "h1", 77), ("proprio", "h1", 40), ("random", "x1", 0)):
        folder = tmp_path / "eval" / f"{planner}-{robot}"
        folder.mkdir(parents=True)
        store_run(folder, [make_record(f"t{n}", "single", n < successes, planner=planner, robot=robot) for n in range(100)])
    text = "\n".join(
        f"| {label} | {robot} | {successes}/359 = 9 % [1, 2] | more |"
        for label, robot, successes in (
            ("language model, words alone", "H1", 279),
            ("Proprio-MLLM", "H1", 235),
            ("random legal actions", "X1", 0),
            ("scripted rules", "H1", 342),
            ("something else", "H1", 1),
        )
    )
    lines = list(agreements(find_runs(tmp_path), text))
    assert [line.split(":")[0] for line in lines] == ["words on H1", "proprio on H1", "random on X1"]
    assert [line.split()[-1] for line in lines] == ["agrees", "DIFFERS", "agrees"]


def test_the_published_table_is_read(tmp_path: Path) -> None:
    folder = tmp_path / "eval" / "expert"
    folder.mkdir(parents=True)
    store_run(folder, [make_record(f"t{n}", "single", n < 358, planner="expert") for n in range(359)])
    (line,) = agreements(find_runs(tmp_path), PUBLISHED.read_text())
    assert line.startswith("expert on H1: published 358/359") and line.endswith("here 358/359: agrees")
