"""Planning, running, resuming: equal commands give equal tables, however often they were interrupted."""

from __future__ import annotations

import dataclasses
import json
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

import configs
from configs.schema.eval import EvalConfig
from configs.schema.planner import BuiltInPlanner, FilePlanner, ModelPlanner
from configs.schema.robot import RobotConfig
from interface.episode import STEP_LIMIT, Outcome
from proprio_mllm.evaluation import run as running
from proprio_mllm.evaluation.ledger import Ledger, LedgerError, read_ledger
from proprio_mllm.evaluation.run import config_hash, evaluate, plan_episodes, run_folder, select_tasks, weights_digest
from proprio_mllm.planners.protocol import WeightsError
from proprio_mllm.report.runs import write_report
from proprio_mllm.report.stored import load_run
from sim.scene.compiler import PHYSICS
from sim.tasks.task import write_tasks

SCRIPT = Path(__file__).parent / "interrupted.py"


@pytest.fixture
def cfg(tmp_path, task) -> EvalConfig:
    path = tmp_path / "tasks.jsonl"
    write_tasks([task(f"t{i}", category) for i, category in enumerate(("single", "single", "optional", "essential"))], path)
    return EvalConfig(
        planner=BuiltInPlanner("random", "random", "Random", image_size=28),
        robot=RobotConfig("h1"),
        workers=0,
        tasks=str(path),
        output=str(tmp_path / "out"),
    )


def test_runs_every_task_once_and_continues(cfg, session) -> None:
    opened = []

    def opener(setup, job, planner):
        opened.append(job.fields.task)
        return session()

    first = evaluate(cfg, opener)
    assert sorted(opened) == ["t0", "t1", "t2", "t3"]
    assert [record.task for record in first.records] == ["t0", "t1", "t2", "t3"]
    again = evaluate(cfg, opener)
    assert len(opened) == 4
    assert again.records == first.records
    more = evaluate(dataclasses.replace(cfg, limit=1), opener)
    assert [record.task for record in more.records] == ["t0", "t2", "t3"]
    assert more.folder != first.folder


def test_weights_of_another_physics_are_told(cfg, session, tmp_path, caplog) -> None:
    weights = tmp_path / "weights"
    weights.mkdir()
    (weights / "config.json").write_text("{}")
    planner = ModelPlanner("p", "mllm", "P", str(weights), train="python train.py")
    for physics, told in ((PHYSICS, False), (PHYSICS - 1, True), (None, False)):
        (weights / "provenance.json").write_text(json.dumps({"physics": physics}))
        caplog.clear()
        running._resolved(planner, None)
        assert (f"learnt from episodes of physics {physics}, this is physics {PHYSICS}" in caplog.text) is told
    about = json.loads((evaluate(cfg, lambda *_: session()).folder / "run.json").read_text())
    assert about["physics"] == PHYSICS and about["processor"] and "commit" in about


def test_a_run_under_way_keeps_its_plan(cfg, session, tmp_path) -> None:
    other = tmp_path / "elsewhere" / "tasks.jsonl"
    other.parent.mkdir()
    other.write_text("".join(Path(cfg.tasks).read_text().splitlines(keepends=True)[:2]))
    first = evaluate(cfg, lambda setup, job, planner: session())
    plan = (first.folder / "run.json").read_text()
    with Ledger(first.folder / "ledger.jsonl"), pytest.raises(LedgerError, match="is being written by another process"):
        evaluate(dataclasses.replace(cfg, tasks=str(other)), lambda setup, job, planner: session())
    assert (first.folder / "run.json").read_text() == plan


def test_errors_are_rerun_never_scored(cfg, session) -> None:
    broken = {"t1": 1, "t2": 9}

    def opener(setup, job, planner):
        left = broken.get(job.fields.task, 0)
        broken[job.fields.task] = left - 1
        return session(broken=1 if left > 0 else None)

    run = evaluate(cfg, opener)  # one retry: t1 recovers, t2 does not
    assert [record.task for record in run.records] == ["t0", "t1", "t3"]
    assert [record.task for record in run.broken] == ["t1", "t2", "t2"]
    assert all(record.outcome is not Outcome.INFRASTRUCTURE_ERROR for record in run.records)
    table = write_report(load_run(run.folder))
    assert "1 of 4 episodes have no score" in " ".join(table.notes)
    summary = json.loads((run.folder / "summary.json").read_text())
    assert (summary["complete"], summary["infrastructure_errors"]) == (False, 3)
    broken["t2"] = 0
    assert len(evaluate(cfg, opener).records) == 4


def test_other_settings_are_other_episodes(cfg) -> None:
    tasks = select_tasks(cfg)
    jobs = plan_episodes(dataclasses.replace(cfg, trials=2), tasks, "w")
    assert len({(job.fields.task, job.fields.trial) for job in jobs}) == 8
    assert len({job.episode_seed for job in jobs}) == 8
    assert plan_episodes(cfg, tasks, "w")[0].fields != plan_episodes(cfg, tasks, "v")[0].fields
    turned = dataclasses.replace(cfg, start="turned")
    assert run_folder(turned, "w") != run_folder(cfg, "w")
    # The planner is not part of the contingencies.
    other = dataclasses.replace(cfg, planner=dataclasses.replace(cfg.planner, name="other"))
    assert plan_episodes(other, tasks, "w")[0].episode_seed == plan_episodes(cfg, tasks, "w")[0].episode_seed


def test_selection_refuses_what_is_not_there(cfg) -> None:
    with pytest.raises(ValueError, match=r"nowhere\.jsonl"):
        select_tasks(dataclasses.replace(cfg, tasks="nowhere.jsonl"))
    only = dataclasses.replace(cfg, category="essential")
    assert [task.id for task in select_tasks(only)] == ["t3"]
    path = Path(cfg.tasks)
    path.write_text("".join(path.read_text().splitlines(keepends=True)[:2]))
    with pytest.raises(ValueError, match="no task of category 'essential'"):
        select_tasks(only)


def test_settings_and_weights_are_hashed_once_and_the_hash_is_in_everything(cfg, session, monkeypatch) -> None:
    hashes = {config_hash(cfg, "w"), config_hash(cfg, "v"), config_hash(dataclasses.replace(cfg, start="turned"), "w")}
    assert len(hashes) == 3
    asked = []
    monkeypatch.setattr(running, "config_hash", lambda *given: asked.append(given) or config_hash(*given))
    run = evaluate(cfg, lambda setup, job, planner: session())
    own = config_hash(*asked[0])
    assert len(asked) == 1
    assert run.metadata["config_hash"] == own
    assert run.folder.name.endswith(f"-{own[:6]}")
    assert {record.config_hash.partition("-")[0] for record in run.records} == {own}


def test_split_takes_the_tasks_of_a_split_and_names_those_there_are(cfg, task) -> None:
    assert len(select_tasks(dataclasses.replace(cfg, split="all"))) == 4
    assert len(select_tasks(dataclasses.replace(cfg, split="seen"))) == 4
    with pytest.raises(ValueError, match="no task of split 'unseen'; its tasks are of: seen"):
        select_tasks(dataclasses.replace(cfg, split="unseen"))
    assert "unseen" in run_folder(dataclasses.replace(cfg, split="unseen"), "").name


def test_absent_weights_name_path_and_command(cfg, tmp_path) -> None:
    planner = ModelPlanner("proprio", "mllm", "P", str(tmp_path / "gone"), train="python train.py stage=all")
    with pytest.raises(WeightsError, match=r"gone.*python train\.py stage=all"):
        evaluate(dataclasses.replace(cfg, planner=planner))


OWN = """
from dataclasses import dataclass
from proprio_mllm.planners.protocol import parse_reply

@dataclass
class {name}:
    privileged: bool = False
    image_size: int = 28

    def reset(self, task, rng):
        self.steps = 0

    def step(self, observation, feedback):
        self.steps += 1
        return parse_reply("Done()" if self.steps > {steps} else "GoTo(Table_1)")
"""


def test_a_planner_in_a_file_runs_and_its_edits_count(cfg, session, tmp_path) -> None:
    path = tmp_path / "own.py"
    path.write_text(OWN.format(name="First", steps=2) + OWN.format(name="Second", steps=1))

    def run(name: str):
        planner = FilePlanner("own", "file", "Own", source=f"{path}:{name}")
        return evaluate(dataclasses.replace(cfg, planner=planner), lambda setup, job, planner: session())

    first, second = run("First"), run("Second")
    assert {record.planner for record in first.records} == {"own"}
    assert all(a.planner_calls > b.planner_calls for a, b in zip(first.records, second.records, strict=True))
    path.write_text(path.read_text() + "\n# edited\n")
    assert len({first.folder, second.folder, run("First").folder}) == 3


def test_digest_changes_with_the_files(tmp_path) -> None:
    (tmp_path / "config.json").write_text("{}")
    before = weights_digest(tmp_path)
    (tmp_path / "notes.md").write_text("x")
    assert weights_digest(tmp_path) == before
    (tmp_path / "config.json").write_text("{} ")
    assert weights_digest(tmp_path) != before


def test_killed_and_resumed_gives_the_same_table(tmp_path) -> None:
    def start(output: Path) -> subprocess.Popen:
        return subprocess.Popen([sys.executable, str(SCRIPT), str(output)], cwd=SCRIPT.parents[2], stderr=subprocess.DEVNULL)

    whole, cut = tmp_path / "whole", tmp_path / "cut"
    uninterrupted, process = start(whole), start(cut)
    deadline = time.monotonic() + 60
    while time.monotonic() < deadline and process.poll() is None:
        found = list(cut.glob("eval/*/ledger.jsonl"))
        if found and found[0].read_bytes().count(b"\n") >= 5:
            break
        time.sleep(0.01)
    process.send_signal(signal.SIGKILL)
    process.wait()
    (ledger,) = cut.glob("eval/*/ledger.jsonl")
    before = len(read_ledger(ledger))
    assert 5 <= before < 24
    assert start(cut).wait(60) == 0
    assert uninterrupted.wait(60) == 0
    (other,) = whole.glob("eval/*/ledger.jsonl")
    assert len(read_ledger(ledger)) == len(read_ledger(other)) == 24
    for name in ("table.md", "table.csv", "table.tex"):
        assert (ledger.parent / name).read_text() == (other.parent / name).read_text()
    cut_rows, whole_rows = (json.loads((path.parent / "summary.json").read_text())["rows"] for path in (ledger, other))
    timeless = [{name: value for name, value in row.items() if name != "planner_s"} for row in cut_rows]
    assert timeless == [{name: value for name, value in row.items() if name != "planner_s"} for row in whole_rows]


def test_progress_shows_what_is_left_and_success_so_far(cfg, session, capsys) -> None:
    evaluate(dataclasses.replace(cfg, limit=1), lambda setup, job, planner: session())
    shown = capsys.readouterr().err
    run = evaluate(cfg, lambda setup, job, planner: session())
    last = capsys.readouterr().err.rstrip().splitlines()[-1].split("\r")[-1]
    solved = sum(record.outcome is Outcome.SUCCESS for record in run.records)
    assert f"success {solved}/4" in last
    assert "4/4 [" in last
    assert "<" in last  # elapsed<left
    assert "random h1 easy: 100%" in last
    assert "/3" in shown


def test_contingencies_of_ones_own_are_other_results(cfg, session, tmp_path, monkeypatch) -> None:
    folder = tmp_path / "assets" / "contingency"
    folder.mkdir(parents=True)
    rules = (Path(configs.__file__).parent / "contingency" / "default.yaml").read_text()
    (folder / "unlucky.yaml").write_text(rules)
    monkeypatch.setenv("DUALTHOR_ASSETS", str(folder.parent))
    setups = []

    def opener(setup, job, planner):
        setups.append(setup.contingency)
        return session()

    evaluate(cfg, opener)
    other = dataclasses.replace(cfg, contingencies="unlucky")
    run = evaluate(other, opener)
    assert set(setups[:4]) == {"default"}
    assert set(setups[4:]) == {"unlucky"}
    assert "unlucky" in run.folder.name
    assert json.loads((run.folder / "run.json").read_text())["contingencies"] == "unlucky"
    before = config_hash(other, "")
    (folder / "unlucky.yaml").write_text(rules.replace("easy: 1.0", "easy: 0.9"))
    assert config_hash(other, "") != before
    with pytest.raises(ValueError, match=r"no contingency config 'nope'; allowed: default, unlucky"):
        evaluate(dataclasses.replace(cfg, contingencies="nope"), opener)


def test_what_ends_an_episode_and_the_physics_make_another_run(cfg, monkeypatch) -> None:
    hashes = [
        config_hash(dataclasses.replace(cfg, **change), "") for change in ({}, {"steps": "task"}, {"steps": 20}, {"stuck": 0})
    ]
    monkeypatch.setattr(running, "PHYSICS", running.PHYSICS + 1)
    hashes.append(config_hash(cfg, ""))
    assert len(set(hashes)) == 5
    assert (EvalConfig.steps, cfg.steps) == (STEP_LIMIT, STEP_LIMIT), "the paper's limit is written in two layers"
