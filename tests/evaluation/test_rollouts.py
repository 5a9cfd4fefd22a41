"""Rollouts: shards that training reads back, without benchmark tasks."""

from __future__ import annotations

import dataclasses

import pytest

from configs.schema.execution import Execution
from data.shards import Manifest
from proprio_mllm.evaluation import worker as worker_module
from proprio_mllm.evaluation.rollouts import collect_rollouts
from proprio_mllm.training.rollouts import RolloutRequest, read_rollouts


@pytest.fixture
def request_(tmp_path, monkeypatch, scripted) -> RolloutRequest:
    planner = scripted("GoTo(Mug_1)", "nonsense", "MoveDown(0.2)", "Pick(left, Mug_1)")
    monkeypatch.setattr(worker_module, "make_planner", lambda cfg: planner)
    return RolloutRequest(tmp_path / "actor", tmp_path / "rollouts", 5, 3, 0.7, "hash", Execution(workers=0))


def test_rows_read_back(request_, session, task) -> None:
    tasks = [task("a", split="train"), task("b", split="train")]
    collect_rollouts(request_, tasks, opener=lambda setup, job, planner: session(job.robot.name))
    rollouts = read_rollouts(request_.folder)
    assert len(rollouts) == 5
    assert {rollout.robot for rollout in rollouts} == {"h1", "x1"}
    first = rollouts[0]
    assert first.success
    assert [moment.step for moment in first.moments] == ["GoTo(Mug_1)", "nonsense", "MoveDown(0.2)", "Pick(left, Mug_1)", ""]
    assert [moment.ok for moment in first.moments] == [True, False, True, True, True]
    assert first.moments[1].feedback == "nonsense InvalidOutput"
    assert first.relations == {"held": ["Mug_1"]}
    assert len(first.motions) == 5
    assert first.view(4).image.shape == (28, 28, 3)


def test_a_broken_episode_is_left_out_and_a_complete_folder_is_kept(request_, session, task) -> None:
    calls = []

    def opener(setup, job, planner):
        calls.append(job)
        return session(job.robot.name, broken=1 if len(calls) == 2 else None)

    tasks = [task("a", split="train")]
    collect_rollouts(request_, tasks, opener=opener)
    assert len(read_rollouts(request_.folder)) == 4
    collect_rollouts(request_, tasks, opener=opener)
    assert len(calls) == 5
    manifest = Manifest.load(request_.folder)
    assert manifest.metadata["infrastructure_errors"] == 1
    dataclasses.replace(manifest, complete=False).save(request_.folder)  # killed after the last part
    collect_rollouts(request_, tasks, opener=opener)
    assert len(calls) == 5
    assert Manifest.load(request_.folder) == manifest


def test_refuses_benchmark_tasks_and_zero_temperature(request_, task) -> None:
    with pytest.raises(ValueError, match="training tasks only, got 'bench'"):
        collect_rollouts(request_, [task("bench")])
    cold = RolloutRequest(request_.model, request_.folder, 1, 0, 0.0, "x", Execution(workers=0))
    with pytest.raises(ValueError, match=r"temperature 0\.0"):
        collect_rollouts(cold, [])
