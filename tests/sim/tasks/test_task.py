"""Task records: JSON round trip, strict validation, atomic files."""

import json

import pytest

from configs.validate import ConfigError
from sim.tasks.predicates import Predicate
from sim.tasks.task import Placement, Start, Task, TaskError, read_tasks, tasks_text, write_tasks


def make_task(**changes):
    values = {
        "id": "pick_1",
        "room": "kitchen_1",
        "category": "single",
        "family": "pick",
        "instruction": "Pick up the mug.",
        "start": Start(0.5, -1.0, 90.0, {"h1": 0.9, "x1": 0.6}),
        "placements": (Placement("Mug_1", "Mug", "CounterTop_1", (1.0, 2.0), 30.0, {"fillLiquid": 0.5}),),
        "goals": (Predicate("held", "Mug_1"),),
        "time_limit": 8,
        "split": "train",
        "seed": 3,
        "paraphrases": ("Grab the mug.",),
        "states": {"Fridge_1": {"isOpen": True}},
    }
    return Task(**(values | changes))


def test_round_trip_through_json():
    task = make_task()
    assert Task.from_json(json.loads(json.dumps(task.to_json()))) == task


def test_files_round_trip(tmp_path):
    tasks = (make_task(), make_task(id="pick_2"))
    write_tasks(tasks, tmp_path / "tasks.jsonl")
    assert read_tasks(tmp_path / "tasks.jsonl") == tasks
    assert (tmp_path / "tasks.jsonl").read_text() == tasks_text(tasks)
    assert [path.name for path in tmp_path.iterdir()] == ["tasks.jsonl"]


def test_repeated_ids_in_a_file_are_named(tmp_path):
    write_tasks((make_task(), make_task()), tmp_path / "tasks.jsonl")
    with pytest.raises(TaskError, match="pick_1"):
        read_tasks(tmp_path / "tasks.jsonl")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"placements": (Placement("Mug_1", "Mug", "A_1"),) * 2}, "Mug_1"),
        ({"goals": ()}, "at least one goal"),
        ({"instruction": " "}, "empty instruction"),
        ({"time_limit": 51}, "51"),
    ],
)
def test_bad_tasks_are_refused(changes, message):
    with pytest.raises(TaskError, match=message):
        make_task(**changes)


def test_bad_object_ids_are_refused():
    with pytest.raises(TaskError, match="Mug_0"):
        Placement("Mug_0", "Mug", "CounterTop_1")
    with pytest.raises(TaskError, match="Cup_1"):
        Placement("Cup_1", "Mug", "CounterTop_1")


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("category", "triple", "triple"),
        ("split", "test", "test"),
        ("colour", "red", "colour"),
        ("time_limit", "ten", "ten"),
        ("goals", [{"kind": "near", "object_id": "Mug_1"}], "near"),
    ],
)
def test_unknown_values_name_their_path(key, value, message):
    record = make_task().to_json() | {key: value}
    with pytest.raises(ConfigError, match=message):
        Task.from_json(record)
