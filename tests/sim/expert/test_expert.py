"""The expert solves tasks of the simple families on both robots, in short and repeatable plans."""

import dataclasses

import numpy as np
import pytest

from interface.steps import Action, PlanStep
from sim.expert.expert import Expert
from sim.session.session import Session
from sim.tasks.task import load_benchmark

BENCHMARK = {task.id: task for task in load_benchmark()}
SIMPLE = [next(task for task in BENCHMARK.values() if task.family == family) for family in ("pick", "open", "toggle_on")]


def play(robot, task, difficulty="easy", seed=0):
    session = Session(robot, difficulty, image_size=0)
    session.reset(task, seed=seed)
    expert = Expert(session)
    expert.reset()
    while not session.finished:
        session.step(expert.next_step())
    return session


@pytest.mark.parametrize("robot", ["h1", "x1"])
@pytest.mark.parametrize("task", SIMPLE, ids=lambda task: task.family)
def test_simple_tasks_are_solved_within_their_budget(robot, task):
    session = play(robot, task)
    assert session.succeeded
    assert session.stats.steps <= task.time_limit


def test_plans_repeat():
    first, second = (play("x1", SIMPLE[0]).history for _ in range(2))
    assert first == second


def test_the_expert_recovers_from_a_perturbation_and_says_done_afterwards():
    task = dataclasses.replace(SIMPLE[1], time_limit=15)
    session = Session("x1", "easy", image_size=0)
    session.reset(task, seed=0)
    expert = Expert(session)
    expert.reset()
    session.step(expert.next_step())
    session.step(PlanStep((Action("RotateLeft", amount=90.0),)))
    while not session.finished:
        session.step(expert.next_step())
    assert session.succeeded
    assert expert.next_step().to_text() == "Done()"


def test_planning_changes_nothing():
    session = Session("x1", "easy", image_size=0)
    session.reset(SIMPLE[0], seed=0)
    expert = Expert(session)
    expert.reset()
    before = session.world.save().physics
    expert.next_step()
    after = session.world.save().physics
    for name in ("qpos", "qvel", "ctrl", "xpos", "site_xpos"):
        assert np.array_equal(getattr(before, name), getattr(after, name)), name
    assert session.stats.steps == 0


def test_the_expert_is_marked():
    assert Expert.privileged is True
