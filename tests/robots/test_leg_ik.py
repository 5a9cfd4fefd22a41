"""Crouching: over the whole range the soles are flat on the floor and the centre of mass is over the feet."""

import dataclasses

import numpy as np
import pytest

from robots.build_solver import robot_kit
from robots.crouch_table import CrouchTable
from robots.kinematics import RobotModel, root_quaternion
from robots.leg_ik import crouch, pelvis_height_range
from robots.spec import available_robots, load_robot


def _sole_errors(robot: RobotModel, height: float, pitch: float, q: np.ndarray) -> tuple[float, float]:
    """Largest height (m) of a sole's corner above or below the floor, and largest tilt (rad) of a sole."""
    soles = robot.frames(np.array([0.0, 0.0, height, *root_quaternion(0.0, pitch)]), q, ("left_sole", "right_sole"))
    half = robot.spec.foot
    corners = np.array(
        [[x, y, 0.0] for x in (-half.half_length_m, half.half_length_m) for y in (-half.half_width_m, half.half_width_m)]
    )
    heights = np.concatenate([(sole[:3, 3] + corners @ sole[:3, :3].T)[:, 2] for sole in soles])
    return float(np.abs(heights).max()), float(np.arccos(np.clip(soles[:, 2, 2], -1.0, 1.0)).max())


@pytest.mark.parametrize("name", available_robots())
def test_soles_flat_and_balanced_between_grid_points(name):
    kit = robot_kit(name)
    low, high = kit.spec.pelvis_height_range_m
    for height in np.linspace(low, high, 97):
        height_error, tilt = _sole_errors(kit.model, height, kit.crouches.pitch(height), kit.crouches.at(height).q)
        assert height_error <= 1e-3 and tilt <= 6e-3, (height, height_error, tilt)
        assert kit.crouches.at(height).balance_margin_m >= 0.05
    legs = kit.model.indices(kit.spec.leg_joints)
    for height in (low, high):
        q = kit.crouches.legs(height)
        assert np.all(q >= kit.model.lower[legs] - 1e-9) and np.all(q <= kit.model.upper[legs] + 1e-9)


@pytest.mark.parametrize("name", available_robots())
def test_legs_change_smoothly_with_height(name):
    kit = robot_kit(name)
    low, high = kit.spec.pelvis_height_range_m
    heights = np.linspace(low, high, 200)
    slope = np.diff([kit.crouches.legs(height) for height in heights], axis=0) / (heights[1] - heights[0])
    assert np.abs(slope).max() < 60.0  # rad per metre of pelvis height: 9 rad/s at 0.15 m/s


@pytest.mark.parametrize("name", available_robots())
def test_stated_height_range_is_what_the_legs_can_do(name):
    robot = RobotModel(load_robot(name))
    low, high = pelvis_height_range(robot, 0.02)
    stated_low, stated_high = robot.spec.pelvis_height_range_m
    assert low == pytest.approx(stated_low, abs=0.021) and high == pytest.approx(stated_high, abs=0.021)
    assert not crouch(robot, stated_low - 0.08).feasible
    assert crouch(robot, stated_low).feasible and crouch(robot, stated_high).feasible


def test_too_low_is_refused_by_the_table():
    spec = dataclasses.replace(load_robot("x1"), pelvis_height_range_m=(0.2, 0.22))
    with pytest.raises(ValueError, match=r"x1: pelvis heights 0\.200"):
        CrouchTable(RobotModel(spec))


def test_range_of_a_robot_that_cannot_stand():
    spec = dataclasses.replace(load_robot("x1"), standing_pelvis_height_m=1.5)
    with pytest.raises(ValueError, match=r"x1: cannot stand at 1\.5 m"):
        pelvis_height_range(RobotModel(spec), 0.5)
