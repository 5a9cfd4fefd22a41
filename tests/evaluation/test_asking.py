"""Calls of several episodes answered together: who gets which answer, whose error is whose, and equal records."""

from __future__ import annotations

import dataclasses
import threading
from collections import deque

import numpy as np
import pytest

from configs.schema.eval import EvalConfig
from configs.schema.planner import BuiltInPlanner, FilePlanner
from configs.schema.robot import RobotConfig
from interface.episode import EpisodeRecord, Outcome
from interface.observation import Observation
from proprio_mllm.evaluation.asking import AskingPlanner, ModelDesk, answer_all, batch_planner
from proprio_mllm.evaluation.pool import run_here
from proprio_mllm.evaluation.run import evaluate
from proprio_mllm.planners.protocol import BatchPlanner, Planner, TaskInfo, parse_reply
from sim.tasks.task import write_tasks

OWN = """
from proprio_mllm.planners.protocol import parse_reply

class Own:
    privileged, image_size = False, 28
    batches = []
    broken = ""

    def begin(self, task, rng):
        return rng

    def reset(self, task, rng):
        self.rng = rng

    def step(self, observation, feedback):
        return self.step_batch([observation], [self.rng])[0]

    def step_batch(self, observations, states=None):
        Own.batches.append(len(observations))
        if any(one.step == 2 and one.instruction == Own.broken for one in observations):
            raise ValueError("too long")
        choices = ("GoTo(Mug_1)", "MoveDown(0.2)", "Pick(left, Mug_1)", "what now")
        return [parse_reply(str(rng.choice(choices)), tokens=3, latency_s=0.001) for rng in states]
"""


def plain(records) -> list[EpisodeRecord]:
    return [dataclasses.replace(record, planner_s=0.0, wall_s=0.0, message=record.message[-20:]) for record in records]


@pytest.fixture
def cfg(tmp_path, task) -> EvalConfig:
    (tmp_path / "own.py").write_text(OWN)
    write_tasks([task(f"t{i}", "single", budget=4 + i) for i in range(5)], tmp_path / "tasks.jsonl")
    planner = FilePlanner("own", "file", "Own", source=f"{tmp_path / 'own.py'}:Own")
    return EvalConfig(planner, RobotConfig("h1"), workers=0, tasks=str(tmp_path / "tasks.jsonl"), output=str(tmp_path / "out"))


def run(cfg: EvalConfig, session, tmp_path, name: str, **change):
    return evaluate(dataclasses.replace(cfg, output=str(tmp_path / name), **change), lambda setup, job, planner: session())


@pytest.mark.parametrize("batch", [2, 3, 8])
def test_episodes_side_by_side_are_the_same_episodes(cfg, session, tmp_path, batch) -> None:
    from sys import modules

    one = run(cfg, session, tmp_path, "one")
    batches = modules["planner_file_own"].Own.batches
    assert set(batches) == {1}
    batches.clear()
    several = run(cfg, session, tmp_path, "several", batch=batch)
    assert plain(several.records) == plain(one.records)
    assert max(modules["planner_file_own"].Own.batches) == min(batch, 5)
    assert len({record.steps for record in one.records}) > 1  # episodes of different length leave and join


def test_an_error_of_one_row_is_its_episodes_alone(cfg, session, tmp_path, task) -> None:
    tasks = [dataclasses.replace(task(f"t{i}", budget=5), instruction=f"task {i}") for i in range(3)]
    write_tasks(tasks, tmp_path / "tasks.jsonl")
    (tmp_path / "own.py").write_text(OWN.replace('broken = ""', 'broken = "task 1"').replace('"Pick(left, Mug_1)", ', ""))

    def opener(setup, job, planner):
        opened = session()
        look = opened.observation
        opened.observation = lambda: dataclasses.replace(look(), instruction=job.task.instruction)
        return opened

    results = [evaluate(dataclasses.replace(cfg, output=str(tmp_path / str(batch)), batch=batch), opener) for batch in (1, 3)]
    for result in results:
        assert [record.task for record in result.records] == ["t0", "t2"]
        assert [record.task for record in result.broken] == ["t1", "t1"]  # the retry breaks too
        assert all("too long" in record.message for record in result.broken)
    assert plain(results[0].records) == plain(results[1].records)


def test_broken_sessions_are_tried_again_side_by_side(cfg, session, tmp_path) -> None:
    left = {"t1": 1, "t3": 9}

    def opener(setup, job, planner):
        count = left.get(job.fields.task, 0)
        left[job.fields.task] = count - 1
        return session(broken=1 if count > 0 else None)

    (tmp_path / "own.py").write_text(OWN.replace('"what now"', '"GoTo(Table_1)"'))
    result = evaluate(dataclasses.replace(cfg, batch=3), opener)
    assert [record.task for record in result.records] == ["t0", "t1", "t2", "t4"]
    assert sorted(record.task for record in result.broken) == ["t1", "t3", "t3"]


def test_jobs_are_refilled_and_retried_in_order() -> None:
    class Echo:
        def run(self, queue: deque[int], count: int):
            while queue:
                job = queue.popleft()
                yield job, job

    results = run_here(Echo().run, [1, 2, 3], 2, lambda result: result == 2, lambda job: job, retries=2)
    assert list(results) == [1, 2, 3, 2, 2]


def test_planners_that_answer_one_at_a_time_are_refused(cfg, session, tmp_path) -> None:
    single = OWN.replace("def begin", "def start")
    (tmp_path / "own.py").write_text(single)
    with pytest.raises(ValueError, match="planner 'own' answers one episode at a time"):
        run(cfg, session, tmp_path, "x", batch=2)
    with pytest.raises(ValueError, match="batch 4 with planner kind 'random'"):
        EvalConfig(BuiltInPlanner("random", "random", "Random"), RobotConfig("h1"), batch=4)
    with pytest.raises(ValueError, match="one episode at a time"):
        batch_planner(BuiltInPlanner("random", "random", "Random"))
    for change, said in (
        ({"batch": 0}, r"batch 0 outside \[1, 1024\]"),
        ({"scheduler": "ray", "workers": 0}, "workers 0 must be positive with scheduler=ray"),
        ({"ray_address": "127.0.0.1:6379"}, "ray_address '127.0.0.1:6379' needs scheduler=ray"),
    ):
        with pytest.raises(ValueError, match=said):
            dataclasses.replace(cfg, **change)


class Slow:
    """Holds its first batch back until the other calls wait."""

    privileged, image_size = False, 28

    def __init__(self) -> None:
        self.go = threading.Event()
        self.sizes: list[int] = []

    def begin(self, task: TaskInfo, rng: np.random.Generator) -> int:
        return int(rng.integers(1000))

    def step_batch(self, observations, states=None):
        self.sizes.append(len(observations))
        assert self.go.wait(10)
        return [parse_reply(f"MoveAhead({1 + state / 1000})") for state in states]


def test_a_desk_takes_what_waits_and_answers_each_caller(session) -> None:
    planner = Slow()
    assert isinstance(planner, BatchPlanner)
    desk = ModelDesk(planner, limit=4)
    seen: Observation = session().reset(0)
    answers: dict[str, str] = {}

    def call(name: str) -> None:
        asking = AskingPlanner(desk.image_size, lambda method, *given: getattr(desk, method)(name, *given))
        assert isinstance(asking, Planner)
        asking.reset(TaskInfo("x", "h1", 1), np.random.default_rng(int(name)))
        answers[name] = asking.step(seen, None).text

    threads = [threading.Thread(target=call, args=(str(number),)) for number in range(7)]
    threads[0].start()
    while not planner.sizes:
        threads[0].join(0.001)
    for thread in threads[1:]:
        thread.start()
    while len(desk._batcher._waiting) < 6:
        threads[0].join(0.001)
    planner.go.set()
    for thread in threads:
        thread.join(10)
    assert planner.sizes == [1, 4, 2]
    assert (desk.calls, desk.batches) == (7, 3)
    expected = {str(n): f"MoveAhead({1 + int(np.random.default_rng(n).integers(1000)) / 1000})" for n in range(7)}
    assert answers == expected
    with pytest.raises(KeyError, match="caller 'nobody' has begun no episode"):
        desk.step("nobody", seen)
    with pytest.raises(ValueError, match="limit 0"):
        ModelDesk(planner, 0)


def test_answers_must_be_as_many_as_questions(session) -> None:
    class Short(Slow):
        def step_batch(self, observations, states=None):
            return []

    (answer,) = answer_all(Short(), [session().reset(0)], [0])
    assert isinstance(answer, ValueError)
    assert "gave 0 replies to 1 observations" in str(answer)
    assert answer_all(Short(), [], []) == []


def test_outcomes_are_scores(cfg, session, tmp_path) -> None:
    result = run(cfg, session, tmp_path, "x", batch=2)
    assert {record.outcome for record in result.records} <= {Outcome.SUCCESS, Outcome.FAILURE}
