"""Servos do not swing: after a jump of 0.2 rad or so a joint overshoots little, settles soon and stays."""

import numpy as np
import pytest

from benchmarks.servos import figures, groups, response, standing
from robots.spec import available_robots, load_robot
from sim.scene.compiler import TIMESTEP_S


@pytest.mark.parametrize("robot", available_robots())
def test_a_jump_is_followed_without_swinging(robot):
    world = standing(robot)
    parts = groups(load_robot(robot))
    left = [
        joint
        for part in ("waist and arms", "hands", "legs")
        for joint in parts[part]
        if "right" not in joint and "R_" not in joint
    ]
    for joint in (*left, *parts["base"]):
        values = response(world, joint)
        found = figures(values)
        assert found["overshoot_percent"] < 8.0, (joint, found)
        assert found["settles_s"] < 0.3, (joint, found)
        assert found["left_percent"] < 1.0, (joint, found)
        late = values[round(0.4 / TIMESTEP_S) :]
        assert float(np.ptp(late)) < 0.01, joint
