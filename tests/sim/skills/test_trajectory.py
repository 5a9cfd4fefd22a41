"""Trajectories: bounds hold, ends are at rest, waypoints are passed."""

import numpy as np
import pytest

from sim.skills.trajectory import min_jerk, plan, plan_polyline


def _sampled(trajectory, count=801):
    times = np.linspace(0.0, trajectory.duration_s, count)
    return times, np.stack([trajectory.at(float(t)) for t in times])


@pytest.mark.parametrize("count", [2, 3, 5])
def test_velocity_and_acceleration_stay_within_bounds(count):
    rng = np.random.default_rng(count)
    waypoints = rng.uniform(-1.0, 1.0, (count, 4))
    v, a = np.array([1.0, 2.0, 0.5, 3.0]), np.array([4.0, 4.0, 2.0, 8.0])
    trajectory = plan(waypoints, v, a)
    times, positions = _sampled(trajectory)
    velocity = np.gradient(positions, times, axis=0)
    acceleration = np.gradient(velocity, times, axis=0)
    assert np.all(np.abs(velocity) <= v * 1.02)
    assert np.all(np.abs(acceleration[2:-2]) <= a * 1.05)
    assert np.abs(velocity[[0, -1]]).max() < 0.02


def test_spline_passes_its_waypoints():
    waypoints = np.array([[0.0, 0.0], [1.0, 0.5], [0.5, 2.0]])
    _, positions = _sampled(plan(waypoints, 1.0, 1.0), 4001)
    for waypoint in waypoints:
        assert np.linalg.norm(positions - waypoint, axis=1).min() < 2e-3


def test_polyline_does_not_cut_corners():
    corner = plan_polyline(np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0]]), 0.8, 1.5)
    _, positions = _sampled(corner)
    off = np.minimum(np.abs(positions[:, 1]), np.abs(positions[:, 0] - 1.0))
    assert off.max() < 1e-9
    assert corner.duration_s == pytest.approx(2.0 / 0.8 + 1.5 * 0.8 / 1.5)


@pytest.mark.parametrize("length", [0.05, 0.5, 4.0])
def test_polyline_speed_and_acceleration_are_bounded(length):
    trajectory = plan_polyline(np.array([[0.0, 0.0], [length, 0.0]]), 0.8, 1.5)
    times, positions = _sampled(trajectory, 4001)
    speed = np.gradient(positions[:, 0], times)
    assert speed.max() <= 0.8 * 1.001
    assert np.abs(np.gradient(speed, times)).max() <= 1.5 * 1.01
    assert positions[-1, 0] == pytest.approx(length)


def test_zero_length_and_minimum_duration():
    assert plan(np.zeros((2, 3)), 1.0, 1.0).duration_s == 0.0
    assert plan(np.zeros((2, 3)), 1.0, 1.0, min_duration_s=0.4).duration_s == 0.4
    assert plan_polyline(np.ones((3, 2)), 1.0, 1.0).duration_s == 0.0


def test_min_jerk_is_clamped():
    assert (min_jerk(-1.0), min_jerk(0.5), min_jerk(2.0)) == (0.0, 0.5, 1.0)


def test_bad_arguments_are_named():
    with pytest.raises(ValueError, match=r"shape \(1, 2\)"):
        plan(np.zeros((1, 2)), 1.0, 1.0)
    with pytest.raises(ValueError, match="must be positive"):
        plan_polyline(np.zeros((2, 2)), 0.0, 1.0)
