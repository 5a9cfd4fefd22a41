"""Where and how a hand can take an object: candidate grasps from the object's box, ordered by preference.

Three families. `wrap`: the fingers pass on both sides of the object, for what fits between them. `rim`: the fingers take the
edge of a wide vessel. `top`: the fingers come down on the upper side, for what is flat or wide. The pointing direction is
scanned around the line from the shoulder, because an arm with few degrees of freedom points where it must.

Frames: world. The paper's grasps need no contact; ours are judged by contact afterwards (`sim.skills.manipulate`).

Constants were chosen by hand; with them the certificates of the 359 benchmark tasks were made on both robots.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from interface.bodies import Arm
from robots.spec import HandSpec
from sim.scene.objects import ObjectInstance
from sim.skills.body.body import Body
from sim.skills.reach_map import HandPose

Array = NDArray[np.float64]
_UP: Final = np.array([0.0, 0.0, 1.0])
#: A lid that is open by less than this share belongs to the box of its object.
_SHUT_SHARE: Final = 0.05


@dataclass(frozen=True, slots=True)
class Grasp:
    """One way to take an object.

    Attributes:
        family: wrap, rim or top.
        middle: (3,) the gripped point of the object, world frame.
        seat: where that point belongs in the hand: along the fingers and along the closing direction, metres.
        pointing, closing: directions asked for of the hand, world frame.
        either_way: whether the opposite closing direction is as good.
        from_above: whether the hand comes down on the object, instead of along its fingers.
        opening: how far the hand is open on arrival.
    """

    family: str
    middle: Array
    seat: tuple[float, float]
    pointing: Array
    closing: Array
    either_way: bool = False
    from_above: bool = False
    opening: float = 1.0

    def hand(self, pointing: Array | None = None, closing: Array | None = None) -> HandPose:
        """The hand pose, for the directions asked for or for those that an arm can reach."""
        x = self.pointing if pointing is None else pointing
        y = self.closing if closing is None else closing
        site = self.middle - self.seat[0] * x - self.seat[1] * y
        return HandPose(site, x, y, self.either_way and closing is None)

    def retreat(self, pointing: Array) -> Array:
        """Unit direction in which the hand leaves."""
        return _UP if self.from_above else -pointing


def _directions(center: Array, shoulder: Array, elevations_deg: tuple[float, ...]) -> Iterator[Array]:
    """Pointing directions towards a point, nearest the straight line of sight first within each elevation."""
    flat = center[:2] - shoulder[:2]
    azimuth = float(np.arctan2(flat[1], flat[0]))
    for elevation in elevations_deg:
        for offset in (0.0, 25.0, -25.0, 50.0, -50.0):
            a, e = azimuth + np.deg2rad(offset), np.deg2rad(elevation)
            yield np.array([np.cos(a) * np.cos(e), np.sin(a) * np.cos(e), np.sin(e)])


@dataclass(frozen=True, slots=True)
class _Shape:
    """Solid bounding box of an object in its present pose: centre, axes, half extents, and preferred grip point."""

    center: Array
    rotation: Array
    half: Array
    bottom: float
    top: float
    grip: Array
    has_grip: bool


def _shape(body: Body, obj: ObjectInstance) -> _Shape:
    pose = body.world.poses.pose(obj.object_id)
    rotation = pose[:3, :3]
    low, high = solid_box(obj)
    center = pose[:3, 3] + rotation @ (0.5 * (low + high))
    half = 0.5 * (high - low)
    rise = float(np.abs(rotation[2]) @ half)
    has_grip = "single" in obj.type.grips
    grip = body.world.poses.grips(obj.object_id)[0] if has_grip else center
    return _Shape(center, rotation, half, float(center[2]) - rise, float(center[2]) + rise, grip, has_grip)


def solid_box(obj: ObjectInstance) -> tuple[Array, Array]:
    """Bounding box of the parts that can be touched, in the type's frame; what stands open is left out."""
    shut = [part for moving in obj.type.moving if obj.openness < _SHUT_SHARE for part in moving.parts]
    parts = [part for part in (*obj.type.parts, *shut) if not part.options & {"ghost", "handle"}]
    low = np.min([np.subtract(part.center, np.multiply(0.5, part.size)) for part in parts], axis=0)
    high = np.max([np.add(part.center, np.multiply(0.5, part.size)) for part in parts], axis=0)
    return low, high


def grasp_candidates(body: Body, arm: Arm, obj: ObjectInstance) -> Iterator[Grasp]:
    """Grasp candidates of an object, most promising first; the caller checks reachability."""
    hand = body.spec.hand
    shape = _shape(body, obj)
    shoulder = body.posture.shoulder(arm)
    yield from _wraps(obj, shape, hand, shoulder)
    yield from _rims(obj, shape, hand, shoulder)
    yield from _tops(shape, hand, shoulder)


def _wraps(obj: ObjectInstance, shape: _Shape, hand: HandSpec, shoulder: Array) -> Iterator[Grasp]:
    """Fingers on both sides: from the side when the object is tall, from above when it is low."""
    tall = shape.top - shape.bottom > 0.09
    elevations = (-35.0, -15.0, -55.0, 0.0, -75.0) if tall else (-60.0, -80.0, -40.0, -25.0)
    for pointing in _directions(shape.grip, shoulder, elevations):
        level = np.cross(_UP, pointing)
        level /= np.linalg.norm(level)
        closings = [level]
        if pointing[2] < -0.6:
            closings += [axis for axis in shape.rotation.T if abs(float(axis[2])) < 0.3 and abs(float(axis @ level)) < 0.97]
        for closing in closings:
            if shape.has_grip:
                radius = 0.5 * _local_width(obj, shape.rotation, closing)
            else:
                radius = float(np.abs(shape.rotation.T @ closing) @ shape.half)
                if len(obj.type.parts) and obj.type.parts[0].shape in ("cylinder", "cup", "ellipsoid", "capsule"):
                    radius = min(radius, float(np.sort(shape.half)[1]))
            if radius > hand.max_radius_m:
                continue
            seat = hand.seat(radius)
            forward = seat[0]
            drop = max(-float(pointing[2]), 0.0)
            reach_down = (hand.tip_m - forward) * drop + hand.half_width_m * float(np.sqrt(1.0 - drop * drop)) + 0.008
            z = max(float(shape.grip[2]), shape.bottom + reach_down)
            if z > shape.top + 0.25 * (hand.tip_m - forward) * drop - 0.004:
                continue
            middle = np.array([shape.grip[0], shape.grip[1], z])
            for sign in (1.0, -1.0):
                yield Grasp("wrap", middle, seat, pointing, sign * closing)


def _rims(obj: ObjectInstance, shape: _Shape, hand: HandSpec, shoulder: Array) -> Iterator[Grasp]:
    """Fingers on both sides of the wall of a wide vessel, from above."""
    hollow = any(part.wall_m > 0.0 for part in obj.type.parts)
    if not hollow or shape.has_grip or float(np.max(shape.half[:2])) < 0.05 or shape.top - shape.bottom < 0.04:
        return
    out = shoulder[:2] - shape.center[:2]
    start = float(np.arctan2(out[1], out[0]))
    for turn in (0.0, 60.0, -60.0, 110.0, -110.0, 180.0):
        angle = start + np.deg2rad(turn)
        radial = np.array([np.cos(angle), np.sin(angle), 0.0])
        edge = shape.center + radial * (_extent(shape.rotation, shape.half, radial) - 0.006)
        for pointing in _directions(edge, shoulder, (-60.0, -80.0, -40.0)):
            depth = min(0.03, 0.6 * (shape.top - shape.bottom))
            tip = np.array([edge[0], edge[1], shape.top - depth])
            seat = (hand.tip_m if hand.pinch_m is None else 0.05, hand.seat(0.008)[1])
            for sign in (1.0, -1.0):
                yield Grasp("rim", tip, seat, pointing, sign * radial)


def _tops(shape: _Shape, hand: HandSpec, shoulder: Array) -> Iterator[Grasp]:
    """Fingertips on the upper side: from above with parallel fingers, palm down and half closed with a five-finger hand."""
    top = np.array([shape.grip[0], shape.grip[1], shape.top if not shape.has_grip else min(shape.top, shape.grip[2] + 0.02)])
    if hand.pinch_m is None:
        for pointing in _directions(top, shoulder, (-70.0, -50.0, -85.0, -30.0)):
            level = np.cross(_UP, pointing)
            level /= np.linalg.norm(level)
            yield Grasp("top", top, (hand.tip_m - 0.004, 0.0), pointing, level, either_way=True)
        return
    for pointing in _directions(top, shoulder, (-25.0, -10.0, -45.0)):
        closing = -_UP - float(-_UP @ pointing) * pointing
        closing /= np.linalg.norm(closing)
        yield Grasp("top", top, (0.04, hand.pinch_m), pointing, closing, from_above=True, opening=0.5)


def _extent(rotation: Array, half: Array, direction: Array) -> float:
    """Distance from the middle of a box to its edge along a horizontal direction, at most a round object's radius."""
    local = np.abs(rotation.T @ direction)
    reach = np.min(half[local > 0.05] / local[local > 0.05])
    return float(min(reach, np.max(half)))


def _local_width(obj: ObjectInstance, rotation: Array, closing: Array) -> float:
    """Width of the part that is gripped: of the primitives around the grip point, along the closing direction."""
    local_closing = np.abs(rotation.T @ closing)
    grip = np.asarray(obj.type.grips["single"][0])
    widths = [0.02]
    for part in obj.type.parts:
        half = 0.5 * np.asarray(part.size)
        if "ghost" not in part.options and np.all(np.abs(grip - np.asarray(part.center)) <= half + 0.01):
            round_part = part.shape in ("cylinder", "capsule", "ellipsoid", "cup")
            width = float(2.0 * half[:2].max()) if round_part else float(2.0 * local_closing @ half)
            widths.append(width if part.wall_m == 0.0 else max(part.wall_m, 0.02))
    return max(widths)
