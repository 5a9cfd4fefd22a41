"""Where objects are: poses, bounding boxes, and the points at which hands use them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sim.world.placement import box_in_world
from sim.world.scene_state import SceneState, WorldError


class ObjectPoses:
    """Geometry of the objects of a running scene; world frame, metres.

    Args:
        scene: the running scene.
    """

    def __init__(self, scene: SceneState) -> None:
        self._scene = scene

    def pose(self, object_id: str) -> NDArray[np.float64]:
        """(4, 4) pose of an object's frame (centre of the footprint, on the ground)."""
        item, pose = self._scene.object(object_id), np.eye(4)
        pose[:3, :3] = self._scene.data.xmat[item.body_id].reshape(3, 3)
        pose[:3, 3] = self._scene.data.xpos[item.body_id]
        return pose

    def center(self, object_id: str) -> NDArray[np.float64]:
        """(3,) centre of the bounding box."""
        item = self._scene.object(object_id)
        rotation = self._scene.data.xmat[item.body_id].reshape(3, 3)
        return self._scene.data.xpos[item.body_id] + rotation @ (0.5 * (item.local_min + item.local_max))

    def bounds(self, object_id: str) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Axis-aligned bounding box (minimum, maximum), doors closed."""
        return box_in_world(self._scene.data, self._scene.object(object_id))

    def front(self, object_id: str) -> NDArray[np.float64]:
        """(2,) horizontal unit vector out of the object's front, where a robot stands to use it."""
        axis = -self._scene.data.xmat[self._scene.object(object_id).body_id].reshape(3, 3)[:2, 1]
        return axis / max(float(np.linalg.norm(axis)), 1e-9)

    def tilt_deg(self, object_id: str) -> float:
        """Angle between how an object lies and the nearest attitude in which it would rest by itself on a plane."""
        item = self._scene.object(object_id)
        shape, up = item.type.parts[0].shape, self._scene.data.xmat[item.body_id].reshape(3, 3)[2]
        if shape == "ellipsoid" and max(item.type.size) < 1.5 * min(item.type.size):
            return 0.0  # a ball
        off = np.degrees(np.arccos(np.clip(np.abs(up), 0.0, 1.0)))  # of each axis from the vertical
        if shape in ("cylinder", "cup", "capsule", "ellipsoid"):
            return float(min(off[2], 90.0 - off[2]))
        return float(off.min())

    def grips(self, object_id: str, kind: str = "single") -> NDArray[np.float64]:
        """(N, 3) points where hands hold it: one for `single`, two (at +x and -x of the object) for `double`."""
        item = self._scene.object(object_id)
        points = item.type.grips.get(kind)
        if points is None:
            middle = (item.local_min + item.local_max) / 2.0
            ends = (middle[0],) if kind == "single" else (item.local_max[0], item.local_min[0])
            points = tuple((x, middle[1], middle[2]) for x in ends)
        pose = self.pose(object_id)
        return np.asarray(points) @ pose[:3, :3].T + pose[:3, 3]

    def handle(self, object_id: str) -> NDArray[np.float64]:
        """(3,) position of the handle of a door or drawer.

        Raises:
            WorldError: when the object has none.
        """
        item = self._scene.object(object_id)
        sites = [part.handle_site for part in item.moving if part.handle_site >= 0]
        if not sites:
            raise WorldError(f"{object_id} has no handle")
        return self._scene.data.site_xpos[sites[0]].copy()

    def toggle_point(self, object_id: str) -> NDArray[np.float64]:
        """(3,) point a finger touches to switch an object.

        Raises:
            WorldError: when the object cannot be switched.
        """
        item = self._scene.object(object_id)
        if item.toggle_site < 0:
            raise WorldError(f"{object_id} has no switch")
        return self._scene.data.site_xpos[item.toggle_site].copy()

    def speed_m_s(self, object_id: str) -> float:
        """Speed of a free object, 0 for furniture."""
        item = self._scene.object(object_id)
        return float(np.linalg.norm(self._scene.data.qvel[item.dof_adr : item.dof_adr + 3])) if item.movable else 0.0
