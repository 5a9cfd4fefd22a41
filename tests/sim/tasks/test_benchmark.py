"""The benchmark file: composition, certificates, wording, and that its seeds still make it."""

import json
from collections import Counter

import pytest

from sim.tasks.generate import CERTIFICATES_PATH, SLOTS, budget_of, main, rebuild
from sim.tasks.sample import BENCHMARK_SEEDS, ROBOTS, scene_of
from sim.tasks.task import BENCHMARK_PATH, load_benchmark, tasks_text

TASKS = load_benchmark()
CERTIFICATES = [json.loads(line) for line in CERTIFICATES_PATH.read_text().splitlines()]


def test_twelve_tasks_per_category_in_the_order_of_the_slots():
    assert Counter(task.category for task in TASKS) == {"single": 12, "optional": 12, "essential": 12}
    assert Counter((task.family, task.room) for task in TASKS) == {(slot.family, slot.room): slot.count for slot in SLOTS}


def test_the_file_is_in_its_canonical_form():
    assert tasks_text(TASKS) == BENCHMARK_PATH.read_text()


def test_every_task_has_a_certificate_per_robot_and_a_budget_from_both():
    steps = {(proof["task"], proof["robot"]): len(proof["plan"]) for proof in CERTIFICATES}
    assert set(steps) == {(task.id, robot) for task in TASKS for robot in ROBOTS}
    for task in TASKS:
        assert task.step_budget == budget_of([steps[task.id, robot] for robot in ROBOTS])


@pytest.mark.parametrize("task", TASKS, ids=lambda task: task.id)
def test_tasks_are_worded_and_named_as_the_scene_is(task):
    assert task.split == "benchmark"
    assert task.seed in BENCHMARK_SEEDS
    assert len({task.instruction, *task.paraphrases}) == 4
    everything = {placement.object_id for placement in task.placements} | set(scene_of(task.room).furniture)
    for goal in task.goals:
        assert set(goal.object_ids()) <= everything
    assert set(task.start.pelvis_height_m) == set(ROBOTS)


def test_two_handed_certificates_use_both_arms():
    for proof in CERTIFICATES:
        task = next(task for task in TASKS if task.id == proof["task"])
        if task.category == "essential":
            plan = " ; ".join(proof["plan"])
            assert "Lift(" in plan or ("(left" in plan and "(right" in plan), proof


@pytest.mark.parametrize("task", TASKS[::5], ids=lambda task: task.id)
def test_seeds_still_make_the_tasks(task):
    assert rebuild(task, solve=False)[0] == task


def test_budgets():
    assert budget_of([3, 4]) == 8
    assert budget_of([40]) == 50


def test_unknown_arguments_are_refused(capsys):
    assert main(["--fast"]) == 2
    assert "--fast" in capsys.readouterr().err
