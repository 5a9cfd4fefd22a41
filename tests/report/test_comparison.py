"""Two runs side by side: pairs, figures in closed form, and what cannot be compared."""

from __future__ import annotations

import dataclasses
import json

import pytest

from proprio_mllm.report.commands import main
from proprio_mllm.report.comparison import compare_bodies, compare_runs, comparison_table
from proprio_mllm.report.stored import load_run


@pytest.fixture
def pair(tmp_path, store, record):
    """Two planners on 12 tasks: the first solves 9 of them, the second the last 5; content of task i is `c-i`."""

    def make(second: dict | None = None, records: dict | None = None, tasks: range = range(12)):
        def one(name: str, solved, numbers: range, change: dict):
            rows = []
            for i in numbers:
                own = {"planner": name, "config_hash": f"c-{i}", "steps": 4 if name == "a" else 6} | change
                rows.append(record(f"t{i:02d}", "single" if i % 2 else "essential", i in solved, **own))
            return rows

        a = store(tmp_path / "eval" / "a", one("a", range(9), range(12), {}))
        b = store(tmp_path / "eval" / "b", one("b", range(7, 12), tasks, records or {}), **(second or {}))
        return load_run(a), load_run(b)

    return make


def test_figures_in_closed_form(pair) -> None:
    result = compare_runs(*pair())
    success = result.rows["all"]["success"]
    assert (success.tasks, success.first, success.second) == (12, 9 / 12, 5 / 12)
    assert success.difference == pytest.approx(4 / 12)
    assert success.above == tuple(f"t{i:02d}" for i in range(7))
    assert success.below == ("t09", "t10", "t11")
    assert success.p_value == pytest.approx(2 * (1 + 10 + 45 + 120) / 2**10)  # sign test, 7 against 3
    assert success.low < success.difference < success.high
    steps = result.rows["all"]["steps"]
    assert (steps.difference, steps.low, steps.high) == (-2.0, -2.0, -2.0)
    assert result.rows["all"]["steps_both_solved"].tasks == 2  # t07, t08
    goals = result.rows["all"]["goal_conditions"]
    assert goals.difference == pytest.approx((7 * 0.5 - 3 * 0.5) / 12)
    assert list(result.rows) == ["single", "essential", "all"]
    assert result.rows["single"]["success"].tasks == 6
    assert result.left_out == 0


def test_trials_are_averaged_within_their_task(tmp_path, store, record) -> None:
    def rows(solved: list[bool]):
        return [record("t", "single", success, trial) for trial, success in enumerate(solved)]

    a = load_run(store(tmp_path / "a", rows([True, True, True, False])))
    b = load_run(store(tmp_path / "b", rows([False, True, False])))  # its fourth trial has no score
    success = compare_runs(a, b).rows["all"]["success"]
    assert (success.tasks, success.difference, success.p_value) == (1, pytest.approx(2 / 3), 1.0)
    assert compare_runs(a, b).left_out == 1


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"seed": 3}, "seed: 0 and 3"),
        ({"difficulty": "hard"}, "difficulty: 'easy' and 'hard'"),
        ({"start": "turned"}, "start: 'fixed' and 'turned'"),
        ({"contingencies": "unlucky"}, "contingencies: 'default' and 'unlucky'"),
        ({"robot": "x1"}, r"robot: 'h1' and 'x1'.*report gap"),
        ({"config": {"robot": {"name": "h1", "spec": "own.yaml"}}}, "own.yaml"),
    ],
)
def test_other_luck_is_refused_by_name(pair, change, said) -> None:
    with pytest.raises(ValueError, match=said):
        compare_runs(*pair(second=change))


def test_edited_tasks_and_edited_rules_are_refused(pair, tmp_path, store, record) -> None:
    with pytest.raises(ValueError, match="content of the tasks t00, t01, t02 and 9 more"):
        compare_runs(*pair(records={"config_hash": "c-other"}))
    runs = [
        load_run(store(tmp_path / name, [record("t", "single", True)], contingencies_hash=name)) for name in ("one", "other")
    ]
    with pytest.raises(ValueError, match="rules of 'default' were edited"):
        compare_runs(*runs)


def test_runs_of_one_name_are_told_apart_by_who_answered(pair) -> None:
    def own(digest: str) -> dict:
        return {"label": "Model", "weights": "weights/mine", "weights_digest": digest}

    first, second = pair(own("0123456789"), {})
    first = dataclasses.replace(first, metadata=first.metadata | own("abcdef0123"))
    assert [one["label"] for one in compare_runs(first, second).names] == ["Model, weights abcdef01", "Model, weights 01234567"]


def test_no_common_episode_is_refused_and_other_tasks_are_left_out(pair) -> None:
    with pytest.raises(ValueError, match="no scored episode in common"):
        compare_runs(*pair(tasks=range(20, 22)))
    assert compare_runs(*pair(tasks=range(6, 14))).left_out == 6 + 2


def test_the_gap_is_one_planner_on_two_bodies(pair) -> None:
    one, other = pair()
    with pytest.raises(ValueError, match=r"planner: 'a' and 'b'.*both runs are of 'h1'"):
        compare_bodies(one, other)
    bodies = {"planner": "a", "robot": "x1"}
    result = compare_bodies(*pair(second=bodies))
    assert result.kind == "bodies"
    assert result.rows["all"]["success"].difference == pytest.approx(4 / 12)
    assert "the contingencies of their trials are not" in " ".join(comparison_table(result).notes)


def test_command_line(pair, capsys, tmp_path) -> None:
    folders = [str(run.folder) for run in pair()]
    assert main(["compare", *folders]) == 0
    printed = capsys.readouterr().out
    assert "lost, A (h1) succeeds less often: t09, t10, t11." in printed
    assert "+33.3" in printed
    assert main(["compare", *folders, "json=true"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["rows"]["all"]["success"]["below"] == ["t09", "t10", "t11"]
    assert len(told["episodes"]) == 12
    assert told["episodes"][0]["steps"] == [4.0, 6.0]
    for ending, start in ((".md", "**A (h1)"), (".csv", "category,"), (".tex", "% needs"), (".json", "{")):
        path = tmp_path / "out" / f"table{ending}"
        assert main(["compare", *folders, f"out={path}"]) == 0
        assert path.read_text().startswith(start)
    capsys.readouterr()
    assert main(["compare", *folders, "out=table.pdf"]) == 2
    assert "out=table.pdf: endings are .md, .csv, .tex, .json" in capsys.readouterr().err
    assert main(["gap", *folders]) == 2
    assert "a gap needs two bodies" in capsys.readouterr().err
    assert main(["compare", str(tmp_path), folders[0]]) == 2
    assert "run.json is missing" in capsys.readouterr().err
    assert main(["write", folders[0]]) == 0
    assert (pair()[0].folder / "summary.json").is_file()
