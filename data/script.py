"""A timeline on which a synthetic person walks, turns, crouches and uses both hands; it becomes a posed skeleton.

Values move along minimum-jerk curves. Steps are planned first and stance feet do not move, so that contacts are real: the body
follows its path, each foot swings to where the body will be and stays there until its next step. While one foot swings the
weight is over the other, the pelvis rises and falls with the steps and the chest turns against the legs. Nobody stands quite
still: trunk, pelvis and hands drift slowly by small amounts. And everyone has habits: how wide, how far out and how staggered
the feet stand, how the trunk and the arms hang, how long the steps are.
Axes: x forward, y left, z up. Sides: 0 left, 1 right.

Paper: none; part of the generator of motions.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Final

import numpy as np
from numpy.typing import NDArray

from data.posing import ANKLE_HEIGHT_M, ARM_LENGTH_M, FOOT_SPREAD_M, SHOULDER_HEIGHT_M, STANDING_HEIGHT_M, Channels, pose

Array = NDArray[np.float64]
_SWING_HEIGHT_M: Final = 0.075
#: Greatest slow drift of pelvis and hands (m) and of the trunk's angles (rad), and its frequencies (Hz).
_DRIFT_M: Final = 0.012
_DRIFT_RAD: Final = 0.03
_DRIFT_HZ: Final = (0.08, 0.45)
#: While walking: weight over the standing foot (m), rise and fall of the pelvis (m), chest against the swing of the hands
#: (rad/m).
_SWAY_M: Final = 0.028
_BOB_M: Final = 0.012
_COUNTER_RAD_M: Final = 0.5
#: Half the width of the shoulders (m), and how high they are above the pelvis.
_SHOULDERS_M: Final = (0.18, 0.47)


def minimum_jerk(u: Array) -> Array:
    """Minimum-jerk progress for u in [0, 1]: 10 u^3 - 15 u^4 + 6 u^5."""
    u = np.clip(u, 0.0, 1.0)
    return u**3 * (10.0 - 15.0 * u + 6.0 * u * u)


@dataclass
class Track:
    """A value over time: keys joined by minimum-jerk curves."""

    value: Array
    keys: list[tuple[float, float, Array, Array]] = field(default_factory=list)

    def move(self, start_s: float, end_s: float, value: Array) -> None:
        """Moves from the current value to `value` between two times."""
        self.keys.append((start_s, end_s, self.value, np.asarray(value, dtype=float)))
        self.value = np.asarray(value, dtype=float)

    def sample(self, times: Array) -> Array:
        """(T, N) values."""
        first = self.keys[0][2] if self.keys else self.value
        out = np.tile(first, (len(times), 1))
        for start, end, before, after in self.keys:
            u = minimum_jerk((times - start) / max(end - start, 1e-6))[:, None]
            out = np.where((times >= start)[:, None], before + u * (after - before), out)
        return out


@dataclass(frozen=True, slots=True)
class _Walk:
    start_s: float
    step_s: float
    steps: int
    distance_m: float
    direction_rad: float
    turn_rad: float
    first_foot: int


class _Habits:
    """How one person stands, hangs the arms and steps.

    Attributes:
        spread_m: from the middle of the body to each foot.
        stagger_m: how far the left foot is ahead of the middle, and the right one behind it.
        toe_out_rad: of each foot.
        lean_rad, side_rad, twist_rad: of the trunk.
        stride: length of steps as a share of the usual one.
        hip_share: how much of the chest's turn the pelvis takes.
        hip_rad_m: turn of the pelvis with the swing of the hands.
        hang: (2, 3) wrists hanging at the sides, in the base frame.
    """

    def __init__(self, rng: np.random.Generator) -> None:
        self.spread_m = float(rng.triangular(0.085, FOOT_SPREAD_M, 0.2))
        self.stagger_m = float(np.clip(rng.normal(0.0, 0.04), -0.1, 0.1))
        self.toe_out_rad = float(rng.uniform(-0.03, 0.3))
        self.lean_rad = float(np.clip(rng.normal(0.03, 0.07), -0.1, 0.2))
        self.side_rad = float(np.clip(rng.normal(0.0, 0.03), -0.08, 0.08))
        self.twist_rad = float(np.clip(rng.normal(0.0, 0.06), -0.15, 0.15))
        self.stride = float(rng.uniform(0.75, 1.2))
        self.hip_share = float(rng.uniform(0.15, 0.6))
        self.hip_rad_m = float(rng.uniform(0.1, 1.2))
        self.hang = np.stack([_hanging(rng, sign) for sign in (1.0, -1.0)])

    def foot(self, place: Array, side: int) -> Array:
        """Ankle x, y, z (m) and foot yaw (rad) of a body at x, y, yaw."""
        sign = 1.0 if side == 0 else -1.0
        x, y, yaw = place
        out, ahead = sign * self.spread_m, sign * self.stagger_m - 0.03
        return np.array(
            [
                x - out * np.sin(yaw) + ahead * np.cos(yaw),
                y + out * np.cos(yaw) + ahead * np.sin(yaw),
                ANKLE_HEIGHT_M,
                yaw + sign * self.toe_out_rad,
            ]
        )


def _hanging(rng: np.random.Generator, sign: float) -> Array:
    """A wrist of an almost straight arm that hangs a little forward and more or less out; `sign` is 1 for the left one."""
    out, ahead = min(abs(float(rng.normal(0.0, 0.18))), 0.6), float(np.clip(rng.normal(0.07, 0.09), -0.15, 0.35))
    arm = (0.94 - 0.06 * rng.random()) * ARM_LENGTH_M
    return np.array(
        [
            arm * np.sin(ahead),
            sign * (_SHOULDERS_M[0] + 0.055 + arm * np.sin(out) * np.cos(ahead)),
            SHOULDER_HEIGHT_M - arm * np.cos(out) * np.cos(ahead),
        ]
    )


class Script:
    """Collects what happens.

    Attributes:
        time_s: the end of what has been said so far.
        objs: what is handled with one hand and with two, by the number of hands.
    """

    def __init__(self, rng: np.random.Generator) -> None:
        self.rng = rng
        self.objs: dict[int, str] = {}
        self.time_s = float(rng.uniform(0.1, 0.4))
        self._height = Track(np.array([STANDING_HEIGHT_M + rng.uniform(-0.02, 0.01)]))
        self._standing = float(self._height.value[0])
        self._lean = Track(np.array([rng.uniform(0.0, 0.06)]))
        self._side = Track(np.zeros(1))
        self._twist = Track(np.zeros(1))
        elbows = rng.uniform(-0.15, 0.35, size=2)
        self._elbows = elbows
        self._swivel = [Track(elbows[:1].copy()), Track(elbows[1:].copy())]
        self._drift = _Drift(rng)
        self._habits = _Habits(rng)
        self._hands = [Track(wrist.copy()) for wrist in self._habits.hang]
        self._free = [Track(np.ones(1)), Track(np.ones(1))]
        self._opening = [Track(np.array([0.6])), Track(np.array([0.6]))]
        self._walks: list[_Walk] = []

    def wait(self, seconds: float) -> None:
        """Nothing new happens for a while."""
        self.time_s += seconds

    def walk(self, distance_m: float, direction_rad: float = 0.0, turn_rad: float = 0.0, pace: float = 1.0) -> None:
        """Steps along a direction relative to the heading (0 ahead), turning on the way; `pace` stretches or shortens steps."""
        stride = 0.37 * self._habits.stride
        if abs(np.cos(direction_rad)) <= 0.7:  # sideways one foot must not step over the other
            stride = min(0.68 * stride, max(2.0 * self._habits.spread_m - 0.1, 0.1))
        steps = max(2, int(np.ceil(max(distance_m / stride, abs(turn_rad) / float(self.rng.uniform(0.45, 0.75))))))
        first = int(self.rng.integers(2))
        if abs(turn_rad) > 0.2:
            first = 0 if turn_rad > 0 else 1
        elif abs(np.sin(direction_rad)) > 0.7:
            first = 0 if np.sin(direction_rad) > 0 else 1
        walk = _Walk(self.time_s, 0.56 / pace, steps, distance_m, direction_rad, turn_rad, first)
        self._walks.append(walk)
        self.time_s += walk.step_s * (steps + 1)

    def posture(self, drop_m: float, lean_rad: float, seconds: float, advance: bool = True) -> None:
        """Lowers the pelvis by `drop_m` below standing and leans the trunk."""
        end = self.time_s + seconds
        self._height.move(self.time_s, end, np.array([self._standing - drop_m]))
        self._lean.move(self.time_s, end, np.array([lean_rad]))
        if advance:
            self.time_s = end

    def trunk(self, twist_rad: float, side_rad: float, seconds: float, advance: bool = True) -> None:
        """Turns the chest to the left of the pelvis and leans it to the right."""
        end = self.time_s + seconds
        self._twist.move(self.time_s, end, np.array([twist_rad]))
        self._side.move(self.time_s, end, np.array([side_rad]))
        if advance:
            self.time_s = end

    def elbow(self, side: int, raise_rad: float, seconds: float) -> None:
        """Raises one elbow outwards by this much above its habit, while time goes on elsewhere."""
        self._swivel[side].move(self.time_s, self.time_s + seconds, np.array([self._elbows[side] + raise_rad]))

    def hand(self, side: int, wrist: Array | None, seconds: float, advance: bool = True) -> None:
        """Moves one wrist to a point of the base frame, or lets it hang (None)."""
        end = self.time_s + seconds
        target = self._habits.hang[side] if wrist is None else wrist
        self._hands[side].move(self.time_s, end, target)
        self._free[side].move(self.time_s, end, np.array([float(wrist is None)]))
        if advance:
            self.time_s = end

    def hand_path(self, side: int, wrists: list[Array], seconds: float) -> None:
        """Moves one wrist on through points of the base frame in one minimum-jerk sweep; time does not advance."""
        self._free[side].move(self.time_s, self.time_s + seconds, np.zeros(1))
        wrists = [self._hands[side].value, *wrists]
        share = np.linspace(0.0, 1.0, 13)
        places = minimum_jerk(share) * (len(wrists) - 1)
        points = np.stack([np.interp(places, np.arange(len(wrists)), np.array(wrists)[:, axis]) for axis in range(3)], axis=1)
        for k in range(1, len(share)):
            track = self._hands[side]
            track.keys.append(
                (self.time_s + share[k - 1] * seconds, self.time_s + share[k] * seconds, points[k - 1], points[k])
            )
            track.value = points[k]

    def grip(self, side: int, opening: float, seconds: float = 0.3) -> None:
        """Opens (1) or closes (0) one hand while time goes on elsewhere."""
        self._opening[side].move(self.time_s, self.time_s + seconds, np.array([opening]))

    def reach_posture(self, wrists: list[Array]) -> tuple[float, float]:
        """Smallest drop (m) and lean (rad) with which the shoulders reach all wrists."""
        best, choice = np.inf, (0.42, 1.0)
        for lean in np.arange(0.0, 1.25, 0.1):
            for drop in np.arange(0.0, 0.43, 0.06):
                forward = 0.21 * np.sin(lean) + 0.105 * np.sin(0.35 * lean) - 0.025
                shoulder = np.array([forward, 0.0, self._standing - drop + 0.105 * np.cos(0.35 * lean) + 0.37 * np.cos(lean)])
                away = max(
                    float(np.linalg.norm(wrist - shoulder - np.array([0.0, 0.18 * np.sign(wrist[1]), 0.0]))) for wrist in wrists
                )
                cost = lean + 2.0 * drop + 40.0 * max(0.0, away - 0.94 * ARM_LENGTH_M)
                if cost < best:
                    best, choice = cost, (float(drop), float(lean))
        return choice

    def render(self, fps: float) -> tuple[Array, Array]:
        """Joint positions (T, 22, 3) and hand opening (T, 2) up to the current time."""
        times = np.arange(int(np.ceil(self.time_s * fps)) + 1) / fps
        base, feet, swing, weight, bob = self._locomotion(times)
        drift = self._drift.sample(times)
        habits = self._habits
        lean = self._lean.sample(times)[:, 0] + habits.lean_rad + _DRIFT_RAD * drift[:, 0]
        side_lean = self._side.sample(times)[:, 0] + habits.side_rad + _DRIFT_RAD * drift[:, 1]
        twist = self._twist.sample(times)[:, 0] + habits.twist_rad + 2.0 * _DRIFT_RAD * drift[:, 2]
        hip = habits.hip_share * twist + 2.0 * _DRIFT_RAD * drift[:, 13]
        hip -= habits.hip_rad_m * 0.5 * (swing[:, 1] - swing[:, 0])  # the hip goes ahead with its leg
        twist += _COUNTER_RAD_M * 0.5 * (swing[:, 1] - swing[:, 0])
        sway = np.column_stack([np.zeros_like(weight), weight]) + _DRIFT_M * drift[:, 3:5]
        height = self._height.sample(times)[:, 0] + bob
        # Hanging hands go with the shoulders.
        half, above = _SHOULDERS_M
        sink = height - self._standing + 0.37 * (np.cos(lean) - 1.0)
        ahead = 0.21 * np.sin(lean) + 0.1 * np.sin(0.35 * lean)
        left = sway[:, 1] - (above - 0.08) * np.sin(side_lean)
        carried = np.stack(
            [
                np.column_stack([ahead - sign * half * np.sin(twist), left, sink - sign * 0.5 * half * np.sin(side_lean)])
                for sign in (1.0, -1.0)
            ],
            axis=1,
        )
        hands = np.stack([track.sample(times) for track in self._hands], axis=1)
        free = np.stack([track.sample(times) for track in self._free], axis=1)
        hands += free * carried + _DRIFT_M * drift[:, 5:11].reshape(-1, 2, 3)
        hands[:, :, 0] += free[:, :, 0] * swing
        hands[:, :, 2] += free[:, :, 0] * 0.25 * np.abs(swing)
        swivel = np.concatenate([track.sample(times) for track in self._swivel], axis=1) + 0.1 * drift[:, 11:13]
        opening = np.concatenate([track.sample(times) for track in self._opening], axis=1)
        return pose(Channels(base, height, lean, side_lean, twist, hip, sway, feet, hands, swivel)), opening

    def _locomotion(self, times: Array) -> tuple[Array, Array, Array, Array, Array]:
        """Base (T, 3), feet (T, 2, 4), swing of the hands (T, 2), shift of the weight to the left (T,), rise (T,)."""
        base = np.zeros((len(times), 3))
        swing = np.zeros((len(times), 2))
        weight, bob = np.zeros(len(times)), np.zeros(len(times))
        place = np.zeros(3)
        feet = [Track(self._habits.foot(place, side)) for side in (0, 1)]
        lift = np.zeros((len(times), 2))
        for walk in self._walks:
            duration = walk.step_s * walk.steps
            start, path = place.copy(), _path(walk, place)
            for step in range(walk.steps + 1):
                side = (walk.first_foot + step) % 2
                begin = walk.start_s + step * walk.step_s
                landing = path(min((step + 1.5) * walk.step_s / duration, 1.0))
                feet[side].move(begin + 0.08 * walk.step_s, begin + 0.86 * walk.step_s, self._habits.foot(landing, side))
                u = np.clip((times - begin - 0.08 * walk.step_s) / (0.78 * walk.step_s), 0.0, 1.0)
                lift[:, side] += _SWING_HEIGHT_M * np.sin(np.pi * u) ** 2
                phase_of = np.clip((times - begin) / walk.step_s, 0.0, 1.0)
                weight += _SWAY_M * (1.0 if side == 1 else -1.0) * np.sin(np.pi * phase_of) ** 2  # over the other foot
                bob -= _BOB_M * 0.5 * (1.0 - np.cos(2.0 * np.pi * phase_of))
                now = (times >= begin) & (times < begin + walk.step_s)
                phase = np.cos(np.pi * (times[now] - begin) / walk.step_s)
                width = 0.42 * (walk.distance_m / duration) * max(np.cos(walk.direction_rad), 0.0) * walk.step_s
                fade = 0.5 if step in (0, walk.steps) else 1.0
                swing[now, 1 - side] -= fade * width * phase
                swing[now, side] += fade * width * phase
            place = path(1.0)
            inside = times >= walk.start_s
            base[inside] = [path(float(np.clip((t - walk.start_s) / duration, 0.0, 1.0))) for t in times[inside]]
            assert np.allclose(path(0.0), start)
        tracks = np.stack([track.sample(times) for track in feet], axis=1)
        tracks[:, :, 2] += lift
        return base, tracks, _smooth(swing), weight, bob


class _Drift:
    """Slow random values in [-1, 1] that never repeat: sums of three sines each."""

    def __init__(self, rng: np.random.Generator, channels: int = 14) -> None:
        self._frequency = rng.uniform(*_DRIFT_HZ, size=(3, channels))
        self._phase = rng.uniform(0.0, 2.0 * np.pi, size=(3, channels))

    def sample(self, times: Array) -> Array:
        """(T, channels) values."""
        angles = 2.0 * np.pi * times[:, None, None] * self._frequency + self._phase
        return np.sin(angles).mean(axis=1)


def _path(walk: _Walk, start: Array) -> Callable[[float], Array]:
    """Place (x, y, yaw) along a walk for progress u in [0, 1], with soft ends."""
    grid = np.linspace(0.0, 1.0, 65)
    ramp = min(0.3, 0.6 / walk.steps)
    speed = np.clip(np.minimum(grid, 1.0 - grid) / ramp, 0.0, 1.0)
    speed = speed * speed * (3.0 - 2.0 * speed)
    progress = np.concatenate([[0.0], np.cumsum(0.5 * (speed[1:] + speed[:-1]))])
    progress /= progress[-1]
    yaw = start[2] + walk.turn_rad * progress
    middle = 0.5 * (yaw[1:] + yaw[:-1]) + walk.direction_rad
    step = np.diff(progress) * walk.distance_m
    x = start[0] + np.concatenate([[0.0], np.cumsum(step * np.cos(middle))])
    y = start[1] + np.concatenate([[0.0], np.cumsum(step * np.sin(middle))])
    return lambda u: np.array([np.interp(u, grid, x), np.interp(u, grid, y), np.interp(u, grid, yaw)])


def _smooth(values: Array) -> Array:
    kernel = np.array([1.0, 2.0, 3.0, 2.0, 1.0]) / 9.0
    padded = np.pad(values, ((2, 2), (0, 0)), mode="edge")
    return np.stack([np.convolve(padded[:, i], kernel, mode="valid") for i in range(values.shape[1])], axis=1)
