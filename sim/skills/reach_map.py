"""Reachability map of each arm: a table of sampled arm postures with hand poses, and fast queries.

Inverse kinematics with few degrees of freedom (H1: five per arm) has local minima and no room for an arbitrary hand
orientation. The table answers both: for a point it gives the posture whose hand points best, as the start of the solver, and it
tells at which other pelvis heights the point would be in reach. Sampling is uniform over the joint ranges, with a fixed seed,
once per robot and machine; postures that put the arm well into the trunk or the head are left out.

Frames: `pelvis` is the pelvis heading frame. Shape letters: S samples, A arm joints.
"""

from __future__ import annotations

import dataclasses
import hashlib
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Final

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray
from scipy.spatial import KDTree

from data.files import read_cached, write_cached
from robots.build_solver import RobotKit
from robots.kinematics import RobotModel

Array = NDArray[np.float64]

_SAMPLES: Final = 80000
#: Raised when the meaning of the arrays changes.
_VERSION: Final = 2
_FIELDS: Final = ("q", "positions", "x_axes", "y_axes", "shoulder")
#: Postures that are farther than this from the carrying one in any joint are left out: such arms are wound up.
WOUND_RAD: Final = 2.0
#: Postures that put the arm deeper than this into trunk or head are left out; the solver brings an arm out of less.
_INSIDE_M: Final = 0.03
#: A point counts as within the envelope when a sampled hand is at most this far from it.
_ENVELOPE_M: Final = 0.045
#: Weight of the position error (per metre) against the orientation error (1 - cosine) when a posture is chosen.
_POSITION_WEIGHT: Final = 10.0
#: Weight of the squared distance (rad^2) from a preferred posture.
_POSTURE_WEIGHT: Final = 0.06


@dataclass(frozen=True, slots=True)
class HandPose:
    """A target for the hand.

    Attributes:
        position: (3,) grasp site, metres; in the frame of who asks: the world for skills, the pelvis here.
        pointing: (3,) unit direction of the fingers (site x), or None for any.
        closing: (3,) unit closing direction (site y), or None for any.
        either_way: whether the opposite closing direction is as good.
    """

    position: Array
    pointing: Array | None = None
    closing: Array | None = None
    either_way: bool = False

    def rotation(self, x_axis: Array, y_axis: Array) -> Array:
        """The target's (3, 3) rotation; axes it leaves open are taken from a given hand."""
        x = x_axis if self.pointing is None else self.pointing
        y = y_axis if self.closing is None else self.closing
        if self.closing is not None and self.either_way and float(self.closing @ y_axis) < 0.0:
            y = -y
        if self.pointing is None and self.closing is not None:
            x = x - (x @ y) * y
        x = x / np.linalg.norm(x)
        y = y - (y @ x) * x
        y = y / np.linalg.norm(y)
        return np.stack([x, y, np.cross(x, y)], axis=1)


@dataclass(frozen=True, slots=True)
class ReachMap:
    """Sampled postures of one arm.

    Attributes:
        q: (S, A) joint positions.
        positions: (S, 3) grasp site in the pelvis frame.
        x_axes, y_axes: (S, 3) axes of the grasp site.
        shoulder: (3,) shoulder in the pelvis frame.
        reach_m: largest distance of the grasp site from the shoulder.
        tree: nearest-neighbour index over `positions`.
    """

    q: Array
    positions: Array
    x_axes: Array
    y_axes: Array
    shoulder: Array
    reach_m: float
    tree: KDTree

    def contains(self, point: Array) -> bool:
        """Whether the arm can bring its grasp site to (about) a point."""
        return self.gap_m(point) <= _ENVELOPE_M

    def gap_m(self, point: Array) -> float:
        """Distance from a point to the nearest sampled hand."""
        return float(self.tree.query(point)[0])

    def beyond_m(self, point: Array) -> float:
        """How far a point lies beyond the stretched arm, negative inside."""
        return float(np.linalg.norm(point - self.shoulder)) - self.reach_m

    def starts(self, hand_target: HandPose, count: int, radius_m: float = 0.12, near: Array | None = None) -> Array:
        """(N <= count, A) sampled postures that fulfil a target best, best first; at least one.

        Args:
            hand_target: hand pose in the pelvis frame.
            count: how many.
            radius_m: how far from the target a sampled hand may be.
            near: (A,) posture to stay close to, so that the arm does not wind itself up.
        """
        rows = np.asarray(self.tree.query_ball_point(hand_target.position, radius_m), dtype=np.int64)
        if len(rows) == 0:
            rows = np.array([int(self.tree.query(hand_target.position)[1])])
        cost = _POSITION_WEIGHT * np.linalg.norm(self.positions[rows] - hand_target.position, axis=1)
        if hand_target.pointing is not None:
            cost = cost + (1.0 - self.x_axes[rows] @ hand_target.pointing)
        if hand_target.closing is not None:
            along = self.y_axes[rows] @ hand_target.closing
            cost = cost + (1.0 - (np.abs(along) if hand_target.either_way else along))
        if near is not None:
            cost = cost + _POSTURE_WEIGHT * np.sum((self.q[rows] - near) ** 2, axis=1)
        order = np.argsort(cost, kind="stable")
        return self.q[rows[order[:count]]]


@lru_cache(maxsize=4)
def reach_maps(kit: RobotKit) -> dict[str, ReachMap]:
    """Reach maps of a robot's `left` and `right` arm, waist straight; cached on disk by everything they depend on."""
    spec = kit.spec
    described = repr(dataclasses.replace(spec, mjcf_path=Path()))
    key = hashlib.sha256(
        spec.mjcf_path.read_bytes() + f"{described}|{_SAMPLES}|{WOUND_RAD}|{_INSIDE_M}|{_VERSION}".encode()
    ).hexdigest()
    name = f"reach-{spec.name}-{key[:24]}"
    arrays = read_cached(name)
    if arrays is None or set(arrays) != {f"{side}/{field}" for side in spec.arms for field in _FIELDS}:
        arrays = _sampled(kit)
        write_cached(name, arrays)
    maps: dict[str, ReachMap] = {}
    for side in spec.arms:
        q, positions, x_axes, y_axes, shoulder = (arrays[f"{side}/{field}"] for field in _FIELDS)
        reach = float(np.linalg.norm(positions - shoulder, axis=1).max())
        maps[side] = ReachMap(q, positions, x_axes, y_axes, shoulder, reach, KDTree(positions))
    return maps


def _sampled(kit: RobotKit) -> dict[str, Array]:
    """Samples the postures of both arms: the arrays of `ReachMap`, by side and field."""
    spec = kit.spec
    robot = RobotModel(spec)
    rng = np.random.default_rng(20)
    base = robot.configuration(np.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0]), robot.posture())
    found: dict[str, Array] = {}
    columns = {side: robot.indices(arm.joints) for side, arm in spec.arms.items()}
    slots = {
        side: np.array([robot.model.joints[robot.model.getJointId(name)].idx_q for name in arm.joints])
        for side, arm in spec.arms.items()
    }
    frames = {side: robot.frame_id(arm.grasp_site) for side, arm in spec.arms.items()}
    draws = {
        side: rng.uniform(robot.lower[index], robot.upper[index], (_SAMPLES, len(index))) for side, index in columns.items()
    }
    hands = {side: np.empty((_SAMPLES, 3, 3)) for side in spec.arms}  # rows: position, x axis, y axis
    clear = {side: np.empty(_SAMPLES, dtype=bool) for side in spec.arms}
    full = base.copy()
    for i in range(_SAMPLES):
        for side in spec.arms:
            full[slots[side]] = draws[side][i]
        pin.framesForwardKinematics(robot.model, robot.data, full)
        for side in spec.arms:
            pose = robot.data.oMf[frames[side]]
            hands[side][i, 0] = pose.translation
            hands[side][i, 1:] = pose.rotation[:, :2].T
            # the legs are elsewhere in a crouch
            clear[side][i] = robot.own_body.clearance_at_m(robot.data, (side,), ("trunk",)) >= -_INSIDE_M
    for side in spec.arms:
        pin.framesForwardKinematics(robot.model, robot.data, base)
        shoulder = robot.data.oMf[robot.frame_id(spec.key_bodies[f"{side}_shoulder"])].translation.copy()
        positions = hands[side][:, 0].copy()
        wound = np.abs(draws[side] - np.asarray(spec.arms[side].carry))[:, :-1].max(axis=1)  # the wrist may roll freely
        sensible = (positions[:, 0] > -0.05) & (wound < WOUND_RAD) & clear[side]  # hands behind the back are of no use
        values = (draws[side][sensible], positions[sensible], hands[side][sensible, 1], hands[side][sensible, 2], shoulder)
        found |= {f"{side}/{field}": np.ascontiguousarray(value) for field, value in zip(_FIELDS, values, strict=True)}
    return found
