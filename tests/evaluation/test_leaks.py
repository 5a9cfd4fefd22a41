"""No generator of training data builds a room, shows a type, or repeats an arrangement that the benchmark keeps for itself."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from configs.schema.collect import TRAIN_ROOMS, CollectConfig
from configs.schema.data import ReplayConfig
from data.generator import generate_clip
from data.retarget import Retargeter
from interface.bodies import PAPER_ROBOTS
from interface.steps import PlanStep
from proprio_mllm.evaluation.dagger import Rules, _lessons
from proprio_mllm.evaluation.lessons import WordsOnly
from proprio_mllm.evaluation.rollouts import training_tasks
from robots.spec import load_robot
from sim.collection.collect import rows_of_part
from sim.collection.demonstrations import lessons_of_part
from sim.collection.replay import _world, replay_clip
from sim.session.session import Session
from sim.tasks.sample import BENCHMARK_SEEDS, UNSEEN_TYPES, sample_task
from sim.tasks.task import Task, load_benchmark
from sim.world.world import World

BENCHMARK = load_benchmark()
COUNT = 4


def clips() -> None:
    for number, robot in enumerate(PAPER_ROBOTS):
        motion = Retargeter(load_robot(robot))(generate_clip(0, number)).motion
        for room in ReplayConfig().rooms:
            _world.cache_clear()
            assert replay_clip(motion, ReplayConfig(rooms=(room,), image_size=16), seed=number) is not None


def views() -> None:
    assert rows_of_part(CollectConfig("views", "unused", COUNT, image_size=16, views_per_world=1), 0)


def demonstrations() -> None:
    assert rows_of_part(CollectConfig("demos", "unused", COUNT, image_size=16), 0)


def lessons() -> None:
    assert _lessons(CollectConfig("demos", "unused", COUNT, image_size=16), 0)


def practice() -> None:
    config = CollectConfig("demos", "unused", COUNT, image_size=16)
    assert list(lessons_of_part(config, 0, Rules(), lambda observation: PlanStep.parse("MoveUp(0.05)")))


def self_learning() -> None:
    session = Session(PAPER_ROBOTS[0], image_size=0)
    for task in training_tasks(COUNT, 3):
        session.reset(task, seed=0)
    session.close()


@pytest.mark.parametrize("generate", [clips, views, demonstrations, lessons, practice, self_learning])
def test_pictures_show_training_rooms_and_types_alone(generate: Callable[[], None], monkeypatch: pytest.MonkeyPatch) -> None:
    built: list[tuple[str, set[str]]] = []
    build = World.__init__

    def watched(self: World, *args: Any, **kwargs: Any) -> None:
        build(self, *args, **kwargs)
        built.append((self.room.name, {obj.type.name for obj in self.objects.values()}))

    monkeypatch.setattr(World, "__init__", watched)
    generate()
    assert built and {room for room, _ in built} <= set(TRAIN_ROOMS)
    assert not set().union(*(types for _, types in built)) & set(UNSEEN_TYPES)


def test_episodes_in_words_play_in_training_rooms_or_in_none() -> None:
    assert {WordsOnly(seed).scene.room for seed in range(60)} <= {*TRAIN_ROOMS, "made_up"}


def placed(task: Task) -> tuple[Any, ...]:
    """Room, goals, and what stands where to 5 cm."""
    spots = sorted(
        (one.object_id, one.receptacle, *np.round(np.asarray(one.xy) / 0.05).astype(int).tolist())
        for one in task.placements
        if one.xy is not None
    )
    return task.room, json.dumps([goal.to_json() for goal in task.goals], sort_keys=True), tuple(spots)


def test_no_training_task_is_arranged_like_one_of_the_benchmark() -> None:
    kept = {placed(task) for task in BENCHMARK}
    assert len(kept) == len(BENCHMARK)
    drawn = [task for seed in range(4) for task in training_tasks(10, seed)]
    assert not kept & {placed(task) for task in drawn}
    assert all(task.seed in BENCHMARK_SEEDS for task in BENCHMARK)
    assert not any(task.seed in BENCHMARK_SEEDS for task in drawn)
    with pytest.raises(ValueError, match="is not a train seed"):
        sample_task(BENCHMARK_SEEDS[-1])


def test_unseen_means_that_training_shows_neither_room_nor_thing() -> None:
    for task in BENCHMARK:
        about = set(re.findall("[A-Z][A-Za-z]+", json.dumps([goal.to_json() for goal in task.goals])))
        assert (task.split == "unseen") == (task.room not in TRAIN_ROOMS or bool(about & set(UNSEEN_TYPES))), task.id
