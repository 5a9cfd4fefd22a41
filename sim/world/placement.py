"""Where objects rest and where there is room for one: surfaces of receptacles, free spots, containment.

Pure geometry on the current poses. World frame in and out, metres. Paper: receptacles and `parentReceptacles` of DualTHOR.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Final

import mujoco
import numpy as np
from numpy.typing import NDArray

from sim.scene.catalogue import ObjectType
from sim.scene.objects import ObjectInstance, Surface

#: Depth from a receptacle's reachable edge within which objects are put.
REACH_BAND_M: Final = 0.35
#: Share of an object's narrow half that has to be on the surface: a wide load may stand over the edge by the rest.
OVERHANG_SHARE: Final = 0.6
_GRID_M: Final = 0.02
_SMALL_M: Final = 0.15


def box_in_world(data: mujoco.MjData, obj: ObjectInstance) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Axis-aligned bounding box (minimum, maximum) of an object with its doors closed, world frame."""
    rotation = data.xmat[obj.body_id].reshape(3, 3)
    center = data.xpos[obj.body_id] + rotation @ ((obj.local_min + obj.local_max) / 2.0)
    half = np.abs(rotation) @ ((obj.local_max - obj.local_min) / 2.0)
    return center - half, center + half


def boxes_in_world(data: mujoco.MjData, objects: Sequence[ObjectInstance]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(N, 3) minima and maxima of `box_in_world` of several objects."""
    bodies = [obj.body_id for obj in objects]
    low, high = np.array([obj.local_min for obj in objects]), np.array([obj.local_max for obj in objects])
    rotations = data.xmat[bodies].reshape(-1, 3, 3)
    center = data.xpos[bodies] + np.einsum("nij,nj->ni", rotations, (low + high) / 2.0)
    half = np.einsum("nij,nj->ni", np.abs(rotations), (high - low) / 2.0)
    return center - half, center + half


def fits_on(kind: ObjectType, place: ObjectType) -> bool:
    """Whether an object can stand on a surface of a type, in any orientation, with its whole footprint."""
    radius, height = float(np.hypot(kind.size[0], kind.size[1])) / 2.0, kind.size[2]
    surfaces = [*place.surfaces, *(surface for moving in place.moving for surface in moving.surfaces)]
    return any(min(s.rect[2], s.rect[3]) / 2.0 >= radius + 0.01 and (s.clearance >= height or not s.inside) for s in surfaces)


def _is_hollow(obj: ObjectInstance) -> bool:
    return any(part.wall_m > 0.0 for part in obj.type.parts)


def _to_world(data: mujoco.MjData, surface: Surface, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """(N, 3) points of the type's frame in the world."""
    return data.xpos[surface.body_id] + (points - surface.origin) @ data.xmat[surface.body_id].reshape(3, 3).T


def find_free_spot(
    data: mujoco.MjData,
    objects: Mapping[str, ObjectInstance],
    receptacle: ObjectInstance,
    radius_m: float,
    *,
    height_m: float = 0.1,
    near: NDArray[np.float64] | None = None,
    rng: np.random.Generator | None = None,
    gap_m: float = 0.03,
    ignore: Iterable[str] = (),
    band_m: float = REACH_BAND_M,
    through_doors: bool,
) -> NDArray[np.float64] | None:
    """A point on a receptacle's surfaces where an object of that footprint can be put.

    Args:
        data: current poses.
        objects: everything in the scene; obstacles are all objects but the receptacle and `ignore`.
        receptacle: where to put it; surfaces behind a closed door are skipped, unless `through_doors`.
        radius_m: radius of the footprint.
        height_m: height of the object, must fit below the surface's clearance.
        near: (2,) or (3,) world point; the nearest free spot is taken. Without it, `rng` draws one; without both, the spot
            nearest to the middle of the reachable edge is taken.
        rng: random stream.
        gap_m: free distance to other objects.
        ignore: ids that do not block (the object itself).
        band_m: how far from the reachable edge a spot may be.
        through_doors: whether closed doors do not matter, as at the start of an episode.

    Returns:
        (3,) world point on the surface, or None when there is no room.
    """
    skip = {receptacle.object_id, *ignore}
    others = [obj for name, obj in objects.items() if name not in skip]
    lows, highs = boxes_in_world(data, others) if others else (np.zeros((0, 3)), np.zeros((0, 3)))
    found: list[NDArray[np.float64]] = []
    for surface in receptacle.surfaces:
        spec = surface.spec
        if spec.inside and (height_m > spec.clearance or not (receptacle.is_open or through_doors)):
            continue
        if height_m > spec.clearance + (0.3 if _is_hollow(receptacle) else 10.0):
            continue
        points = _candidates(receptacle, surface, radius_m, band_m)
        if not len(points):
            continue
        world = _to_world(data, surface, points)
        top = world[0, 2]
        # what carries the receptacle itself does not block: its top is below the surface
        level = (highs[:, 2] > top + 0.004) & (lows[:, 2] <= top + height_m)
        reach = radius_m + gap_m
        level &= np.all(
            (lows[:, :2] <= world[:, :2].max(axis=0) + reach) & (highs[:, :2] >= world[:, :2].min(axis=0) - reach), axis=1
        )
        near_lows, near_highs = lows[level, None, :2], highs[level, None, :2]
        outside = np.maximum(np.maximum(near_lows - world[:, :2], world[:, :2] - near_highs), 0.0)  # (B, P, 2)
        free = np.all(np.hypot(outside[..., 0], outside[..., 1]) >= reach, axis=0)
        if free.any():
            found.append(world[free])
            if spec.inside and near is None:
                break  # the first shelf with room; the order in the catalogue is the order of comfort
    if not found:
        return None
    spots = np.concatenate(found)
    if near is not None:
        return spots[int(np.argmin(np.linalg.norm(spots[:, : len(near)] - near, axis=1)))]
    if rng is not None:
        return spots[int(rng.integers(len(spots)))]
    middle = spots.mean(axis=0)
    return spots[int(np.argmin(np.linalg.norm(spots - middle, axis=1)))]


def _candidates(receptacle: ObjectInstance, surface: Surface, radius_m: float, band_m: float) -> NDArray[np.float64]:
    """(N, 3) grid points of the type's frame on which a footprint of that radius fits, within the reachable band."""
    cx, cy, sx, sy = surface.spec.rect
    halves = []
    for half in (sx / 2.0, sy / 2.0):
        if radius_m <= half:
            halves.append(half - radius_m)
        elif not _is_hollow(receptacle) and half < _SMALL_M:
            halves.append(0.0)  # a plate or burner carries what is wider than itself
        else:
            return np.zeros((0, 3))
    xs, ys = (np.arange(-np.floor(h / _GRID_M), np.floor(h / _GRID_M) + 1) * _GRID_M for h in halves)
    grid = np.stack(np.meshgrid(cx + xs, cy + ys), axis=-1).reshape(-1, 2)
    low, high = receptacle.local_min, receptacle.local_max
    if surface.spec.all_sides:
        edge = np.min([grid[:, 0] - low[0], high[0] - grid[:, 0], grid[:, 1] - low[1], high[1] - grid[:, 1]], axis=0)
    else:
        edge = grid[:, 1] - low[1]
    grid = grid[edge <= max(band_m, radius_m + 0.02)]
    return np.column_stack([grid, np.full(len(grid), surface.spec.z)])


def above_surfaces(data: mujoco.MjData, objects: Mapping[str, ObjectInstance]) -> dict[str, tuple[str, ...]]:
    """Receptacles that every movable object is on or in by position, the highest surface first.

    An object is on a surface when its middle is above the rectangle and its lowest point is at the surface (3 cm, or 6 mm
    while a hand holds it), or, for hollow receptacles, below the rim. The highest one carries it, so an apple in a bowl on a
    table belongs to the bowl.
    """
    surfaces = [(obj, surface) for obj in objects.values() for surface in obj.surfaces]
    if not surfaces:
        return {}
    owners = [obj.object_id for obj, _ in surfaces]
    bodies = np.array([surface.body_id for _, surface in surfaces])
    rects = np.array([surface.spec.rect for _, surface in surfaces])
    origins = np.array([surface.origin for _, surface in surfaces])
    heights = np.array([surface.spec.z for _, surface in surfaces])
    hollow = np.array([_is_hollow(obj) for obj, _ in surfaces])
    heaps = hollow & np.array([obj.type.lidded or not surface.spec.inside for obj, surface in surfaces])
    reach = np.where(heaps, 0.6 * np.array([surface.spec.clearance for _, surface in surfaces]), 0.03)
    margin = np.where(hollow, 0.02, 0.05)[:, None]
    levels = data.xpos[bodies, 2] - origins[:, 2] + heights
    turns = data.xmat[bodies].reshape(-1, 3, 3)
    movable = [obj for obj in objects.values() if obj.movable]
    if not movable:
        return {}
    lows, highs = boxes_in_world(data, movable)
    bottoms = np.column_stack([(lows[:, :2] + highs[:, :2]) / 2.0, lows[:, 2]])
    found: dict[str, tuple[str, ...]] = {}
    for obj, bottom in zip(movable, bottoms, strict=True):
        local = np.einsum("sji,sj->si", turns, bottom - data.xpos[bodies]) + origins
        within = np.all(np.abs(local[:, :2] - rects[:, :2]) <= rects[:, 2:] / 2.0 + margin, axis=1)
        rise = local[:, 2] - heights
        carries = np.flatnonzero(within & (rise >= -0.02) & (rise <= (0.006 if obj.held_by else reach)))
        best = carries[np.argsort(-levels[carries], kind="stable")]
        found[obj.object_id] = tuple(dict.fromkeys(owners[k] for k in best if owners[k] != obj.object_id))
    return found
