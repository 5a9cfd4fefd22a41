"""Step responses of the arms' and waists' servos: overshoot, settling, error. `python benchmarks/servos.py [--picture FILE]`.

Every joint in turn is told to move by 0.2 rad from rest at once, and is watched at 5 ms for a second; skills never ask for a
jump, so this is the worst case.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from sim.robots.spec import SIDES, available_robots, load_robot
from sim.scene import TIMESTEP_S
from sim.world import World

STEP_RAD = 0.2
SECONDS = 1.0


def response(robot: str, joint: str) -> np.ndarray:
    """(T,) share of the step that the joint has done."""
    world = World(load_robot(robot), "living_room_1", [])
    model = world.model
    adr = int(model.joint(joint).qposadr[0])
    world.advance(0.2)
    start, target = float(world.data.qpos[adr]), world.joint_targets()[joint]
    low, high = map(float, model.joint(joint).range)
    step = STEP_RAD if target + STEP_RAD < high else -STEP_RAD
    assert low <= target + step <= high, joint
    world.set_joint_targets({joint: target + step})
    values = []
    for _ in range(round(SECONDS / TIMESTEP_S)):
        world.advance(TIMESTEP_S)
        values.append((float(world.data.qpos[adr]) - start) / step)
    return np.array(values)


def figures(values: np.ndarray) -> dict[str, float]:
    """Overshoot, time to stay within 5 %, and what is left at the end."""
    off = np.flatnonzero(np.abs(values - values[-1]) > 0.05)
    return {
        "overshoot_percent": 100.0 * max(0.0, float(values.max() - values[-1])),
        "settles_s": TIMESTEP_S * float(off[-1] + 1 if len(off) else 0),
        "left_percent": 100.0 * abs(1.0 - float(values[-1])),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--picture", type=Path)
    arguments = parser.parse_args()
    figure = Figure(figsize=(9, 3.2), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(1, len(available_robots()), sharey=True)
    for axis, robot in zip(axes, available_robots(), strict=True):
        spec = load_robot(robot)
        for joint in (*spec.waist_joints, *(joint for side in SIDES for joint in spec.arms[side].joints)):
            values = response(robot, joint)
            row = figures(values)
            print(f"{robot} {joint:32s} " + "  ".join(f"{name} {value:.3f}" for name, value in row.items()))
            axis.plot(TIMESTEP_S * np.arange(1, len(values) + 1), values, linewidth=0.9)
        axis.set(title=robot, xlabel="seconds", ylabel="share of a step of 0.2 rad", xlim=(0, 0.6))
        axis.grid(alpha=0.3)
    if arguments.picture:
        arguments.picture.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(arguments.picture, dpi=130)


if __name__ == "__main__":
    main()
