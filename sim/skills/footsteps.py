"""Leg joints for feet displaced from their neutral place under the pelvis: the table behind the walking motion.

For a grid of pelvis heights, fore-and-aft, sideways and upward displacements of the soles the legs are solved once per robot
and kept in the user's cache; in between they are interpolated. Feet stay level as far as the ankles allow. The paper's robots
walk by the engine's animation; balance while walking is not simulated here either, the base is driven.

Frame: pelvis heading frame. Shape letters: N samples, L leg joints.
"""

from __future__ import annotations

import dataclasses
import hashlib
from functools import lru_cache
from pathlib import Path

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray
from scipy.interpolate import RegularGridInterpolator

from data.files import read_cached, write_cached
from robots.build_solver import RobotKit
from robots.kinematics import root_quaternion
from robots.leg_ik import solve_legs

Array = NDArray[np.float64]
_VERSION = 1
#: A sole rather tilts by a radian than to miss its place by this many metres: heels rise behind.
_LEVEL = 0.1
#: Half the longest step, its share of the pelvis height; and the highest lift of a swinging foot.
_AHEAD, _ASIDE, _UP = 0.22, 0.12, 0.07
_GRID = (9, 3, 3)
#: By how much a sole may miss its place in a step, most of it the heel that rises.
_MISS_M = 0.02
_HEIGHTS = 6
#: Turn of the feet (rad) from which the legs' share of a turn is found.
_TURN_RAD = 0.25


class Footsteps:
    """Leg joints for displaced feet.

    Args:
        kit: the robot.
        arrays: `heights_m` (H,), `ahead_m`, `aside_m` and `up_m`, the grid; `legs` (H, X, Y, Z, L), what is added to the
            crouch's leg joints; `turn` (H, L), what a radian of turn of a foot adds to the joints of its leg; `reach_m`
            (H,), how far ahead and back a sole comes.
    """

    def __init__(self, kit: RobotKit, arrays: dict[str, Array]) -> None:
        self._kit = kit
        index = kit.model.indices(kit.spec.leg_joints)
        self._lower, self._upper = kit.model.lower[index], kit.model.upper[index]
        self._left = _left_joints(kit)
        self._heights_m, self._turn, self._reach_m = arrays["heights_m"], arrays["turn"], arrays["reach_m"]
        self._limits = np.array([arrays[name][-1] for name in ("ahead_m", "aside_m", "up_m")])
        axes = tuple(arrays[name] for name in ("heights_m", "ahead_m", "aside_m", "up_m"))
        self._legs = RegularGridInterpolator(axes, arrays["legs"])

    def longest_m(self, pelvis_height_m: float) -> float:
        """Longest step within the legs' reach with both soles on the floor."""
        return 2.0 * float(np.interp(pelvis_height_m, self._heights_m, self._reach_m))

    def joints(self, pelvis_height_m: float, feet: Array) -> Array:
        """(N, L) leg joints for displaced feet.

        Args:
            pelvis_height_m: pelvis above the floor.
            feet: (N, 2, 4) displacement of the left and the right sole: ahead, to the left, up (metres) and turn (rad).
        """
        height = float(np.clip(pelvis_height_m, self._heights_m[0], self._heights_m[-1]))
        where = np.clip(feet[..., :3], (*-self._limits[:2], 0.0), self._limits)  # (N, 2, 3)
        points = np.concatenate([np.full((*where.shape[:2], 1), height), where], axis=-1)
        both = self._legs(points)  # (N, 2, L): each foot's displacement given to both legs
        own = np.where(self._left, both[:, 0], both[:, 1])  # (N, L)
        turn = np.array([[np.interp(height, self._heights_m, self._turn[:, k]) for k in range(self._turn.shape[1])]])
        turned = feet[:, 0, 3:] * np.where(self._left, turn, 0.0) + feet[:, 1, 3:] * np.where(self._left, 0.0, turn)
        return np.clip(self._kit.crouches.legs(pelvis_height_m) + own + turned, self._lower, self._upper)


def _left_joints(kit: RobotKit) -> NDArray[np.bool_]:
    """(L,) whether a leg joint moves the left sole."""
    robot = kit.model
    model = robot.model
    sole = int(model.frames[robot.frame_id("left_sole")].parentJoint)
    above = set(model.supports[sole])
    return np.array([int(model.getJointId(name)) in above for name in kit.spec.leg_joints])


@lru_cache(maxsize=4)
def footsteps(kit: RobotKit) -> Footsteps:
    """The footstep table of a robot, cached on disk by everything it depends on."""
    spec = kit.spec
    described = repr(dataclasses.replace(spec, mjcf_path=Path()))
    grid = f"{_AHEAD}|{_ASIDE}|{_UP}|{_GRID}|{_HEIGHTS}|{_TURN_RAD}|{_LEVEL}|{_VERSION}"
    key = hashlib.sha256(spec.mjcf_path.read_bytes() + f"{described}|{grid}".encode()).hexdigest()
    name = f"steps-{spec.name}-{key[:24]}"
    arrays = read_cached(name)
    if arrays is None or set(arrays) != {"heights_m", "ahead_m", "aside_m", "up_m", "legs", "turn", "reach_m"}:
        arrays = _solved(kit)
        write_cached(name, arrays)
    return Footsteps(kit, arrays)


def _solved(kit: RobotKit) -> dict[str, Array]:
    """Solves the legs on the grid: the arrays of `Footsteps`."""
    robot, crouches = kit.model, kit.crouches
    low, high = kit.spec.pelvis_height_range_m
    legs = robot.indices(kit.spec.leg_joints)
    heights = np.linspace(low, high, _HEIGHTS)
    size = kit.spec.standing_pelvis_height_m
    ahead, aside, up = (
        np.linspace(start * share * size, share * size, count)
        for start, share, count in zip((-1.0, -1.0, 0.0), (_AHEAD, _ASIDE, _UP), _GRID, strict=True)
    )
    found = np.zeros((_HEIGHTS, *_GRID, len(legs)))
    turn, reach = np.zeros((_HEIGHTS, len(legs))), np.zeros(_HEIGHTS)
    for h, height in enumerate(heights):
        root = np.array([0.0, 0.0, height, *root_quaternion(0.0, crouches.pitch(float(height)))])
        base = crouches.posture(float(height))
        soles = robot.frames(root, base, ("left_sole", "right_sole"))[:, :3, 3]

        def at(shift: Array, yaw_rad: float, start: Array, root: Array = root, soles: Array = soles) -> Array:
            rotation = pin.utils.rotate("z", yaw_rad)
            goals = [pin.SE3(rotation, sole + shift) for sole in soles]
            return solve_legs(robot, root, start, goals, level=_LEVEL, damping=1e-4, iterations=25)[0]

        for j, y in enumerate(aside):
            for i, x in enumerate(ahead):
                posture = base
                for k, z in enumerate(up):
                    posture = at(np.array([x, y, z]), 0.0, posture)
                    found[h, i, j, k] = (posture - base)[legs]
        reach[h] = _reach_m(kit, float(height), ahead, found[h, :, _GRID[1] // 2, 0])
        turn[h] = (at(np.zeros(3), _TURN_RAD, base) - base)[legs] / _TURN_RAD
    return {"heights_m": heights, "ahead_m": ahead, "aside_m": aside, "up_m": up, "legs": found, "turn": turn, "reach_m": reach}


def _reach_m(kit: RobotKit, height_m: float, ahead_m: Array, legs: Array) -> float:
    """Reach of the soles ahead and back within tolerance, from leg joints (X, L) over displacements (X,)."""
    robot = kit.model
    root = np.array([0.0, 0.0, height_m, *root_quaternion(0.0, kit.crouches.pitch(height_m))])
    base, index = kit.crouches.posture(height_m), robot.indices(kit.spec.leg_joints)
    neutral = robot.frames(root, base, ("left_sole",))[0, :3, 3]
    best = 0.25 * float(ahead_m[-1])
    for distance in np.linspace(0.0, float(ahead_m[-1]), 23)[1:]:
        for shift in (distance, -distance):
            q = base.copy()
            q[index] += [np.interp(shift, ahead_m, column) for column in legs.T]
            sole = robot.frames(root, q, ("left_sole",))[0, :3, 3]
            if np.linalg.norm(sole - neutral - (shift, 0.0, 0.0)) > _MISS_M:
                return max(best, float(distance) - float(ahead_m[-1]) / 22)
    return float(ahead_m[-1])
