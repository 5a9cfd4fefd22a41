"""Exports come back as they were written, say where they come from, and are refused when they are not what they say."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
from datasets import load_from_disk

from data.files import file_hash
from data.motion import N_FEATURES
from data.shards import decode_motion
from interface.observation import HistoryItem
from interface.steps import PlanStep
from proprio_mllm.report.export import ExportConfig as Config
from proprio_mllm.report.export import ExportError, export, main, read_sft, read_traces
from proprio_mllm.report.html import run_data
from proprio_mllm.report.sft import plan_prompt
from proprio_mllm.report.stored import load_run
from tests.report.ledgers import HOSTILE, LAMP, PLANT, failed, fine, step, write_run


@pytest.fixture
def run(tmp_path: Path) -> Path:
    tasks = [dataclasses.replace(LAMP, id=name) for name in ("good", "bad")]
    bad = [step(fine("GoTo(Mug_1)")), step(failed("Pick(left, Mug_1)", "BodyTooHigh", "body_adjustment", height_m=-0.12))]
    return write_run(tmp_path / "run", tasks, [(True, [step(fine("Pick(right, Mug_1)"), text=HOSTILE)]), (False, bad)])


def test_traces_come_back_with_their_provenance(run: Path, tmp_path: Path) -> None:
    manifest = export([run], Config("jsonl", str(tmp_path / "out")))
    traces, read = read_traces(tmp_path / "out")
    assert read == manifest and (read["episodes"], read["options"]["frames"]) == (2, "none")
    data = run_data(load_run(run), "none")
    assert [trace["episode"] for trace in traces] == [json.loads(json.dumps({**one, "frames": None})) for one in data.episodes]
    assert traces[0]["run"] == read["runs"][0] == data.about
    assert read["runs"][0]["ledger_sha256"] == file_hash(run / "ledger.jsonl")
    assert read["runs"][0]["command"] == "python eval.py planner=random"
    assert traces[0]["episode"]["trace"][0]["step"] == HOSTILE


def test_equal_runs_give_equal_traces_and_an_old_export_is_replaced(run: Path, tmp_path: Path) -> None:
    first = export([run, run], Config("jsonl", str(tmp_path / "a")))
    assert export([run, run], Config("jsonl", str(tmp_path / "b")))["files"] == first["files"]
    assert main([str(run), "format=jsonl", f"out={tmp_path}/a", "episodes=successful"]) == 0
    traces, _ = read_traces(tmp_path / "a")
    assert [trace["episode"]["task"] for trace in traces] == ["good"]


def test_an_export_never_takes_the_place_of_something_else(run: Path, tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.tex").write_text("x")
    with pytest.raises(ExportError, match="mine holds something else"):
        export([run], Config("jsonl", str(tmp_path / "mine")))
    assert (tmp_path / "mine" / "thesis.tex").read_text() == "x"


def test_unknown_versions_and_changed_files_are_refused(run: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    export([run], Config("jsonl", str(out)))
    good = (out / "export.json").read_text()
    with pytest.raises(ExportError, match="holds format 'jsonl', expected 'sft'"):
        read_sft(out)
    (out / "export.json").write_text(good.replace('"schema_version": 1', '"schema_version": 8'))
    with pytest.raises(ExportError, match="version 8 is unknown; this code reads 1"):
        read_traces(out)
    lines = (out / "episodes.jsonl").read_text().replace('{"schema_version":1', '{"schema_version":9', 1)
    (out / "episodes.jsonl").write_text(lines)
    (out / "export.json").write_text(good)
    with pytest.raises(ExportError, match=r"episodes\.jsonl: missing or changed"):
        read_traces(out)
    raw = json.loads(good)
    raw["files"]["episodes.jsonl"] = file_hash(out / "episodes.jsonl")
    (out / "export.json").write_text(json.dumps(raw))
    with pytest.raises(ExportError, match="line 1: version 9 is unknown"):
        read_traces(out)
    with pytest.raises(ExportError, match=r"export\.json is missing"):
        read_traces(tmp_path)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ([], "expected RUN [RUN ...]"),
        (["{run}", "out={tmp}/x"], "format: missing"),
        (["{run}", "out={tmp}/x", "format=csv"], "format: 'csv'"),
        (["{run}", "format=sft"], "out: missing"),
        (["{run}", "out={tmp}/x", "format=sft", "frames=all"], "frames=all is no option of format=sft"),
        (["{run}", "out={tmp}/x", "format=jsonl", "proprioception=true"], "proprioception=True is no option of format=jsonl"),
        (["{run}", "out={tmp}/x", "format=sft", "size=5"], "size 5 outside 32..1280"),
        (["{run}", "out={tmp}/x", "format=sft", "history=60"], "history 60 outside 0..50"),
        (["{run}", "out={tmp}/x", "format=sft", "workers=-1"], "workers -1 outside 0..256"),
        (["{run}/none", "out={tmp}/x", "format=sft"], "run.json is missing"),
    ],
)
def test_wrong_arguments(
    run: Path, tmp_path: Path, arguments: list[str], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([argument.format(run=run, tmp=tmp_path) for argument in arguments]) == 2
    assert said in capsys.readouterr().err
    assert not (tmp_path / "x").exists()


def test_nothing_successful_is_said(tmp_path: Path) -> None:
    run = write_run(tmp_path / "run", [LAMP], [(False, [step(fine("GoTo(Mug_1)"))])])
    with pytest.raises(ExportError, match="no episode to export: 1 scored"):
        export([run], Config("sft", str(tmp_path / "out")))
    assert not (tmp_path / "out").exists()


# ---- acted out in the simulator


def test_rows_hold_what_the_planner_saw_before_each_step(acted_run: Path, tmp_path: Path) -> None:
    config = Config("sft", str(tmp_path / "rows"), size=64, workers=0, proprioception=True)
    manifest = export([acted_run], config)
    rows, read = read_sft(tmp_path / "rows")
    assert read == manifest and (read["episodes"], read["rows"]) == (1, 3)
    assert [row["target"] for row in rows] == ["GoTo(HousePlant_1)", "MoveUp(0.05)", "Lift(HousePlant_1)"]
    assert rows["step"] == [0, 3, 4] and rows["step_success"] == [True] * 3
    last = rows[2]
    assert [item["feedback"] for item in last["history"]][2] == "Lift(HousePlant_1) BodyTooLow"
    assert last["history"][1]["feedback"].endswith("InvalidOutput")
    _, user, assistant = last["messages"]
    assert [message["role"] for message in last["messages"]] == ["system", "user", "assistant"]
    assert [part["type"] for part in user["content"]] == ["image", "text"]
    assert PLANT.instruction in user["content"][1]["text"] and "BodyTooLow" in user["content"][1]["text"]
    assert assistant["content"][0]["text"] == last["target"] == PlanStep.parse(last["target"]).to_text()
    assert "HousePlant_1" in last["visible"] and set(last["visible"]) <= set(last["known"])
    pictures = [np.asarray(row["images"][0]) for row in rows]
    assert all(picture.shape == (64, 64, 3) for picture in pictures)
    assert np.abs(pictures[0].astype(int) - pictures[1]).mean() > 2.0, "the robot has walked in between"
    assert decode_motion(last["motion"]).shape[1] == N_FEATURES and len(last["joint_positions"]) > 10
    assert load_from_disk(str(tmp_path / "rows")).column_names == rows.column_names
    data = next((tmp_path / "rows").glob("*.arrow"))
    data.write_bytes(data.read_bytes()[:-1])
    with pytest.raises(ExportError, match="missing or changed"):
        read_sft(tmp_path / "rows")


def test_failed_steps_are_rows_on_request_and_other_episodes_are_left_out(
    acted_run: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    config = Config("sft", str(tmp_path / "rows"), size=32, workers=0, steps="all", history=0)
    assert export([acted_run], config)["rows"] == 4
    rows, _ = read_sft(tmp_path / "rows")
    assert rows["step_success"] == [True, False, True, True] and "motion" not in rows.column_names
    assert "BodyTooLow" not in rows[3]["messages"][1]["content"][1]["text"]
    other = write_run(tmp_path / "other", [PLANT], [(True, [step(failed("Lift(HousePlant_1)", "Locked", "logical"))])], "h1")
    with pytest.raises(ExportError, match="none of 1 episodes could be acted out as in its ledger"):
        export([other], Config("sft", str(tmp_path / "none"), size=32, workers=0))
    assert "the ledger says Locked" in caplog.text and not (tmp_path / "none").exists()


def test_pictures_of_traces_are_files(acted_run: Path, tmp_path: Path) -> None:
    export([acted_run], Config("jsonl", str(tmp_path / "out"), size=32, workers=0, frames="all"))
    ((trace,), manifest) = read_traces(tmp_path / "out")
    frames = trace["episode"]["frames"]
    assert len(frames) == trace["episode"]["steps"] + 1 and frames[1] == frames[2]
    assert set(frames) | {"episodes.jsonl"} == set(manifest["files"])
    assert trace["episode"]["goals"][0]["since"] == 5


def test_a_prompt_by_hand() -> None:
    history = [HistoryItem(f"MoveUp(0.{n})", f"MoveUp(0.{n}) ok" if n else "") for n in range(6)]
    system, user = plan_prompt("tidy up", "h1", ["Mug_1"], ["Mug_1", "Pan_1", "Pan_2"], history, 2, 9, last=2)
    assert "GoTo(object" in system.text and user.images == 1
    assert user.text == (
        "Robot: h1. Step 3 of 9.\nTask: tidy up\nIn view: Mug_1\nKnown elsewhere: Pan_1, Pan_2\n"
        "Last steps:\nMoveUp(0.4) ok\nMoveUp(0.5) ok\nNext step?"
    )
    assert plan_prompt("tidy up", "h1", [], [], history[:1], 0, 9)[1].text.endswith("Last steps:\nMoveUp(0.0)\nNext step?")
    bare = plan_prompt("tidy up", "h1", [], [], history, 0, 9, last=0)[1].text
    assert "In view: none\nKnown elsewhere: none\nLast steps:\nnothing yet" in bare
