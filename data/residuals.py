"""What a frame of retargeting minimises: weighted residuals of a robot's body against `data.targets`, with their Jacobian.

Every frame of interest is a point p on a body with the world Jacobian Jv - p × Jω of the joints that carry it, so that all
points' Jacobians are one product, and all places and limb vectors (differences of points) another. Corners of the soles below
the floor and parts of the robot that come too near to each other add rows of their own.
Shape letters: T frames, N velocities (six of the base, then joints), R rows. Frames: world, z up, floor at 0.

Paper: none (engineering).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from data.least_squares import System
from data.targets import Targets
from interface.bodies import SIDES
from robots.kinematics import RobotModel
from robots.self_collision import close_rows, default_shapes, moved_by, solid_on

Array = NDArray[np.float64]
_PELVIS: Final = 6.0
_PELVIS_ROTATION: Final = 2.0
_SOLE: Final = 20.0
_SOLE_ROTATION: Final = 3.0
_ELBOW: Final = 4.0
_WRIST: Final = 8.0
_SHOULDERS: Final = 2.0
_FLOOR: Final = 20.0
_APART: Final = 20.0
_APART_M: Final = 0.01
_DEEPEST_M: Final = 0.03
#: Rows of `_combination`: what is followed as a weighted sum of the points pelvis, soles, then shoulder, elbow, wrist per arm.
_VECTORS: Final = 8
_POINTS: Final = 9
#: (3, 9): p @ _CROSS, as 3 × 3, times ω is ω × p.
_CROSS: Final = np.array(
    [[0, 0, 0, 0, 0, 1, 0, -1, 0], [0, 0, -1, 0, 0, 0, 1, 0, 0], [0, 1, 0, -1, 0, 0, 0, 0, 0]], dtype=np.float64
)


@dataclass(frozen=True, slots=True)
class BodyFrames:
    """Frames of a robot that follow a person, left before right.

    Attributes:
        pelvis: frame of the root body.
        soles: both soles.
        arms: shoulder, elbow and wrist of each arm.
        sole_level: (2, 3, 3) rotation of the sole's frame with the foot flat and pointing along x.
        corners: (4, 3) corners of a sole around its frame's origin, foot along x.
    """

    pelvis: int
    soles: tuple[int, int]
    arms: tuple[tuple[int, int, int], tuple[int, int, int]]
    sole_level: Array
    corners: Array


class Residuals:
    """The residuals of one robot.

    Args:
        robot: its model.
        frames: frames that follow the person.
        v_columns: (N,) places of the velocities that may change.
    """

    def __init__(self, robot: RobotModel, frames: BodyFrames, v_columns: NDArray[np.int64]) -> None:
        model = self._model = robot.model
        self._data = data = model.createData()
        self._columns = v_columns
        points = [frames.pelvis, *frames.soles, *(frame for arm in frames.arms for frame in arm)]
        poses = [data.oMf[index] for index in points]
        #: views into Pinocchio's data, which every update fills in
        self._places = [pose.translation for pose in poses]
        self._rotations = [pose.rotation for pose in poses[:3]]
        moved = np.stack([moved_by(model, model.frames[index].parentJoint)[v_columns] for index in points])
        self._moved = moved[:, None]
        self._turned = moved[:3, None] * np.array([_PELVIS_ROTATION, _SOLE_ROTATION, _SOLE_ROTATION])[:, None, None]
        self._turn_weights = np.array([_PELVIS_ROTATION, _SOLE_ROTATION, _SOLE_ROTATION])[:, None]
        self._combination = _combination()
        self._corner_offsets = frames.sole_level.swapaxes(1, 2) @ frames.corners.T  # (2, 3, 4) in the soles' frames
        self._apart = _Apart(robot, data)

    def follow(self, targets: Targets) -> list[System]:
        """The system of each frame of a clip."""
        arms = targets.arms
        aims = np.stack(
            [
                targets.pelvis * _PELVIS,
                *(targets.soles * _SOLE).transpose(1, 0, 2),
                *(
                    vector
                    for arm in (0, 1)
                    for vector in (arms[:, arm, 0] * _ELBOW, arms[:, arm].sum(axis=1) * _WRIST)
                ),
                targets.shoulders * _SHOULDERS,
            ],
            axis=1,
        )  # fmt: skip
        back = np.concatenate([targets.pelvis_rotation[:, None], targets.sole_rotation], axis=1).swapaxes(2, 3)
        return [lambda q, aim=aim, turn=turn: self._system(q, aim, turn) for aim, turn in zip(aims, back, strict=True)]

    def _system(self, q: Array, aim: Array, back: Array) -> tuple[Array, Array]:
        """Jacobian (R, N) and residual (R,), weighted, for vectors `aim` (8, 3) and inverse rotations `back` (3, 3, 3)."""
        model, data = self._model, self._data
        pin.computeJointJacobians(model, data, q)
        pin.updateFramePlacements(model, data)
        world = data.J[:, self._columns]
        linear, angular = world[:3], world[3:]
        places = np.array(self._places)
        turns = np.array(self._rotations)
        jacobians = (places @ _CROSS).reshape(3 * _POINTS, 3) @ angular
        jacobians = (jacobians.reshape(_POINTS, 3, -1) + linear) * self._moved
        off = turns @ back
        rows = [
            (self._combination @ jacobians.reshape(_POINTS, -1)).reshape(3 * _VECTORS, -1),
            (self._turned * angular).reshape(9, -1),
        ]
        residuals = [
            (self._combination @ places - aim).ravel(),
            (np.array([pin.log3(off[0]), pin.log3(off[1]), pin.log3(off[2])]) * self._turn_weights).ravel(),
        ]
        corners = turns[1:] @ self._corner_offsets  # (2, 3, 4)
        heights = corners[:, 2] + places[1:3, 2:]
        if heights.min() < 0.0:
            foot, corner = np.nonzero(heights < 0.0)
            x, y = corners[foot, 0, corner, None], corners[foot, 1, corner, None]
            jacobian = jacobians[1 + foot, 2] + self._moved[1 + foot, 0] * (angular[0] * y - angular[1] * x)
            rows.append(jacobian * _FLOOR)
            residuals.append(heights[foot, corner] * _FLOOR)
        close = self._apart.rows()
        if close is not None:
            rows.append(close[0][:, self._columns] * _APART)
            residuals.append(close[1] * _APART)
        return np.concatenate(rows), np.concatenate(residuals)


def _combination() -> Array:
    """(8, 9) weights of the points in each followed place or vector."""
    rows = np.zeros((_VECTORS, _POINTS))
    for point, weight in enumerate((_PELVIS, _SOLE, _SOLE)):
        rows[point, point] = weight
    for arm in (0, 1):
        shoulder = 3 + 3 * arm
        for joint, weight in ((1, _ELBOW), (2, _WRIST)):
            rows[2 + 2 * arm + joint, [shoulder + joint, shoulder]] = weight, -weight
    rows[7, [3, 6]] = _SHOULDERS, -_SHOULDERS
    return rows


class _Apart:
    """Residuals of parts of a robot that come too close: arms to the rest and to each other, legs to each other.

    The arms' shapes are those of `robots.self_collision`, with the hands' neighbours there counted here; shins and feet,
    which nothing else needs, are capsules around the description's geoms.
    """

    def __init__(self, robot: RobotModel, data: pin.Data) -> None:
        model, spec = robot.model, robot.spec
        self._model, self._data = model, data
        self._shapes = robot.own_body.geometry.clone()
        sides = [_leg_side(robot, shape.parentJoint) for shape in self._shapes.geometryObjects]
        known = {robot.model.frames[shape.parentFrame].name for shape in self._shapes.geometryObjects}
        for shape in default_shapes(spec):
            solid = solid_on(robot, shape, f"{shape.body}_leg")
            side = _leg_side(robot, solid.parentJoint)
            if side and shape.body not in known:
                self._shapes.addGeometryObject(solid)
                sides.append(side)
        parts = robot.own_body.parts
        for a in range(len(sides)):
            for b in range(len(sides)):
                legs = (sides[a], sides[b]) == SIDES
                hand = a < len(parts) and parts[a] in SIDES and b < len(parts) and parts[b] == "legs"
                if (legs or hand) and not self._shapes.existCollisionPair(pin.CollisionPair(a, b)):
                    self._shapes.addCollisionPair(pin.CollisionPair(a, b))
        self._gaps = self._shapes.createData()
        pairs = [(pair.first, pair.second) for pair in self._shapes.collisionPairs]
        #: the very results that a measurement fills in
        self._results = [self._gaps.distanceResults[index] for index in range(len(pairs))]
        moved = [moved_by(model, shape.parentJoint) for shape in self._shapes.geometryObjects]
        self._moves = np.array([moved[a] - moved[b] for a, b in pairs])

    def rows(self) -> tuple[Array, Array] | None:
        """Jacobian (P, nv) and residual (P,) of the pairs nearer than they may be, None without any; m.

        The model's data have joint Jacobians in the world frame by then.
        """
        pin.updateGeometryPlacements(self._model, self._data, self._shapes, self._gaps)
        if self._results[pin.computeDistances(self._shapes, self._gaps)].min_distance >= _APART_M:
            return None
        rows, gaps = close_rows(self._results, self._data, self._moves, _APART_M)
        return -rows, np.maximum(gaps - _APART_M, -_DEEPEST_M)


def _leg_side(robot: RobotModel, joint: int) -> str:
    """The side of the leg that a joint is part of, empty for other joints."""
    above = {robot.model.names[i] for i in robot.model.supports[joint]}
    legs = robot.spec.leg_joints
    half = len(legs) // 2
    return next((side for side, names in zip(SIDES, (legs[:half], legs[half:]), strict=True) if above & set(names)), "")
