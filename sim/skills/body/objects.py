"""Objects as hands and feet use them: points to reach for, sides to stand at, geoms to touch. World frame, metres."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sim.scene.objects import ObjectInstance
from sim.world.facts import world_facts
from sim.world.world import World

Array = NDArray[np.float64]


class ObjectGeometry:
    """Points and geoms of the objects of a world."""

    def __init__(self, world: World) -> None:
        self._world = world

    def interaction_point(self, object_id: str) -> Array:
        """(3,) world point that a robot faces when it approaches an object: handle, interior, switch or centre."""
        obj = self._world.objects[object_id]
        if obj.movable and obj.type.lidded:  # to lift it as well as to open it
            return self._world.poses.center(object_id)
        if obj.is_shut and obj.moving[0].handle_site >= 0:
            return self._world.data.site_xpos[obj.moving[0].handle_site].copy()
        if obj.type.encloses:
            surface = obj.surfaces[0]
            local = np.array([surface.spec.rect[0], surface.spec.rect[1], surface.spec.z]) - surface.origin
            return self._world.data.xpos[surface.body_id] + self._world.data.xmat[surface.body_id].reshape(3, 3) @ local
        if obj.toggle_site >= 0 and not obj.type.pickupable:
            return self._world.data.site_xpos[obj.toggle_site].copy()
        return self._world.poses.center(object_id)

    def faces_rad(self, object_id: str) -> tuple[float, ...]:
        """Preferred approach directions (world yaw) of an object: square to its support, or to its own sides."""
        item, square = world_facts(self._world).objects[object_id], self._world.objects[object_id]
        if item.can.movable and not item.two_handed:
            if not item.carriers:
                return ()
            square = self._world.objects[item.carriers[-1]]
        # a tap may stand beside its basin, which is used from the basin's front
        front = self._world.poses.front(self._world.room.links.get(square.object_id, square.object_id))
        angle = float(np.arctan2(front[1], front[0]))
        sides = square.movable or any(surface.spec.all_sides for surface in square.surfaces)
        return tuple(angle + k * np.pi / 2.0 for k in range(4)) if sides else (angle,)

    def solid_geoms(self, obj: ObjectInstance) -> NDArray[np.int64]:
        """Geoms of an object that take part in contacts."""
        return obj.geom_ids[self._world.model.geom_contype[obj.geom_ids] > 0]

    def part_geoms(self, obj: ObjectInstance, option: str) -> NDArray[np.int64]:
        """Geoms of an object's parts with a catalogue option, such as `handle` or `toggle`."""
        return np.array(
            [geom for geom, part in self._world.scene.part_of_geom[obj.object_id] if option in part.options], dtype=np.int64
        )
