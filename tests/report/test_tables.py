"""Summaries, tables and experiments from ledgers."""

from __future__ import annotations

import csv
import dataclasses
import io
import json
from pathlib import Path

import pytest
import yaml
from rich.console import Console

from configs.schema.eval import ExperimentConfig
from interface.episode import Outcome
from interface.failures import FailureCategory
from proprio_mllm.backends.spending import Spending
from proprio_mllm.evaluation.ledger import Ledger
from proprio_mllm.report import paper
from proprio_mllm.report.experiments import EXPERIMENTS, ablation_table, assemble, main_table, replanning_table
from proprio_mllm.report.runs import newest, run_notes, run_report, write_report
from proprio_mllm.report.statistics import wilson
from proprio_mllm.report.stored import find_runs, load_run
from proprio_mllm.report.summary import rows_of
from proprio_mllm.report.table import Table, in_time_cell, rate_cell, run_table
from tests.report.ledgers import LAMP, record_of


def test_rows_count_and_add_up(record) -> None:
    records = [
        record("a", "single", True),
        record("b", "single", False, failure=FailureCategory.BODY_ADJUSTMENT),
        record("c", "essential", False, failure=FailureCategory.LOGICAL),
        record("d", "essential", False, outcome=Outcome.INFRASTRUCTURE_ERROR, failure=None),
    ]
    single, optional, essential, everything = rows_of(records)
    assert (single.successes, single.episodes, single.body_adjustment) == (1, 2, 1)
    assert (single.low, single.high) == wilson(1, 2)
    assert optional.episodes == 0
    assert optional.to_json()["success_rate"] is None
    assert (essential.episodes, essential.logical) == (1, 1)
    assert everything.category == "all"
    assert everything.navigation + everything.body_adjustment + everything.logical == everything.episodes - everything.successes
    assert everything.invalid_rate == pytest.approx(3 / 15)
    assert everything.calls == 5.0


def test_report_files_agree_and_end_with_all(tmp_path, run) -> None:
    folder = run(tmp_path)
    table = write_report(load_run(folder))
    assert [row[0] for row in table.rows] == ["single", "optional", "essential", "all"]
    summary = json.loads((folder / "summary.json").read_text())
    rows = list(csv.reader(io.StringIO((folder / "table.csv").read_text())))
    for row, cells in zip(summary["rows"], rows[1:], strict=True):
        assert cells[1].endswith(f" {row['successes']}/{row['episodes']}")
        assert cells[2].endswith(f" {row['in_time']}/{row['episodes']}")
        assert row["navigation"] + row["body_adjustment"] + row["logical"] == row["episodes"] - row["successes"]
    assert summary["complete"]
    assert summary["provenance"]["command"].startswith("python eval.py")
    markdown = (folder / "table.md").read_text().splitlines()
    assert [line for line in markdown if line.startswith("|")][-1].startswith("| all")
    buffer = io.StringIO()
    table.show(Console(file=buffer, width=140))
    assert buffer.getvalue().rstrip().splitlines()[-1].lstrip().startswith("all")


def test_a_run_over_one_category_stands_for_that_category_only(tmp_path, run, record) -> None:
    full = run(tmp_path)
    part = tmp_path / "eval" / "part"
    meta = json.loads((full / "run.json").read_text()) | {"category": "essential"}
    records = [record(f"t{task}", "essential", False, trial) for task in (2, 5, 8, 11) for trial in range(4)]
    with Ledger(part / "ledger.jsonl") as ledger:
        for one in records:
            ledger.append(one)
    meta["planned"] = [[one.task, one.category, one.trial, one.config_hash] for one in records]
    (part / "run.json").write_text(json.dumps(meta))
    runs = find_runs(tmp_path)
    chosen = [newest(runs, "random", "h1", "easy", category) for category in ("all", "single", "essential")]
    assert [one and one.folder.name for one in chosen] == [full.name, full.name, "part"]


def test_privileged_runs_say_so(tmp_path, run) -> None:
    assert any("Privileged" in note for note in write_report(load_run(run(tmp_path, "expert"))).notes)


def test_cell_layout(record) -> None:
    rows = rows_of([record(f"t{i}", "essential", i < 84) for i in range(133)])
    assert rate_cell(rows[2]) == "63.2 [54.7, 70.9] 84/133"
    assert rate_cell(rows[0]) == ""
    assert run_table("t", rows).rows[2][:2] == ("essential", "63.2 [54.7, 70.9] 84/133")


def test_latex_is_a_booktabs_table_with_every_sign_escaped() -> None:
    signs = "a_b & 5 % of $1 {x} ~ ^ # <y> \\z"
    lines = Table("50 %, h_1", ("planner", "success"), ((signs, "[1.0, 2.0]"),), ("n_1 & co",)).to_latex().splitlines()
    assert lines[1:] == [
        r"\begin{table}",
        r"\centering",
        r"\caption{50 \%, h\_1}",
        r"\begin{tabular}{lr}",
        r"\toprule",
        r"planner & success \\",
        r"\midrule",
        r"a\_b \& 5 \% of \$1 \{x\} \textasciitilde{} \textasciicircum{} \# \textless{}y\textgreater{} "
        r"\textbackslash{}z & {[1.0, 2.0]} \\",
        r"\bottomrule",
        r"\end{tabular}",
        r"\par\footnotesize n\_1 \& co",
        r"\end{table}",
    ]


def test_latex_of_a_run_holds_the_cells(tmp_path, run) -> None:
    folder = run(tmp_path)
    table = write_report(load_run(folder))
    written = (folder / "table.tex").read_text()
    assert written.count(r"\\") == len(table.rows) + 1
    assert rate_cell(load_run(folder).rows()[-1]) in written
    assert "%" not in written.replace(r"\%", "").replace("% needs", "")


def test_tables_refuse_ragged_rows() -> None:
    with pytest.raises(ValueError, match="2 cells, expected 1"):
        Table("t", ("a",), (("x", "y"),))


def test_load_refuses_what_is_no_run(tmp_path, run) -> None:
    with pytest.raises(ValueError, match=r"run\.json is missing"):
        load_run(tmp_path)
    folder = run(tmp_path)
    meta = json.loads((folder / "run.json").read_text())
    (folder / "run.json").write_text(json.dumps(meta | {"version": 7}))
    with pytest.raises(ValueError, match="version 7"):
        load_run(folder)


def test_papers_figures_are_the_files_and_consistent() -> None:
    main = paper.paper_main()
    assert main["Proprio-MLLM"]["essential", "h1"] == 63.16
    assert main["Qwen2.5-VL-7B-Ins"]["single", "x1"] == 23.33
    assert paper.paper_replanning()["DAG-Plan"]["hard"] == 15.53
    for values in paper.paper_ablation().values():  # failures add up to (1 - success) of 133 tasks x 50 trials
        failures = values["navigation"] + values["body_adjustment"] + values["logical"]
        assert failures == pytest.approx((1 - values["success_percent"] / 100) * 133 * 50, abs=30)
    for names in paper.PAPER_ROWS.values():
        tables = (paper.paper_main(), paper.paper_replanning(), paper.paper_ablation())
        assert all(name is None or name in table for name, table in zip(names, tables, strict=True))


def test_main_table_keeps_ours_and_the_papers_apart(tmp_path, run) -> None:
    run(tmp_path, "random", "h1")
    cfg = ExperimentConfig("main_table", ("random", "proprio"))
    table = main_table(cfg, find_runs(tmp_path))
    sources = [row[1] for row in table.rows]
    assert sources == ["ours", "ours"] + ["paper"] * 8
    column = table.columns.index("essential h1")
    assert "/4" in table.rows[0][column]
    assert table.rows[0][table.columns.index("essential x1")] == ""  # not run
    assert set(table.rows[1][2:]) == {""}
    assert next(row for row in table.rows if row[:2] == ("Proprio-MLLM", "paper"))[column] == "63.16"


def test_a_run_over_a_part_of_the_tasks_makes_no_row(tmp_path, run) -> None:
    served = {"kind": "openai", "name": "serve", "model": "base"}
    run(tmp_path / "a", "dag_plan", "h1", limit=3, backend=served)
    table = main_table(ExperimentConfig("main_table", ("dag_plan",)), find_runs(tmp_path / "a"))
    assert [row[0] for row in table.rows if row[1] == "ours"] == ["DAG-Plan"]
    run(tmp_path / "b", "dag_plan", "h1", backend=served)
    table = main_table(ExperimentConfig("main_table", ("dag_plan",)), find_runs(tmp_path / "b"))
    assert [row[0] for row in table.rows if row[1] == "ours"] == ["DAG-Plan (base)"]


@pytest.mark.parametrize("changed", [{"body": True}, {"parallel": False}, {"replans": 1}, {"history": 3}])
def test_a_planner_with_other_options_fills_no_cell(tmp_path, run, changed: dict) -> None:
    run(tmp_path, "dag_plan", "h1", config={"planner": {"name": "dag_plan", **changed}})
    assert newest(find_runs(tmp_path), "dag_plan", "h1", "easy") is None
    table = main_table(ExperimentConfig("main_table", ("dag_plan",)), find_runs(tmp_path))
    assert table.notes[-1].startswith("Not shown")
    assert find_runs(tmp_path)[0].title in table.notes[-1]
    run(tmp_path / "other", "dag_plan", "h1", contingencies="unlucky")
    assert newest(find_runs(tmp_path / "other"), "dag_plan", "h1", "easy") is None
    run(tmp_path / "bit", "dag_plan", "h1", config={"feedback": "bit"})
    assert newest(find_runs(tmp_path / "bit"), "dag_plan", "h1", "easy") is None
    run(tmp_path / "plain", "dag_plan", "h1", config={"planner": {"horizon": 1}})
    assert newest(find_runs(tmp_path / "plain"), "dag_plan", "h1", "easy") is not None


def test_an_unknown_planner_is_named(tmp_path, run) -> None:
    run(tmp_path, "mine", "h1")
    assemble(ExperimentConfig("main_table", ("mine", "gpt4o")), tmp_path)
    with pytest.raises(
        ValueError, match=r"experiment\.planners: 'oracle' is no planner and no run's; allowed: base, dag_plan, "
    ):
        assemble(ExperimentConfig("main_table", ("mine", "oracle")), tmp_path)


def test_what_a_run_does_otherwise_is_in_its_title(tmp_path, run) -> None:
    config = {
        "planner": {"reflection": "off", "body": True, "parallel": False},
        "trials": 3,
        "limit": 2,
        "tasks": "a/own.jsonl",
    }
    folder = run(tmp_path, config=config)
    assert load_run(folder).title.endswith(" · trials3 · limit2 · no reflection · body · one node · own")
    assert run_report(load_run(folder)).title == load_run(folder).title


def test_what_a_run_has_paid_counts_what_no_score_shows(tmp_path, run) -> None:
    folder = run(tmp_path, backend={"kind": "openai", "name": "gpt4o", "model": "gpt-4o"})
    assert not [note for note in run_notes(load_run(folder)) if "has paid" in note]
    spending = Spending(folder / "spending.sqlite", None)
    spending.settle(spending.book(0.5), 0.25)
    spending.book(0.5)
    spending.close()
    (note,) = [note for note in run_notes(load_run(folder)) if "has paid" in note]
    assert note == (
        "This run has paid 0.7500 USD so far, broken and unfinished episodes included, 0.5000 of it booked for calls whose "
        "reply never came."
    )


def test_bookings_that_cannot_be_read_do_not_cost_a_run_its_report(tmp_path, run) -> None:
    folder = run(tmp_path, backend={"kind": "openai", "name": "gpt4o", "model": "gpt-4o"})
    bookings = folder / "spending.sqlite"
    for damage in (b"no database at all, but of some length " * 40, b""):
        bookings.write_bytes(damage)
        (note,) = [note for note in run_report(load_run(folder)).notes if "paid" in note]
        assert note.startswith(f"What this run has paid cannot be read: {bookings} is ")
        assert bookings.read_bytes() == damage


def test_a_run_that_is_not_finished_says_so_in_every_table(tmp_path, run) -> None:
    ledger = run(tmp_path, "proprio", "h1") / "ledger.jsonl"
    lines = ledger.read_text().splitlines(keepends=True)
    last = next(n for n in range(len(lines) - 1, -1, -1) if '"essential"' in lines[n])
    ledger.write_text("".join(lines[:last]))
    runs = find_runs(tmp_path)
    main = main_table(ExperimentConfig("main_table", ("proprio",)), runs)
    essential = main.rows[0][main.columns.index("essential h1")]
    planned = runs[0].planned("essential")
    assert runs[0].planned("all") == len(lines)
    assert essential.endswith(f"/{planned - 1} of {planned}")
    assert " of " not in main.rows[0][main.columns.index("single h1")]
    assert replanning_table(ExperimentConfig("replanning_table", ("proprio",), ("h1",)), runs).rows[0][2] == essential
    assert ablation_table(ExperimentConfig("ablation_table", ("proprio",), ("h1",)), runs).rows[0][1] == essential


def test_ablation_and_replanning(tmp_path, run) -> None:
    run(tmp_path, "proprio", "h1", "easy")
    run(tmp_path, "proprio", "h1", "hard", seed=1)
    runs = find_runs(tmp_path)
    ablation = ablation_table(ExperimentConfig("ablation_table", ("proprio", "proprio_no_cse"), ("h1",)), runs)
    assert ablation.rows[0][1] != ""
    assert set(ablation.rows[1][1:7]) == {""}
    assert ablation.rows[1][7:] == ("45.17", "2205", "902", "538")
    again = replanning_table(ExperimentConfig("replanning_table", ("proprio",), ("h1",), ("easy", "medium", "hard")), runs)
    assert again.columns[2:6] == ("easy", "easy in time", "easy first try %", "medium")
    assert all(again.rows[0][2:4]) and all(again.rows[0][8:10])
    assert again.rows[0][5:8] == ("", "", "")


def test_tables_tell_first_tries(tmp_path, record, store) -> None:
    reached, far = (
        ({"outcomes": [{"action": "Lift(Box_1)", "ok": not code, "code": code, "contingency": ""}]},) for code in ("", "TooFar")
    )
    folder = tmp_path / "eval" / "proprio-h1-easy"
    folder.mkdir(parents=True)
    tried = [record(f"t{n}", "essential", True, planner="proprio", trace=trace) for n, trace in enumerate((reached, far, ()))]
    (run,) = [load_run(store(folder, tried))]
    cfg = ExperimentConfig("main_table", ("proprio",), ("h1",), ("easy",))
    for make in (main_table, replanning_table, ablation_table):
        table = make(cfg, [run])
        (column,) = [n for n, name in enumerate(table.columns) if name.endswith("first try %") and table.rows[0][n]]
        assert table.rows[0][column] == "50.0"


@pytest.mark.parametrize("name", EXPERIMENTS)
def test_every_experiment_is_assembled_with_and_without_runs(tmp_path, run, name, monkeypatch) -> None:
    from proprio_mllm.report import figures

    monkeypatch.setattr(figures, "load_benchmark", tuple)
    cfg = ExperimentConfig(name, ("random", "expert"))
    for _ in range(2):
        _, files = assemble(cfg, tmp_path)
        assert files
        assert all(path.stat().st_size > 100 for path in files)
        run(tmp_path)


def test_copy_of_the_papers_tables_is_whole() -> None:
    from pathlib import Path

    raw = yaml.safe_load((Path(paper.__file__).parent / "paper_tables.yaml").read_text())
    assert raw["protocol"]["tasks"] == raw["protocol"]["essential"] + raw["protocol"]["optional"] + raw["protocol"]["single"]


def test_a_damaged_neighbour_does_not_cost_a_run_its_report(tmp_path: Path, run, caplog: pytest.LogCaptureFixture) -> None:
    folder = run(tmp_path)
    other, expert = run(tmp_path, "scripted"), run(tmp_path, "expert")
    (other / "run.json").write_text("{")
    (expert / "ledger.jsonl").write_text("{}\n")
    write_report(load_run(folder))
    assert (folder / "summary.json").is_file()
    assert f"left out as a reference: {other / 'run.json'}: not JSON" in caplog.text
    assert f"left out as a reference: {expert / 'ledger.jsonl'}, line 1" in caplog.text


def test_success_in_time_is_counted_apart_from_success() -> None:
    records = [
        record_of(dataclasses.replace(LAMP, id=f"t{number}"), "h1", "c", success, [], in_time=in_time, stuck=stuck)
        for number, (success, in_time, stuck) in enumerate([(True, True, False), (True, False, False), (False, False, True)])
    ]
    row = rows_of(records)[-1]
    assert (row.successes, row.in_time, row.stuck, row.episodes) == (2, 1, 1, 3)
    assert (row.in_time_rate, row.in_time_low, row.in_time_high) == pytest.approx((1 / 3, *wilson(1, 3)))
    assert in_time_cell(row) == "33.3 [6.1, 79.2] 1/3" and rate_cell(row).endswith("2/3")


def test_a_name_draws_nothing_in_markdown() -> None:
    text = Table("t", ("a", "b"), (("x | y\n| z", "<img src=x>"), ("`code`", "plain"))).to_markdown()
    lines = text.splitlines()[2:]
    assert lines[2].replace("\\|", "").count("|") == 3 and r"x \| y \| z" in lines[2] and r"\<img src=x\>" in lines[2]
    assert r"\`code\`" in lines[3] and len({len(line) for line in lines}) == 1
