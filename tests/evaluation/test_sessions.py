"""Episodes in the real simulator: the same contingencies give the same episode, and a strip acts it out again."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest

from configs.schema.eval import EvalConfig
from configs.schema.planner import BuiltInPlanner
from configs.schema.robot import RobotConfig
from interface.episode import Outcome
from proprio_mllm.evaluation.privileged import ExpertPlanner
from proprio_mllm.evaluation.run import evaluate
from proprio_mllm.evaluation.sessions import open_session
from proprio_mllm.planners.protocol import Planner, TaskInfo
from proprio_mllm.planners.random_planner import RandomPlanner
from proprio_mllm.report.stored import load_run
from proprio_mllm.report.strip import draw_strip, main, replay
from sim.tasks.predicates import Predicate
from sim.tasks.task import Placement, Start, Task, write_tasks

TASK = Task(
    id="lamp",
    room="living_room_1",
    category="single",
    family="pick",
    instruction="Pick up the mug.",
    start=Start(0.0, 0.0, 0.0, {"h1": 0.95, "x1": 0.7}),
    placements=(Placement("Mug_1", "Mug", "CoffeeTable_1"),),
    goals=(Predicate("held", "Mug_1"),),
    time_limit=3,
    split="seen",
    seed=4,
)


@pytest.fixture
def cfg(tmp_path: Path) -> EvalConfig:
    write_tasks([TASK], tmp_path / "tasks.jsonl")
    return EvalConfig(
        planner=BuiltInPlanner("random", "random", "Random"),
        robot=RobotConfig("h1"),
        workers=0,
        steps="task",
        tasks=str(tmp_path / "tasks.jsonl"),
        output=str(tmp_path / "a"),
    )


def test_same_luck_same_episode_and_a_strip_of_it(cfg: EvalConfig, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    run = evaluate(cfg)
    (record,) = run.records
    assert record.outcome is not Outcome.INFRASTRUCTURE_ERROR
    assert record.steps == 3 or record.outcome is Outcome.SUCCESS
    (again,) = evaluate(dataclasses.replace(cfg, output=str(tmp_path / "b"))).records
    assert again.trace == record.trace
    assert again.path_length_m == record.path_length_m
    frames = replay(load_run(run.folder), "lamp", size=64)
    assert len(frames) == record.steps + 1
    assert "ledger" not in caplog.text, "the replay differs"
    assert draw_strip(frames, "t", tmp_path / "strip.png", per_row=2).stat().st_size > 1000
    assert main([str(run.folder), "nothing"]) == 2
    assert main([str(tmp_path), "lamp"]) == 2
    assert main([str(run.folder)]) == 2


def test_observations_fit_every_planner_and_hide_the_world(cfg: EvalConfig) -> None:
    planner = RandomPlanner()
    assert isinstance(planner, Planner)
    session = open_session(cfg.robot, "easy", "fixed", TASK, 1, planner)
    observation = session.reset(1)
    assert observation.image.shape == (112, 112, 3)
    assert observation.proprioception.motion.shape == (64, 48)
    report = session.goals()
    assert report.met == (False,)
    assert report.unmet_objects == {"Mug_1", "CoffeeTable_1"}, "what the goal names, and where it starts"
    relations = session.relations()
    assert "Mug_1" in relations["on CoffeeTable_1"] and "Mug_1" in relations["clean"]
    assert not {"sliced", "filled", "used up"} & relations.keys()


def test_the_expert_is_privileged_and_needs_a_session() -> None:
    expert = ExpertPlanner()
    assert expert.privileged
    assert isinstance(expert, Planner)
    import numpy as np

    with pytest.raises(RuntimeError, match="attach"):
        expert.reset(TaskInfo("x", "h1", 1), np.random.default_rng(0))
