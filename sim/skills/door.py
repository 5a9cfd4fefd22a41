"""The geometry of a hinged door or a drawer: where its face is at every joint position, and on which side of it an arm is.

A drawer's front is a door whose hinge is one end of it and slides along with it.

Frames: world. The paper has no counterpart: Close is ours.

Constants were chosen by hand; with them the certificates of the 359 benchmark tasks were made on both robots, and
`benchmarks/doors.py` shows what they give on every door, drawer and lid of the ten rooms.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from sim.scene.objects import MovingPart, ObjectInstance
from sim.skills.body.body import Body
from sim.skills.body.clearance import AtDoor

Array = NDArray[np.float64]

#: Thickness of an upper arm or forearm around its bone.
_BONE_M: Final = 0.035
#: Length of a hand before its wrist, measured from the grasp site.
_HAND_M: Final = 0.14


@dataclass(frozen=True, slots=True)
class Door:
    """The geometry of a hinged door or a drawer.

    Attributes:
        part: its joint.
        anchor: (3,) a point of the hinge; of a drawer, the end of the shut front at the left of a robot before it.
        axis: (3,) unit vector along the hinge, or along the way in which a drawer opens.
        front: (3,) outward normal of the shut door.
        side: (3,) direction of the shut door from the hinge to the free edge.
        width_m: distance from the hinge to the free edge.
        face_m: how far the outside face is in front of the hinge.
        back_m: how far the inside face, or a drawer's far end, is in front of the hinge.
        heights: (low, high) of the panel, world.
        now: present joint position.
    """

    part: MovingPart
    anchor: Array
    axis: Array
    front: Array
    side: Array
    width_m: float
    face_m: float
    back_m: float
    heights: tuple[float, float]
    now: float

    @staticmethod
    def of(body: Body, obj: ObjectInstance, part: MovingPart) -> Door:
        """Reads a door off the model."""
        model, data = body.world.model, body.world.data
        geoms = np.flatnonzero((model.geom_bodyid == part.body_id) & (model.geom_contype > 0))
        panel = max(map(int, geoms), key=lambda geom: float(model.geom_aabb[geom, 3] * model.geom_aabb[geom, 5]))
        center, half = model.geom_pos[panel], model.geom_aabb[panel, 3:]
        frame, now = data.xmat[obj.body_id].reshape(3, 3), float(data.qpos[part.qpos_adr])
        axis, anchor = data.xaxis[part.joint_id].copy(), data.xanchor[part.joint_id].copy()
        height = float(data.geom_xpos[panel][2])
        if part.spec.joint == "slide":
            anchor = data.geom_xpos[panel] - now * axis - half[0] * frame[:, 0]
            ends = (data.geom_xpos[geoms] - now * axis - anchor) @ frame[:, 1] + model.geom_aabb[geoms, 4]
            sign, width, face, back = 1.0, 2.0 * half[0], half[1], -np.max(ends)
        else:
            sign = 1.0 if center[0] > 0.0 else -1.0
            width, face, back = abs(center[0]) + half[0], half[1] - center[1], -half[1] - center[1]
        return Door(
            part=part,
            anchor=anchor,
            axis=axis,
            front=-frame[:, 1].copy(),
            side=sign * frame[:, 0].copy(),
            width_m=float(width),
            face_m=float(face),
            back_m=float(back),
            heights=(height - float(half[2]), height + float(half[2])),
            now=now,
        )

    @property
    def slides(self) -> bool:
        """Whether it is a drawer."""
        return self.part.spec.joint == "slide"

    def hinge(self, position: float) -> Array:
        """(3,) where `anchor` is at a joint position."""
        return self.anchor + position * self.axis if self.slides else self.anchor

    def _turned(self, direction: Array, position: float) -> Array:
        if self.slides:
            return direction
        c, s = np.cos(position), np.sin(position)
        return c * direction + s * np.cross(self.axis, direction)

    def normal(self, position: float) -> Array:
        """(3,) outward normal of the door at a joint position."""
        return self._turned(self.front, position)

    def along(self, position: float) -> Array:
        """(3,) direction from the hinge to the free edge at a joint position."""
        return self._turned(self.side, position)

    def point(self, position: float, along_m: float, height_m: float, out_m: float = 0.0) -> Array:
        """(3,) point so far from the hinge, at a world height, and so far before the outside face."""
        found = self.hinge(position) + along_m * self.along(position) + (self.face_m + out_m) * self.normal(position)
        return np.array([found[0], found[1], height_m])

    def distance_m(self, points: Array, position: float) -> Array:
        """(N,) horizontal distances between floor points (N, 2) and the door at a joint position."""
        delta = points - self.hinge(position)[:2]
        u, v = delta @ self.along(position)[:2], delta @ self.normal(position)[:2]
        outside_u = np.maximum(np.maximum(-u, u - self.width_m), 0.0)
        outside_v = np.maximum(np.maximum(self.back_m - v, v - self.face_m), 0.0)
        return np.hypot(outside_u, outside_v)

    def before(self, state: AtDoor, position: float) -> bool:
        """Whether the whole hand is on the outer side of the door."""
        return float(np.min((state.hand - self.hinge(position)) @ self.normal(position))) >= self.face_m

    def outside(self, state: AtDoor, position: float) -> bool:
        """Whether the hand is before the door and neither forearm nor upper arm passes through it."""
        if not self.before(state, position):
            return False
        shoulder, elbow, site = state.bones
        forearm = float(np.linalg.norm(site - elbow))
        wrist = elbow + (site - elbow) * max(forearm - _HAND_M, 0.0) / max(forearm, 1e-9)  # the hand itself touches the door
        shares = np.linspace(0.0, 1.0, 15)[:, None]
        line = np.concatenate([shoulder + shares * (elbow - shoulder), elbow + shares * (wrist - elbow)])
        delta = line - self.hinge(position)
        u, v = delta @ self.along(position), delta @ self.normal(position)
        inside = (u > -0.05) & (u < self.width_m + _BONE_M) & (v > self.back_m - _BONE_M) & (v < self.face_m + 0.4 * _BONE_M)
        inside &= (line[:, 2] > self.heights[0] - _BONE_M) & (line[:, 2] < self.heights[1] + _BONE_M)
        return not bool(np.any(inside))
