"""What is drawn for people alone: skirting boards, windows and round bowls. Planners and physics know nothing of it.

A wall is a plane with x along it, y up and z into the room. A window goes into the middle of the widest stretch of a wall that
no furniture covers, on the two walls that have most room for one.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import mujoco
import numpy as np
from numpy.typing import NDArray

from sim.world.scene_state import SceneState

#: Height and half thickness of skirting boards.
_SKIRTING_M: Final = (0.09, 0.012)
#: Sill and lintel over the floor, the greatest width, and the wall that stays free at either side.
_SILL_M, _LINTEL_M, _WIDTH_M, _CLEAR_M = 1.0, 2.05, 1.5, 0.25
_LEAST_M: Final = 0.7
_FRAME_M: Final = 0.035
_WINDOWS: Final = 2
#: Furniture so close to a wall covers it.
_NEAR_M: Final = 0.7
_WHITE, _SKY = (0.92, 0.92, 0.90, 1.0), (0.72, 0.84, 0.95, 1.0)


@dataclass(frozen=True, slots=True)
class Board:
    """A box on a wall: its half sizes and centre, in the wall's axes, the wall's geom, and its colour."""

    wall: int
    size: NDArray[np.float64]
    centre: NDArray[np.float64]
    rgba: tuple[float, float, float, float]


def wall_decor(scene: SceneState) -> list[Board]:
    """Skirting boards of all walls, and the windows."""
    model = scene.model
    walls = [geom for geom in range(model.ngeom) if model.geom(geom).name.startswith("wall_")]
    boards: list[Board] = []
    for wall in walls:
        half = model.geom_size[wall]
        height, thick = _SKIRTING_M
        boards.append(_board(wall, (0.0, height / 2.0 - half[1]), (half[0], height / 2.0), thick, _WHITE))
    free = sorted(((*_widest(scene, wall), wall) for wall in walls), key=lambda one: one[0] - one[1])
    for low, high, wall in free[:_WINDOWS]:
        width = min(_WIDTH_M, high - low - 2.0 * _CLEAR_M)
        if width >= _LEAST_M and model.geom_size[wall, 1] * 2.0 > _LINTEL_M:
            boards += _window(wall, (low + high) / 2.0, width / 2.0, float(model.geom_size[wall, 1]))
    return boards


def ring_walls(scene: SceneState) -> dict[int, float]:
    """Boxes that are walls of a bowl or pot, by geom; the radius at the middle of the wall, metres. Their x points outwards."""
    box = int(mujoco.mjtGeom.mjGEOM_BOX)
    return {
        geom: min(part.size[:2]) / 2.0 - float(scene.model.geom_size[geom, 0])
        for parts in scene.part_of_geom.values()
        for geom, part in parts
        if part.shape == "cup" and int(scene.model.geom_type[geom]) == box
    }


def _board(
    wall: int, centre: tuple[float, float], half: tuple[float, float], thick: float, rgba: tuple[float, float, float, float]
) -> Board:
    return Board(wall, np.array([*half, thick]), np.array([*centre, 0.0]), rgba)


def _window(wall: int, x: float, half: float, middle: float) -> list[Board]:
    """Glass, a frame, a cross and a sill; `middle` is the height of the wall's own centre."""
    y, tall = (_SILL_M + _LINTEL_M) / 2.0 - middle, (_LINTEL_M - _SILL_M) / 2.0
    frame = _FRAME_M
    return [
        _board(wall, (x, y), (half, tall), 0.004, _SKY),
        *(_board(wall, (x + side * half, y), (frame, tall + frame), 0.02, _WHITE) for side in (-1, 1)),
        *(_board(wall, (x, y + side * tall), (half, frame), 0.02, _WHITE) for side in (-1, 1)),
        _board(wall, (x, y), (frame / 2.0, tall), 0.012, _WHITE),
        _board(wall, (x, y + tall / 3.0), (half, frame / 2.0), 0.012, _WHITE),
        _board(wall, (x, y - tall - 1.6 * frame), (half + 2.0 * frame, frame / 2.0), 0.06, _WHITE),
    ]


def _widest(scene: SceneState, wall: int) -> tuple[float, float]:
    """The widest stretch of a wall, along its x in metres, that no furniture covers at a window's height."""
    model, data = scene.model, scene.data
    turn, place, half = data.geom_xmat[wall].reshape(3, 3), data.geom_xpos[wall], model.geom_size[wall]
    fixed = (model.body_weldid[model.geom_bodyid] == 0) & (model.geom_type != int(mujoco.mjtGeom.mjGEOM_PLANE))
    covered = [(-np.inf, -half[0]), (half[0], np.inf)]
    for geom in np.flatnonzero(fixed & (model.geom_rbound > 0.0)):
        axes = data.geom_xmat[geom].reshape(3, 3)
        centre = turn.T @ (data.geom_xpos[geom] + axes @ model.geom_aabb[geom, :3] - place)
        reach = np.abs(turn.T @ axes) @ model.geom_aabb[geom, 3:]
        if centre[2] - reach[2] < _NEAR_M and centre[1] + reach[1] > _SILL_M - half[1]:
            covered.append((centre[0] - reach[0], centre[0] + reach[0]))
    covered.sort()
    low, best = covered[0][1], (0.0, 0.0)
    for begin, end in covered[1:]:
        if begin - low > best[1] - best[0]:
            best = (low, begin)
        low = max(low, end)
    return float(best[0]), float(best[1])
