"""Starts of episodes: what each protocol changes, and that a random start is a place where the robot can stand and leave."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from configs.schema.eval import EvalConfig
from configs.schema.planner import FilePlanner
from configs.schema.robot import RobotConfig
from proprio_mllm.evaluation.run import evaluate
from proprio_mllm.evaluation.seeds import episode_seed, stream
from proprio_mllm.evaluation.starts import CLEARANCE_M, random_start, started
from robots.spec import load_robot
from sim.skills.obstacles import navigation_map
from sim.tasks.task import Task, load_benchmark, write_tasks
from sim.world.world import World, WorldError

TASK = load_benchmark()[0]


def test_a_fixed_start_is_the_tasks_own() -> None:
    assert started(TASK, "fixed", 3) is TASK


def test_turned_start_changes_the_heading_only() -> None:
    turned = started(TASK, "turned", 3)
    assert turned == started(TASK, "turned", 3)
    assert (turned.start.x_m, turned.start.y_m) == (TASK.start.x_m, TASK.start.y_m)
    assert turned.start.yaw_deg % 5 == 0
    assert len({started(TASK, "turned", episode_seed).start.yaw_deg for episode_seed in range(12)}) > 4


@pytest.mark.parametrize("robot", ["h1", "x1"])
def test_random_start_is_free_and_the_same_for_the_same_episode(robot: str) -> None:
    spec = load_robot(robot)
    world = World(None, TASK.room, TASK.placements, states=TASK.states, seed=TASK.seed, settle_s=0.05)
    room = navigation_map(world, spec.footprint_radius_m + CLEARANCE_M)
    starts = []
    for trial in range(8):
        own_seed = episode_seed(0, TASK.id, robot, trial)
        drawn = started(TASK, "random", own_seed, robot)
        assert drawn == started(TASK, "random", own_seed, robot)
        assert dataclasses.replace(drawn, start=TASK.start) == TASK
        start = drawn.start
        place = np.array([start.x_m, start.y_m])
        assert room.is_free(place)
        assert room.path(place, np.array([TASK.start.x_m, TASK.start.y_m])) is not None
        low, high = spec.pelvis_height_range_m
        assert set(start.pelvis_height_m) == {robot}
        assert low <= start.pelvis_height_m[robot] <= high
        starts.append((start.x_m, start.y_m, start.yaw_deg, start.pelvis_height_m[robot]))
    for values in zip(*starts, strict=True):
        assert len(set(values)) > 3


def test_random_start_needs_a_robot_and_room() -> None:
    with pytest.raises(ValueError, match=f"{TASK.id}: start='random' needs a robot.*None"):
        started(TASK, "random", 0)
    wide = dataclasses.replace(load_robot("h1"), footprint_radius_m=9.0)
    with pytest.raises(WorldError, match=f"no free place for h1 in {TASK.room}"):
        random_start(TASK, wide, stream(0, "start"))


def test_planners_start_an_episode_from_the_same_place(tmp_path) -> None:
    """Two planners that do nothing but look: what they see at the first step is the same, and differs between trials."""
    task = dataclasses.replace(TASK, time_limit=1)
    write_tasks([task], tmp_path / "tasks.jsonl")
    first = _images(tmp_path, "one", task)
    assert len(first) == 2
    assert not np.array_equal(first[0], first[1])
    for image, again in zip(first, _images(tmp_path, "two", task), strict=True):
        np.testing.assert_array_equal(image, again)


def _images(folder, name: str, task: Task) -> list[np.ndarray]:
    seen = folder / name
    seen.mkdir()
    (folder / f"{name}.py").write_text(
        "import numpy as np\nfrom pathlib import Path\nfrom proprio_mllm.planners.protocol import parse_reply\n"
        "class Looking:\n    privileged, image_size, trials = False, 56, 0\n"
        "    def reset(self, task, rng): Looking.trials += 1\n"
        "    def step(self, observation, feedback):\n"
        f"        np.save(Path({str(seen)!r}) / str(Looking.trials), observation.image)\n"
        "        return parse_reply('Done()')\n"
    )
    planner = FilePlanner(name, "file", name, source=f"{folder / name}.py:Looking")
    cfg = EvalConfig(
        planner, RobotConfig("h1"), start="random", trials=2, workers=0, tasks=str(folder / "tasks.jsonl"), output=str(folder)
    )
    run = evaluate(cfg)
    assert [record.steps for record in run.records] == [1, 1], run.broken
    return [np.load(path) for path in sorted(seen.glob("*.npy"))]
