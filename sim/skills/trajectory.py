"""Smooth trajectories with bounded velocity and acceleration, for joints and for the base.

Joints follow a cubic spline through waypoints with a minimum-jerk time law
`s(t) = 10 u^3 - 15 u^4 + 6 u^5`, `u = t / T`, which starts and ends at rest with zero acceleration. The duration T is the
shortest one at which the sampled velocity and acceleration of every coordinate stay within bounds. The base
follows straight segments with smooth speed ramps. Used for the paper's "continuous transitions"; the paper names no time law.

Shape letters: N waypoints, D coordinates, S samples.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

#: Peak speed and acceleration of the minimum-jerk law for unit distance and unit duration.
_PEAK_SPEED = 1.875
_PEAK_ACCELERATION = 10.0 / np.sqrt(3.0)
_SAMPLES = 33


def min_jerk(phase: float) -> float:
    """Minimum-jerk progress in [0, 1] at `phase` = t / T, clamped to [0, 1]."""
    u = min(max(phase, 0.0), 1.0)
    return u * u * u * (10.0 - 15.0 * u + 6.0 * u * u)


@dataclass(frozen=True, slots=True)
class Trajectory:
    """Positions over time along a path.

    Attributes:
        knots: (N,) path parameter of the waypoints, from 0 to 1.
        waypoints: (N, D) coordinates.
        duration_s: time from the first waypoint to the last.
        spline: curve through the waypoints, None for two of them.
    """

    knots: NDArray[np.float64]
    waypoints: NDArray[np.float64]
    duration_s: float
    spline: CubicSpline | None = None

    def at(self, time_s: float) -> NDArray[np.float64]:
        """(D,) coordinates at a time, held at the ends outside [0, duration_s]."""
        if self.duration_s <= 0.0 or time_s >= self.duration_s:
            return self.waypoints[-1].copy()
        s = min_jerk(time_s / self.duration_s)
        if self.spline is not None:
            return np.asarray(self.spline(s), dtype=np.float64)
        return (1.0 - s) * self.waypoints[0] + s * self.waypoints[1]


def _knots(waypoints: NDArray[np.float64], scale: NDArray[np.float64]) -> NDArray[np.float64]:
    """(N,) path parameter by the waypoints' largest scaled step; repeated waypoints keep a small share."""
    steps = np.max(np.abs(np.diff(waypoints, axis=0)) / scale, axis=1)  # (N-1,)
    steps = np.maximum(steps, 1e-3 * max(float(steps.sum()), 1e-9))
    return np.concatenate([[0.0], np.cumsum(steps) / steps.sum()])


def _check(waypoints: NDArray[np.float64], velocity: NDArray[np.float64], acceleration: NDArray[np.float64]) -> None:
    if waypoints.ndim != 2 or len(waypoints) < 2 or not np.all(np.isfinite(waypoints)):
        raise ValueError(f"waypoints must be finite with shape (N >= 2, D), got shape {waypoints.shape}")
    if not (np.all(velocity > 0.0) and np.all(acceleration > 0.0)):
        raise ValueError(f"velocity and acceleration bounds must be positive, got {velocity} and {acceleration}")


def plan(
    waypoints: NDArray[np.float64],
    velocity: float | NDArray[np.float64],
    acceleration: float | NDArray[np.float64],
    min_duration_s: float = 0.0,
) -> Trajectory:
    """Plans a smooth trajectory through waypoints, at rest at both ends.

    Args:
        waypoints: (N, D) coordinates; two waypoints give the classical minimum-jerk motion.
        velocity: bound per coordinate, scalar or (D,).
        acceleration: bound per coordinate, scalar or (D,).
        min_duration_s: lower bound of the duration.

    Raises:
        ValueError: on fewer than two waypoints, values that are not finite, or bounds that are not positive.
    """
    waypoints = np.asarray(waypoints, dtype=np.float64)
    dims = waypoints.shape[-1] if waypoints.ndim == 2 else 1
    v = np.broadcast_to(np.asarray(velocity, dtype=np.float64), (dims,))
    a = np.broadcast_to(np.asarray(acceleration, dtype=np.float64), (dims,))
    _check(waypoints, v, a)
    if len(waypoints) == 2:
        distance = np.abs(waypoints[1] - waypoints[0])
        by_speed = float(np.max(_PEAK_SPEED * distance / v))
        by_acceleration = float(np.max(np.sqrt(_PEAK_ACCELERATION * distance / a)))
        knots = np.array([0.0, 1.0])
        return Trajectory(knots, waypoints, max(by_speed, by_acceleration, min_duration_s))
    knots = _knots(waypoints, v)
    spline = CubicSpline(knots, waypoints, axis=0, bc_type="clamped")
    u = np.linspace(0.0, 1.0, _SAMPLES)[:, None]  # (S, 1)
    s = u**3 * (10.0 - 15.0 * u + 6.0 * u**2)
    ds = 30.0 * u**2 * (1.0 - u) ** 2
    dds = 60.0 * u * (1.0 - 3.0 * u + 2.0 * u**2)
    first = np.asarray(spline(s[:, 0], 1))  # (S, D)
    second = np.asarray(spline(s[:, 0], 2))  # (S, D)
    by_speed = float(np.max(np.abs(first * ds) / v))
    by_acceleration = float(np.sqrt(np.max(np.abs(second * ds**2 + first * dds) / a)))
    return Trajectory(knots, waypoints, max(by_speed, by_acceleration, min_duration_s), spline)


@dataclass(frozen=True, slots=True)
class PolylineTrajectory:
    """Straight segments followed exactly: smooth acceleration, constant speed, smooth braking.

    Attributes:
        lengths_m: (N,) arc length of the waypoints from the start.
        waypoints: (N, D) coordinates.
        speed: speed of the constant part.
        ramp_s: duration of the speed-up and of the slow-down (the speed follows the smoothstep `3 u^2 - 2 u^3`).
    """

    lengths_m: NDArray[np.float64]
    waypoints: NDArray[np.float64]
    speed: float
    ramp_s: float

    @property
    def duration_s(self) -> float:
        """Time from start to end."""
        return 0.0 if self.speed <= 0.0 else float(self.lengths_m[-1]) / self.speed + self.ramp_s

    def travelled(self, time_s: float) -> float:
        """Arc length at a time."""
        total, end = float(self.lengths_m[-1]), self.duration_s
        if time_s >= end:
            return total
        if time_s > end - self.ramp_s:
            return total - self._ramp(end - time_s)
        return self._ramp(time_s) if time_s < self.ramp_s else self.speed * (time_s - 0.5 * self.ramp_s)

    def at(self, time_s: float) -> NDArray[np.float64]:
        """(D,) coordinates at a time, held at the ends."""
        arc = self.travelled(max(time_s, 0.0))
        return np.array([np.interp(arc, self.lengths_m, column) for column in self.waypoints.T])

    def _ramp(self, time_s: float) -> float:
        u = min(max(time_s / self.ramp_s, 0.0), 1.0)
        return self.speed * self.ramp_s * (u**3 - 0.5 * u**4)


def plan_polyline(waypoints: NDArray[np.float64], speed: float, acceleration: float) -> PolylineTrajectory:
    """Follows straight segments exactly, with bounded speed along the path (the base must not cut corners).

    Args:
        waypoints: (N, D) coordinates.
        speed: bound of the speed along the path.
        acceleration: bound of the acceleration along the path.

    Raises:
        ValueError: as `plan`.
    """
    waypoints = np.asarray(waypoints, dtype=np.float64)
    _check(waypoints, np.array([speed]), np.array([acceleration]))
    steps = np.linalg.norm(np.diff(waypoints, axis=0), axis=1)
    points = waypoints[np.concatenate([[True], steps > 1e-9])]
    lengths = np.concatenate([[0.0], np.cumsum(steps[steps > 1e-9])])
    total = float(lengths[-1])
    if total <= 0.0:
        return PolylineTrajectory(np.zeros(1), points[:1], 0.0, 0.0)
    top = min(speed, float(np.sqrt(total * acceleration / 1.5)))  # the ramps of a short way leave no constant part
    return PolylineTrajectory(lengths, points, top, 1.5 * top / acceleration)
