"""The benchmark file: composition, certificates, wording, and that its seeds still make it."""

import json
from collections import Counter

import pytest

from configs.schema.collect import TRAIN_ROOMS
from interface.bodies import PAPER_ROBOTS
from sim.benchmark.certificates import certificates_text, load_certificates, time_limit_of
from sim.benchmark.commands import main, rebuild
from sim.benchmark.composition import COMPOSITION
from sim.benchmark.generate import Slot, counts, moved, named_types, slots
from sim.scene.catalogue import load_catalogue
from sim.tasks.families import FAMILIES
from sim.tasks.sample import BENCHMARK_SEEDS, room_start, scene_of
from sim.tasks.task import BENCHMARK_PATH, load_benchmark, tasks_text

TASKS = load_benchmark()
CERTIFICATES = {(proof.task, proof.robot): proof for proof in load_certificates()}


def test_composition_is_the_papers_and_the_slots():
    assert Counter(task.category for task in TASKS) == {"single": 60, "optional": 166, "essential": 133}
    assert sum(share.count for share in COMPOSITION) == len(TASKS) == 359
    assert Counter(task.family for task in TASKS) == {share.family: share.count for share in COMPOSITION if share.count}
    made = {(slot.family, slot.room): slot.seeds.start for slot in slots()}
    assert all(0 <= task.seed - made[task.family, task.room] < 200 for task in TASKS)


def test_what_a_room_cannot_give_is_taken_from_the_others():
    rooms = [Slot(number, "lift", room, count) for number, (room, count) in enumerate([("a", 3), ("b", 2), ("c", 0)])]
    assert moved(rooms, {0: 3, 1: 2, 2: 0}, {"lift": 5}) == []
    more = moved(rooms, {0: 0, 1: 2, 2: 0}, {"lift": 5})
    assert [(slot.room, slot.count) for slot in more] == [("b", 4), ("c", 1)]
    rooms = [rooms[0], *more]
    last = moved(rooms, {0: 0, 1: 2, 2: 1}, {"lift": 5})
    assert [(slot.room, slot.count) for slot in last] == [("c", 3)], "neither a nor b is asked again"
    with pytest.raises(RuntimeError, match="lift: 2 of 5"):
        moved([*rooms[:2], *last], {0: 0, 1: 2, 2: 1}, {"lift": 5})
    spare = Slot(9, "lift", "d", 0, spare=True)
    assert [slot.room for slot in moved([*rooms[:2], *last, spare], {0: 0, 1: 2, 2: 1, 9: 0}, {"lift": 5})] == ["d"]
    assert [slot.room for slot in moved([*rooms, spare], {0: 0, 1: 4, 2: 1, 9: 0}, {"lift": 7})] == ["b", "c"]


def test_every_type_takes_part():
    placed = {placement.object_type for task in TASKS for placement in task.placements}
    rooms = {task.room for task in TASKS}
    furniture = {name.rsplit("_", 1)[0] for room in rooms for name in scene_of(room).furniture}
    assert placed | furniture == set(load_catalogue().types)
    assert len(set.union(*(named_types(task) for task in TASKS))) >= 50


def test_files_are_in_their_canonical_form():
    assert tasks_text(TASKS) == BENCHMARK_PATH.read_text()
    assert certificates_text(load_certificates()).count("\n") == 2 * len(TASKS)


@pytest.mark.parametrize("task", TASKS, ids=lambda task: task.id)
def test_certificates_say_what_the_category_promises(task):
    proofs = [CERTIFICATES[task.id, robot] for robot in PAPER_ROBOTS]
    steps = [len(proof.plan) for proof in proofs]
    alone = [min((n for n in proof.one_arm_steps.values() if n is not None), default=None) for proof in proofs]
    if task.category == "essential":
        assert alone == [None, None]
    else:
        assert None not in alone
    if task.category == "optional":
        assert task.time_limit < min(n for n in alone if n is not None), "one arm alone misses the budget"
    assert max(steps) <= task.time_limit == time_limit_of(steps, alone if task.category == "optional" else ())


@pytest.mark.parametrize("task", TASKS, ids=lambda task: task.id)
def test_tasks_are_worded_and_named_as_the_scene_is(task):
    assert task.split == ("seen" if task.split == "seen" and task.room in TRAIN_ROOMS else "unseen")
    assert task.seed in BENCHMARK_SEEDS and task.start == room_start(task.room)
    assert task.category == FAMILIES[task.family].category
    assert len({task.instruction, *task.paraphrases}) == 4
    everything = {placement.object_id for placement in task.placements} | set(scene_of(task.room).furniture)
    for goal in task.goals:
        assert set(goal.involved(everything)) <= everything


@pytest.mark.parametrize("task", TASKS[::30], ids=lambda task: task.id)
def test_seeds_still_make_the_tasks(task):
    assert rebuild(task) == task


def test_counts_are_printed_as_json():
    found = json.loads(json.dumps(counts(TASKS)))
    assert found["tasks"] == 359 and sum(found["room"].values()) == 359 and set(found["split"]) == {"seen", "unseen"}


def test_the_table_has_a_row_per_family_and_robot(capsys):
    assert main(["do=table"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 2 + 2 * len({task.family for task in TASKS})
    assert all(line.count("|") == 10 for line in lines)


def test_budgets():
    assert time_limit_of([3, 4]) == 8
    assert time_limit_of([40]) == 50
    assert time_limit_of([5, 6], [9, 8]) == 7
    assert time_limit_of([5, 6], [30, None]) == 11


def test_unknown_arguments_are_refused(capsys):
    assert main(["do=chek"]) == 2
    assert "'chek'" in capsys.readouterr().err
