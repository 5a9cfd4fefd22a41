"""Sampled tasks: deterministic, disjoint from the benchmark's seeds, varied, and placeable as written."""

import numpy as np
import pytest

from configs.schema.collect import TRAIN_ROOMS
from interface.bodies import PAPER_ROBOTS
from robots.spec import load_robot
from sim.tasks.families import CATEGORIES
from sim.tasks.sample import BENCHMARK_SEEDS, ROOMS, TRAIN_SEEDS, sample_task, scene_of, start_height_m
from sim.tasks.task import Task
from sim.world.facts import world_facts
from sim.world.world import World

SEED = TRAIN_SEEDS.start


@pytest.fixture(scope="module")
def tasks():
    return [sample_task(SEED + index) for index in range(20)]


def test_seeds_of_the_splits_do_not_meet():
    assert not set(BENCHMARK_SEEDS[:: len(BENCHMARK_SEEDS) - 1]) & {TRAIN_SEEDS.start, TRAIN_SEEDS[-1]}
    assert BENCHMARK_SEEDS.stop <= TRAIN_SEEDS.start
    with pytest.raises(ValueError, match="seed 5 is not a train seed"):
        sample_task(5)
    with pytest.raises(ValueError, match="not a benchmark seed"):
        sample_task(SEED, source="benchmark")


def test_a_task_is_a_function_of_its_seed(tasks):
    assert sample_task(SEED) == tasks[0]
    assert Task.from_json(tasks[0].to_json()) == tasks[0]


def test_tasks_vary(tasks):
    assert len({task.instruction for task in tasks}) >= 10
    assert len({task.family for task in tasks}) >= 4
    assert {task.room for task in tasks} == set(TRAIN_ROOMS) and {task.category for task in tasks} == set(CATEGORIES)
    assert len({tuple(task.start.pelvis_height_m.values()) for task in tasks}) == 3


def test_goals_do_not_hold_at_the_start_and_objects_stand_where_the_task_says(tasks):
    for task in tasks[:6]:
        world = World(None, task.room, task.placements, states=task.states, seed=task.seed)
        objects = world_facts(world).objects
        assert not all(goal.holds(objects) for goal in task.goals), task.id
        for placement in task.placements:
            assert placement.receptacle in world.containment.parents(placement.object_id), (task.id, placement)
            assert np.linalg.norm(world.poses.pose(placement.object_id)[:2, 3] - placement.xy) < 0.05


@pytest.mark.parametrize("robot", PAPER_ROBOTS)
def test_start_heights_are_within_the_legs_range(robot):
    low, high = load_robot(robot).pelvis_height_range_m
    heights = [start_height_m(robot, share) for share in (0.0, 0.5, 1.0)]
    assert heights[2] == high
    assert low <= heights[0] < heights[1] < heights[2]


@pytest.mark.parametrize("room", ROOMS)
def test_scenes_offer_every_kind_of_thing(room):
    scene = scene_of(room)
    for offer in (scene.surfaces, scene.containers, scene.switches, scene.small, scene.big):
        assert offer
    assert set(scene.surfaces) | set(scene.containers) | set(scene.switches) <= set(scene.furniture)


def test_impossible_wishes_are_named():
    with pytest.raises(KeyError, match="juggle"):
        sample_task(SEED, "kitchen_1", "juggle")
