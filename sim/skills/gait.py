"""Footstep planning: alternating steps along a path of the base, planned for the whole path at once.

The base leads and the feet follow. The way is cut into steps of equal progress, the first and the last half as long; a foot
stands still on the floor for one step and swings for the next, to the place under the hips where the base will be in the middle
of its next stand. At the end both feet are where a standing robot has them, so that a way leaves nothing behind.

Paper: continuous motion of the humanoids. World frame; shape letters: T control ticks, L leg joints.

Constants were chosen by hand; with them the certificates of the 359 benchmark tasks were made on both robots.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from sim.skills.footsteps import Footsteps

Array = NDArray[np.float64]
#: Turn of the base that counts as one step.
_TURN_RAD: Final = 0.45
#: Height of a step, as a share of the pelvis height; shorter steps are lower.
_LIFT: Final = 0.045


def leg_motion(feet: Footsteps, pelvis_height_m: float, soles_m: Array, way: Array, rise_m: Array) -> Array:
    """(T, L) leg joints that walk along a path of the base.

    Args:
        feet: the robot's footsteps.
        pelvis_height_m: pelvis above the floor.
        soles_m: (2, 2) x and y of the left and the right sole of the standing robot, pelvis heading frame.
        way: (T, 3) commanded x, y (m) and yaw (rad, not wrapped), the present pose first.
        rise_m: (T,) how much higher the pelvis is meanwhile.
    """
    longest_m = 2.0 * np.array(feet.reach_m(pelvis_height_m + float(rise_m.max())))  # ahead, aside
    moved = np.linalg.norm(_in_heading(np.diff(way[:, :2], axis=0), way[1:, 2]) / longest_m, axis=1)
    turned = np.abs(np.diff(way[:, 2])) / _TURN_RAD
    progress = np.concatenate([[0.0], np.cumsum(np.maximum(moved, turned))])  # (T,) in longest steps
    total = float(progress[-1])
    if total < 1e-6:
        return feet.joints(pelvis_height_m, np.zeros((len(way), 2, 4)))
    count = max(2, int(np.ceil(total)) + 1)
    step = total / (count - 1)
    bounds = np.concatenate([[0.0], (np.arange(count - 1) + 0.5) * step, [total]])  # (count + 1,)
    steady = progress + np.arange(len(progress)) * 1e-12  # strictly increasing for interpolation

    def base_at(where: float) -> Array:
        return np.array([np.interp(where, steady, column) for column in way.T])

    places = np.stack([_foothold(way[0], sole) for sole in soles_m])  # (2, 3) where each foot stands
    lift = _LIFT * pelvis_height_m * min(1.0, step / 0.4)
    shifts = np.zeros((len(way), 2, 4))
    for index in range(count):
        swinging = index % 2
        ticks = np.flatnonzero((progress >= bounds[index]) & ((progress < bounds[index + 1]) | (index == count - 1)))
        middle = 0.5 * (bounds[index + 1] + bounds[index + 2]) if index < count - 2 else total
        landing = _foothold(base_at(middle), soles_m[swinging])
        share = np.clip((progress[ticks] - bounds[index]) / (bounds[index + 1] - bounds[index]), 0.0, 1.0)
        smooth = share * share * (3.0 - 2.0 * share)
        for foot in range(2):
            poses = np.repeat(places[foot][None], len(ticks), axis=0)
            if foot == swinging:
                poses = poses + smooth[:, None] * (landing - places[foot])
                shifts[ticks, foot, 2] = lift * 4.0 * share * (1.0 - share)
            shifts[ticks, foot, :2] = _in_heading(poses[:, :2] - way[ticks, :2], way[ticks, 2]) - soles_m[foot]
            shifts[ticks, foot, 3] = poses[:, 2] - way[ticks, 2]
        places[swinging] = landing
    shifts[:, :, 2] -= rise_m[:, None]
    return feet.joints(pelvis_height_m, shifts)


def _foothold(base: Array, sole_m: Array) -> Array:
    """(3,) x, y and yaw of a foot under a base pose, world frame."""
    c, s = np.cos(base[2]), np.sin(base[2])
    return np.array([base[0] + c * sole_m[0] - s * sole_m[1], base[1] + s * sole_m[0] + c * sole_m[1], base[2]])


def _in_heading(vectors: Array, yaws_rad: Array) -> Array:
    """(T, 2) vectors in heading frames (T,)."""
    c, s = np.cos(yaws_rad), np.sin(yaws_rad)
    return np.stack([c * vectors[:, 0] + s * vectors[:, 1], c * vectors[:, 1] - s * vectors[:, 0]], axis=1)
