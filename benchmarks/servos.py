"""Step responses of every servo: overshoot, settling, error. `python benchmarks/servos.py [--picture FILE]`.

Every joint in turn is told to jump by 0.2 rad (slides 2 cm, the base's slides 10 cm and its lean 0.1 rad) from rest, and is
watched at 5 ms for a second; skills never ask for a jump, so this is the worst case.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from pathlib import Path

import mujoco
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from interface.bodies import SIDES
from robots.spec import RobotSpec, available_robots, load_robot
from sim.scene.compiler import BASE_JOINTS, TIMESTEP_S
from sim.world.world import World

STEP_RAD = 0.2
SLIDE_M = 0.02
BASE_STEPS = {"base_x": 0.1, "base_y": 0.1, "base_z": -0.1, "base_yaw": 0.2, "base_pitch": 0.1}
SECONDS = 1.0


def groups(spec: RobotSpec) -> dict[str, tuple[str, ...]]:
    """A robot's joints with a servo, by part."""
    arms = [spec.arms[side] for side in SIDES]
    return {
        "waist and arms": (*spec.waist_joints, *(joint for arm in arms for joint in arm.joints)),
        "hands": tuple(joint for arm in arms for joint in arm.hand_joints),
        "legs": spec.leg_joints,
        "base": BASE_JOINTS,
    }


def response(world: World, joint: str) -> np.ndarray:
    """(T,) share of the step that the joint has done, every 5 ms; the world is at rest before and as it was afterwards."""
    model, data = world.model, world.data
    before = (data.qpos.copy(), data.qvel.copy(), data.ctrl.copy())
    adr, servo = int(model.joint(joint).qposadr[0]), int(model.actuator(joint).id)
    start, target = float(data.qpos[adr]), float(data.ctrl[servo])
    slides = int(model.joint(joint).type[0]) == int(mujoco.mjtJoint.mjJNT_SLIDE)
    step = BASE_STEPS.get(joint, SLIDE_M if slides else STEP_RAD)
    low, high = map(float, model.actuator(joint).ctrlrange)
    if low < high and not low <= target + step <= high:
        step = -step
    assert low >= high or low <= target + step <= high, joint
    data.ctrl[servo] = target + step
    values = []
    for _ in range(round(SECONDS / TIMESTEP_S)):
        mujoco.mj_step(model, data)
        values.append((float(data.qpos[adr]) - start) / step)
    data.qpos[:], data.qvel[:], data.ctrl[:] = before
    mujoco.mj_forward(model, data)
    return np.array(values)


def figures(values: np.ndarray) -> dict[str, float]:
    """Overshoot, time to stay within 5 %, and what is left at the end."""
    off = np.flatnonzero(np.abs(values - values[-1]) > 0.05)
    return {
        "overshoot_percent": 100.0 * max(0.0, float(values.max() - values[-1])),
        "settles_s": TIMESTEP_S * float(off[-1] + 1 if len(off) else 0),
        "left_percent": 100.0 * abs(1.0 - float(values[-1])),
    }


def standing(robot: str) -> World:
    """A robot at rest in a furnished room."""
    world = World(load_robot(robot), "living_room_1", [])
    world.advance(1.0)
    return world


def worst(rows: Mapping[str, Mapping[str, float]]) -> str:
    """Largest figures over some joints, with the joint that has them."""
    parts = []
    for name in ("overshoot_percent", "settles_s", "left_percent"):
        joint = max(rows, key=lambda key: rows[key][name])
        parts.append(f"{name} {rows[joint][name]:.3f} ({joint})")
    return "  ".join(parts)


def main() -> None:
    """Prints the figures of every joint and the worst of each part, and draws the responses."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--picture", type=Path)
    arguments = parser.parse_args()
    figure = Figure(figsize=(10, 4.6), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(len(available_robots()), 4, sharex=True, sharey=True)
    for row, robot in zip(axes, available_robots(), strict=True):
        world = standing(robot)
        for axis, (part, joints) in zip(row, groups(world.robot or load_robot(robot)).items(), strict=True):
            found: dict[str, dict[str, float]] = {}
            for joint in joints:
                values = response(world, joint)
                found[joint] = figures(values)
                print(f"{robot} {joint:32s} " + "  ".join(f"{name} {value:.3f}" for name, value in found[joint].items()))
                axis.plot(TIMESTEP_S * np.arange(1, len(values) + 1), values, linewidth=0.9)
            print(f"{robot} {part}, worst: {worst(found)}\n")
            axis.set(title=f"{robot}, {part}", xlim=(0, 0.6))
            axis.grid(alpha=0.3)
        row[0].set(ylabel="share of the step")
    for axis in axes[-1]:
        axis.set(xlabel="seconds")
    if arguments.picture:
        arguments.picture.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(arguments.picture, dpi=100)


if __name__ == "__main__":
    main()
