"""Where an episode starts: as the task says, turned on the spot, or anywhere free in the room.

What is drawn depends on the episode's seed alone, which is a hash of (run's seed, task, robot, trial), so every planner starts
an episode from the same pose.

Paper: starts from the task's pose; the other two protocols are added here.
"""

from __future__ import annotations

import dataclasses
from typing import Final

import numpy as np

from configs.schema.eval import StartName
from proprio_mllm.evaluation.seeds import stream
from robots.spec import RobotSpec, load_robot
from sim.skills.obstacles import navigation_map
from sim.tasks.task import Start, Task
from sim.world.world import World, WorldError

#: Free distance around the robot's disc at a random start, metres; as for the benchmark's own starts.
CLEARANCE_M: Final = 0.05
_YAW_STEP_DEG: Final = 5.0
_HEIGHT_STEP_M: Final = 0.05


def started(task: Task, start: StartName, episode_seed: int, robot: str | None = None) -> Task:
    """The task with the start of an episode.

    Args:
        task: as the benchmark has it.
        start: `fixed` leaves it; `turned` draws the heading, in steps of 5 degrees; `random` draws position, heading and pelvis
            height.
        episode_seed: the episode's seed.
        robot: name or description file of the robot that acts; needed for `random`.

    Raises:
        ValueError: when `random` has no robot to find room for.
    """
    if start == "fixed":
        return task
    rng = stream(episode_seed, "start")
    if start == "turned":
        yaw_deg = _YAW_STEP_DEG * float(rng.integers(72))
        return dataclasses.replace(task, start=dataclasses.replace(task.start, yaw_deg=yaw_deg))
    if robot is None:
        raise ValueError(f"{task.id}: start='random' needs a robot to find room for, got {robot!r}")
    return dataclasses.replace(task, start=random_start(task, load_robot(robot), rng))


def random_start(task: Task, robot: RobotSpec, rng: np.random.Generator) -> Start:
    """A free pose in the task's room, from which the task's own start can be walked to.

    Position: uniform over the free cells of the navigation map (5 cm), with the robot's footprint and 5 cm around it. Heading:
    uniform, in steps of 5 degrees. Pelvis height: uniform over the robot's range, in steps of 5 cm below standing.

    Raises:
        WorldError: when there is no such place.
    """
    world = World(None, task.room, task.placements, states=task.states, seed=task.seed, settle_s=0.05)
    navigation = navigation_map(world, robot.footprint_radius_m + CLEARANCE_M)
    free = navigation.free_positions()  # (N, 2)
    costs = navigation.ways(np.array([task.start.x_m, task.start.y_m])).costs_m(free) if len(free) else np.empty(0)
    places = free[np.isfinite(costs)]
    if len(places) == 0:
        raise WorldError(f"{task.id}: no free place for {robot.name} in {task.room}")
    x_m, y_m = places[int(rng.integers(len(places)))]
    low, high = robot.pelvis_height_range_m
    heights = np.arange(high, low - 1e-9, -_HEIGHT_STEP_M)
    height = round(float(heights[int(rng.integers(len(heights)))]), 3)
    yaw_deg = _YAW_STEP_DEG * float(rng.integers(72))
    return Start(round(float(x_m), 3), round(float(y_m), 3), yaw_deg, {robot.name: height})
