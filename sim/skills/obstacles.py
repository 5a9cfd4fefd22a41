"""The navigation map of a world as it is now: walls, furniture, doors, and what lies on the floor.

Maps are cached by the arrangement of obstacles, because most steps change nothing that the base could run into.

Constants were chosen by hand; with them the certificates of the 359 benchmark tasks were made on both robots.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Final

import mujoco
import numpy as np

from sim.scene.compiler import MOVABLE_BITS, STATIC_BITS
from sim.skills.navigation import NavigationMap, Rectangle
from sim.world.world import World

#: Geoms whose lowest point is above this are passed under, and those below the ankle are stepped over.
_HEAD_M: Final = 1.9
_STEP_M: Final = 0.03
#: Movable objects that start higher lie on furniture, which is an obstacle already.
_LYING_M: Final = 0.3
_ROUND_M: Final = 0.01


def obstacle_rectangles(world: World, without: int = -1) -> tuple[Rectangle, ...]:
    """Rectangles on the floor of all that the base must not run into, rounded to a centimetre, except one MuJoCo body."""
    model, data = world.model, world.data
    movable = {obj.body_id for obj in world.objects.values() if obj.held_by}
    found: set[Rectangle] = set()
    for geom in range(model.ngeom):
        body = int(model.geom_bodyid[geom])
        bits = int(model.geom_contype[geom])
        if bits not in (STATIC_BITS[0], MOVABLE_BITS[0]) or int(model.geom_type[geom]) == int(mujoco.mjtGeom.mjGEOM_PLANE):
            continue
        if body in movable or body == without:
            continue
        rotation = data.geom_xmat[geom].reshape(3, 3)
        center = data.geom_xpos[geom] + rotation @ model.geom_aabb[geom, :3]
        half = model.geom_aabb[geom, 3:]
        rise = float(np.abs(rotation[2]) @ half)
        if bits == MOVABLE_BITS[0] and center[2] - rise > _LYING_M:
            continue
        if center[2] - rise > _HEAD_M or center[2] + rise < _STEP_M or center[1] > world.room.bounds[3] + 1.0:
            continue
        found.add(_footprint(center, rotation, half))
    return tuple(sorted(found, key=lambda r: (r.center, r.half, r.yaw_rad)))


def _footprint(center: np.ndarray, rotation: np.ndarray, half: np.ndarray) -> Rectangle:
    """Smallest upright box around a turned box, with the yaw of its most horizontal axis."""
    axis = int(np.argmin(np.abs(rotation[2])))
    yaw = float(np.arctan2(rotation[1, axis], rotation[0, axis])) % (np.pi / 2.0)
    c, s = np.cos(yaw), np.sin(yaw)
    turned = np.array([[c, s], [-s, c]]) @ rotation[:2]
    hx, hy = np.abs(turned) @ half

    def rounded(value: float) -> float:
        return round(float(value) / _ROUND_M) * _ROUND_M

    return Rectangle((rounded(center[0]), rounded(center[1])), (rounded(hx), rounded(hy)), round(yaw, 2))


def navigation_map(world: World, radius_m: float, without: int = -1) -> NavigationMap:
    """Free space of the base in a world, as if one MuJoCo body were not there."""
    return _cached(world.room.bounds, obstacle_rectangles(world, without), radius_m)


@lru_cache(maxsize=32)
def _cached(bounds: tuple[float, float, float, float], obstacles: tuple[Rectangle, ...], radius_m: float) -> NavigationMap:
    return NavigationMap(bounds, obstacles, radius_m)
