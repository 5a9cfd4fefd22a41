"""A robot against itself: how far its arms are from its trunk and legs and from each other, and rows that keep them apart.

Shapes are the capsules and boxes of the description (`RobotSpec.self_shapes`), or, where it names none, those of the MJCF's
geoms. Pinocchio carries them and coal measures the distances: a few microseconds for all pairs of a robot. Counted are arm
against trunk (head and pelvis too), arm against legs and arm against arm, without what touches in the postures
of rest and carrying: an upper arm and its shoulder.

`SelfLimit` adds one row of a velocity damper per close pair to Pink's quadratic program (a control barrier on the distance),
    n^T (J_a(p_a) - J_b(p_b)) dq <= gain (d - d_min),
with n from a to b and p the nearest points. Overlapping pairs have a negative bound, which drives them apart.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Final, Protocol

import coal
import mujoco
import numpy as np
import pink
import pinocchio as pin
from numpy.typing import ArrayLike, NDArray
from pink.limits import Limit

from interface.bodies import SIDES
from robots.spec import BodyShape, RobotSpec

Array = NDArray[np.float64]

#: Penetration of the shapes that still counts as touching only; they are a little larger than the body.
SELF_TOUCH_M: Final = 0.005
#: Shapes nearer than this in the postures of rest and carrying are neighbours.
_NEIGHBOUR_M: Final = 0.005
#: Distance that the rows keep, distance from which a pair has a row, share of the way to it that one iteration may go.
_KEEP_M: Final = 0.0
_NEAR_M: Final = 0.1
_GAIN: Final = 0.8
#: What one iteration drives overlapping shapes apart at most: more would ask for what the joints cannot do in one step.
_ESCAPE_M: Final = 0.03
#: Parts that a shape may belong to.
_PARTS: Final = (*SIDES, "trunk", "legs")
#: Distance reported for robots whose shapes make no pair.
_FAR_M: Final = 1.0


class PosableRobot(Protocol):
    """What the shapes have to know of a robot's kinematics."""

    spec: RobotSpec
    model: pin.Model

    def posture(self, values: Mapping[str, float] | None = None) -> Array:
        """(J,) joints at rest."""
        ...

    def arm_posture(self, q: ArrayLike, kind: str) -> Array:
        """(J,) joints with the arms in a named posture."""
        ...

    def configuration(self, root_pose: ArrayLike, q: ArrayLike) -> Array:
        """Pinocchio's configuration of a pelvis pose and joints."""
        ...

    def frame_id(self, name: str) -> int:
        """Pinocchio's frame of a body or site."""
        ...


class OwnBody:
    """The shapes of a robot on its kinematics.

    Attributes:
        geometry: Pinocchio's shapes on the whole robot's model, with all pairs that count.
        parts: per shape what it belongs to: `left` or `right` (arm), `legs`, or `trunk`, which is all the rest.
    """

    def __init__(self, robot: PosableRobot) -> None:
        self._robot = robot
        spec, model = robot.spec, robot.model
        self.geometry = pin.GeometryModel()
        self.parts: list[str] = []
        arms = {side: {model.getJointId(name) for name in spec.arms[side].joints} for side in SIDES}
        members = {**arms, "legs": {model.getJointId(name) for name in spec.leg_joints}}
        for number, shape in enumerate(spec.self_shapes or default_shapes(spec)):
            self.geometry.addGeometryObject(solid_on(robot, shape, f"{shape.body}_{number}"))
            above = set(model.supports[self.geometry.geometryObjects[number].parentJoint])
            self.parts.append(next((part for part, joints in members.items() if joints & above), "trunk"))
        for a, first in enumerate(self.parts):
            for b, second in enumerate(self.parts):
                if first in SIDES and (second not in SIDES or (first, second) == SIDES):
                    self.geometry.addCollisionPair(pin.CollisionPair(a, b))
        self._root = np.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0])
        self._data = model.createData()
        self._leave_out_neighbours()
        self._kept: dict[tuple[str, str], tuple[pin.GeometryModel, pin.GeometryData]] = {}

    def _leave_out_neighbours(self) -> None:
        for kind in ("rest", "carry"):
            data = self.geometry.createData()
            self._place(self._robot.arm_posture(self._robot.posture(), kind))
            pin.updateGeometryPlacements(self._robot.model, self._data, self.geometry, data)
            pin.computeDistances(self.geometry, data)
            near = [result.min_distance < _NEIGHBOUR_M for result in data.distanceResults]
            for pair, touches in zip(_pairs(self.geometry), near, strict=True):
                if touches:
                    self.geometry.removeCollisionPair(pin.CollisionPair(*pair))

    def _place(self, q: Array) -> None:
        pin.forwardKinematics(self._robot.model, self._data, self._robot.configuration(self._root, q))

    def leave_pairs(self, geometry: pin.GeometryModel, arms: Iterable[str], against: Iterable[str] = _PARTS) -> None:
        """Takes the pairs out of `geometry`, whose shapes are in this body's order, that are not of `arms` against something.

        Args:
            geometry: of the whole or of a reduced model.
            arms: `left`, `right` or both.
            against: parts of the robot.
        """
        ours, theirs = set(arms), set(against)
        for a, b in _pairs(geometry):
            first, second = self.parts[a], self.parts[b]
            if not ((first in ours and second in theirs) or (second in ours and first in theirs)):
                geometry.removeCollisionPair(pin.CollisionPair(a, b))

    def clearance_m(self, q: Array, arms: Sequence[str] = SIDES, against: Sequence[str] = _PARTS) -> float:
        """Smallest distance of the given arms to parts of the robot, the other arm among them; negative inside.

        Args:
            q: (J,) joints.
            arms: `left`, `right` or both.
            against: parts of the robot, see `parts`.
        """
        self._place(np.asarray(q, dtype=float))
        return self.clearance_at_m(self._data, arms, against)

    def clearance_at_m(self, data: pin.Data, arms: Sequence[str] = SIDES, against: Sequence[str] = _PARTS) -> float:
        """See `clearance_m`; for data of the whole robot's model whose forward kinematics are done."""
        key = (" ".join(arms), " ".join(against))
        if key not in self._kept:
            kept = self.geometry.clone()
            self.leave_pairs(kept, arms, against)
            self._kept[key] = (kept, kept.createData())
        geometry, measured = self._kept[key]
        if not len(geometry.collisionPairs):
            return _FAR_M
        pin.updateGeometryPlacements(self._robot.model, data, geometry, measured)
        return float(measured.distanceResults[pin.computeDistances(geometry, measured)].min_distance)

    def pose_others(self, geometry: pin.GeometryModel, root: Array, q: Array, arms: Sequence[str]) -> None:
        """Puts the shapes of other arms, fixed in a reduced model's `geometry`, where the joints `q` (J,) have them.

        Args:
            geometry: of a model reduced to the joints of `arms`, shapes in the order of this body's.
            root: (7,) pose of the pelvis in the frame of that model.
            q: (J,) joints.
            arms: those that the reduced model moves.
        """
        pin.forwardKinematics(self._robot.model, self._data, self._robot.configuration(root, q))
        for number, part in enumerate(self.parts):
            if part in SIDES and part not in arms:
                shape = self.geometry.geometryObjects[number]
                geometry.geometryObjects[number].placement = self._data.oMi[shape.parentJoint] * shape.placement


class SelfLimit(Limit):
    """Rows that keep the close pairs of a model apart. Distances are computed once per configuration."""

    def __init__(self, model: pin.Model, data: pin.Data, geometry: pin.GeometryModel) -> None:
        self._model, self._data = model, data
        self.geometry = geometry
        self._measured = geometry.createData()
        pairs = _pairs(geometry)
        #: the very results that a measurement fills in
        self._results = [self._measured.distanceResults[index] for index in range(len(pairs))]
        joints = [shape.parentJoint for shape in geometry.geometryObjects]
        # (P, N) 1 where a joint moves a pair's first shape only, -1 where the second only
        self._moves: Array = np.array([moved_by(model, joints[a]) - moved_by(model, joints[b]) for a, b in pairs])
        self._at: Array | None = None
        self._clearance_m = _FAR_M

    def forget(self) -> None:
        """The next question measures again, because shapes were moved."""
        self._at = None

    def clearance_m(self, configuration: pink.Configuration) -> float:
        """Smallest distance of all pairs, negative inside. A configuration that moves on has another array of positions."""
        if self._at is not configuration.q and self._results:
            self._at = configuration.q
            pin.updateGeometryPlacements(self._model, self._data, self.geometry, self._measured)
            self._clearance_m = float(self._results[pin.computeDistances(self.geometry, self._measured)].min_distance)
        return self._clearance_m

    def compute_qp_inequalities(self, configuration: pink.Configuration, dt: float) -> tuple[Array, Array] | None:
        """See `pink.limits.Limit`."""
        if self.clearance_m(configuration) > _NEAR_M:
            return None
        rows, gaps = close_rows(self._results, self._data, self._moves, _NEAR_M)
        return rows, np.maximum(_GAIN * (gaps - _KEEP_M), -_ESCAPE_M)


def close_rows(results: Sequence[Any], data: pin.Data, moves: Array, near_m: float) -> tuple[Array, Array]:
    """How the pairs nearer than `near_m` come closer: rows n^T (J_a(p_a) - J_b(p_b)) (P, N) and distances (P,).

    Both nearest points lie on one line along the normal, so that one wrench on it tells how fast either moves.

    Args:
        results: measured distances of all pairs.
        data: of the model, with joint Jacobians in the world frame.
        moves: (all pairs, N) 1 where a joint moves a pair's first shape only, -1 where the second only.
        near_m: distance from which on a pair is left out.
    """
    gaps = np.array([result.min_distance for result in results])
    close = np.flatnonzero(gaps < near_m)
    lines = []
    for index in close.tolist():  # numbers one by one: arrays of three cost more than what they save
        (x, y, z), (u, v, w) = results[index].getNearestPoint1().tolist(), results[index].normal.tolist()
        lines.append((u, v, w, y * w - z * v, z * u - x * w, x * v - y * u))
    return (np.array(lines) @ data.J) * moves[close], gaps[close]


def solid_on(robot: PosableRobot, shape: BodyShape, name: str) -> pin.GeometryObject:
    """A shape as Pinocchio's geometry on the joint that moves its body."""
    index = robot.frame_id(shape.body)
    frame = robot.model.frames[index]
    solid, at = _solid(shape)
    return pin.GeometryObject(name, frame.parentJoint, index, frame.placement * at, solid)


def moved_by(model: pin.Model, joint: int) -> Array:
    """(N,) 1 for the velocities that move a joint's body."""
    out = np.zeros(model.nv)
    for above in model.supports[joint]:
        if above:
            start = model.joints[above].idx_v
            out[start : start + model.joints[above].nv] = 1.0
    return out


def _pairs(geometry: pin.GeometryModel) -> list[tuple[int, int]]:
    """Copies of the pairs' shape numbers: Pinocchio's own pairs move when one is taken out."""
    return [(pair.first, pair.second) for pair in geometry.collisionPairs]


def _solid(shape: BodyShape) -> tuple[Any, pin.SE3]:
    """Coal's solid of a shape, and where it is in its body's frame."""
    start = np.asarray(shape.start, dtype=float)
    if shape.half_m is not None:
        return coal.Box(*(2.0 * half for half in shape.half_m)), pin.SE3(np.eye(3), start)
    way = np.asarray(shape.end, dtype=float) - start
    length = float(np.linalg.norm(way))
    turn = np.eye(3) if length < 1e-9 else pin.Quaternion.FromTwoVectors(np.array([0.0, 0.0, 1.0]), way).matrix()
    return coal.Capsule(shape.radius_m, length), pin.SE3(turn, start + 0.5 * way)


def default_shapes(spec: RobotSpec) -> tuple[BodyShape, ...]:
    """Shapes of a robot that declares none: per body one capsule around its geoms, one for each whole hand.

    A body's primitive geoms go before its meshes. The capsule has the direction in which the geoms' corners spread most.
    """
    model = mujoco.MjModel.from_xml_path(str(spec.mjcf_path))
    data = mujoco.MjData(model)
    for arm in spec.arms.values():
        for name, value in zip(arm.hand_joints, arm.hand_open, strict=True):
            data.qpos[model.joint(name).qposadr[0]] = value
    mujoco.mj_kinematics(model, data)
    wrists = {int(model.joint(arm.joints[-1]).bodyid[0]) for arm in spec.arms.values()}
    owner = np.arange(model.nbody)
    for body in range(1, model.nbody):  # what hangs on a wrist belongs to it
        parent = int(owner[model.body_parentid[body]])
        owner[body] = parent if parent in wrists else body
    shapes = []
    for body in range(1, model.nbody):
        geoms = np.flatnonzero(owner[model.geom_bodyid] == body)
        solid = geoms[model.geom_type[geoms] != int(mujoco.mjtGeom.mjGEOM_MESH)]
        geoms = solid if len(solid) else geoms
        if not len(geoms):
            continue
        rotation, origin = data.xmat[body].reshape(3, 3), data.xpos[body]
        points = np.concatenate([_corners(model, data, int(geom)) for geom in geoms])
        shapes.append(_capsule_around(model.body(body).name, (points - origin) @ rotation))
    return tuple(shapes)


def _corners(model: mujoco.MjModel, data: mujoco.MjData, geom: int) -> Array:
    """(8, 3) corners of a geom's box in the world."""
    signs = np.array(np.meshgrid(*[(-1.0, 1.0)] * 3)).reshape(3, 8).T
    local = model.geom_aabb[geom, :3] + signs * model.geom_aabb[geom, 3:]
    return data.geom_xpos[geom] + local @ data.geom_xmat[geom].reshape(3, 3).T


def _capsule_around(body: str, points: Array) -> BodyShape:
    """A capsule about the middle of points (N, 3), as wide as their root mean square distance across, as long as they are."""
    middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
    away = points - middle
    axis = np.linalg.svd(away, full_matrices=False)[2][0]
    along = away @ axis
    radius = float(np.sqrt(np.mean(np.sum(away**2, axis=1) - along**2)))
    half = max(float(np.abs(along).max()) - radius, 0.0)
    ends = [tuple(float(v) for v in middle + sign * half * axis) for sign in (-1.0, 1.0)]
    return BodyShape(body, (ends[0][0], ends[0][1], ends[0][2]), (ends[1][0], ends[1][1], ends[1][2]), radius)
