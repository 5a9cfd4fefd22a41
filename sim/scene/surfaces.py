"""Surfaces for people: wood, fabric, plaster, planks and tiles, drawn by code; planners see plain colours.

The textures are part of every compiled scene, and no geom has them: pictures for people put them on when they draw
(`sim.world.rendering`). They are greys that a geom's own colour shines through; the floor's has the two colours of the room.

Shape letters: H rows, W columns of a texture.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

import mujoco
import numpy as np
from numpy.typing import NDArray

Picture = NDArray[np.float64]

#: Materials by the colours of the catalogue that are of them.
SURFACES: Final = {
    "walnut": "surface/wood", "oak": "surface/wood", "pine": "surface/wood",
    "teal": "surface/fabric", "tealdark": "surface/fabric", "navy": "surface/fabric", "blue": "surface/fabric",
    "lampshade": "surface/fabric", "wicker": "surface/fabric",
}  # fmt: skip
PLASTER: Final = "surface/plaster"
FLOOR: Final = "surface/floor"
_SIDE: Final = 256
_FLOOR_SIDE: Final = 512
#: Metres that a texture covers.
_FLOOR_M, _PLASTER_M = 1.6, 1.2
_PLANK_ROWS: Final = 10
_TILES: Final = 4
#: A floor whose colours are this much redder than blue is of wood.
_WARM: Final = 0.08


def add_surfaces(spec: mujoco.MjSpec, floor_colors: Sequence[Sequence[float]]) -> None:
    """Adds textures and materials to a scene; nothing has them yet."""
    rng = np.random.default_rng(0)
    cube, flat = mujoco.mjtTexture.mjTEXTURE_CUBE, mujoco.mjtTexture.mjTEXTURE_2D
    first, second = (np.asarray(color, dtype=float) for color in floor_colors)
    warm = min(first[0] - first[2], second[0] - second[2]) > _WARM
    floor = _planks(rng, first, second) if warm else _tiles(rng, first, second)
    _add(spec, FLOOR, flat, floor, 1.0 / _FLOOR_M)
    _add(spec, PLASTER, flat, _grey(0.98 + 0.006 * _noise(rng, 16) + 0.012 * _noise(rng, 128)), 1.0 / _PLASTER_M)
    for name, face in (("surface/wood", _wood(rng, _SIDE)), ("surface/fabric", _fabric(rng))):
        _add(spec, name, cube, _grey(face), None)  # one square, for all faces of the cube


def _add(spec: mujoco.MjSpec, name: str, kind: mujoco.mjtTexture, picture: Picture, repeat: float | None) -> None:
    height, width, _ = picture.shape
    pixels = np.round(255.0 * picture.clip(0.0, 1.0)).astype(np.uint8)
    texture: Any = spec.add_texture(name=name, type=int(kind), width=width, height=height, nchannel=3)
    texture.data = pixels.tobytes()
    material = spec.add_material(name=name, specular=0.0)
    if repeat is not None:
        material.texrepeat, material.texuniform = [repeat, repeat], True
    material.textures[int(mujoco.mjtTextureRole.mjTEXROLE_RGB)] = name


def _grey(values: NDArray[np.float64]) -> Picture:
    return np.repeat(values[:, :, None], 3, axis=2)


def _noise(rng: np.random.Generator, cells: int, side: int = _SIDE, stretch: int = 1) -> NDArray[np.float64]:
    """(side, side) smooth noise in [-1, 1] that repeats at its edges; `cells` grains along a column, fewer along a row."""
    coarse = rng.uniform(-1.0, 1.0, (cells, max(1, cells // stretch)))
    for axis in (0, 1):
        count = coarse.shape[axis]
        place = np.arange(side) * count / side
        low = np.floor(place).astype(int)
        share = place - low
        share = (share * share * (3.0 - 2.0 * share)).reshape((-1, 1) if axis == 0 else (1, -1))
        coarse = np.take(coarse, low % count, axis) * (1.0 - share) + np.take(coarse, (low + 1) % count, axis) * share
    return coarse


def _wood(rng: np.random.Generator, side: int) -> NDArray[np.float64]:
    """Grain along the rows."""
    rings = np.arange(side)[:, None] / side * 9.0 + 1.2 * _noise(rng, 6, side, 3)
    fibres = _noise(rng, side // 2, side, 16)
    return 0.90 + 0.06 * np.sin(2.0 * np.pi * rings) + 0.05 * fibres


def _fabric(rng: np.random.Generator) -> NDArray[np.float64]:
    thread = np.abs(np.sin(np.arange(_SIDE) * np.pi / 4.0))
    woven = np.where((np.indices((_SIDE, _SIDE)).sum(0) // 4) % 2 == 0, thread[None, :], thread[:, None])
    return 0.86 + 0.10 * woven + 0.03 * _noise(rng, 32)


def _planks(rng: np.random.Generator, first: Picture, second: Picture) -> Picture:
    """Boards of two lengths, each with a colour between the two."""
    picture = np.zeros((_FLOOR_SIDE, _FLOOR_SIDE, 3))
    grain = _wood(rng, _FLOOR_SIDE) + 0.06
    edges = np.linspace(0, _FLOOR_SIDE, _PLANK_ROWS + 1).astype(int)
    for row, (top, bottom) in enumerate(zip(edges[:-1], edges[1:], strict=True)):
        joint = int(_FLOOR_SIDE * ((row * 0.37) % 1.0))
        board = (np.arange(_FLOOR_SIDE) - joint) % _FLOOR_SIDE // (_FLOOR_SIDE // 2)
        tints = rng.uniform(0.1, 0.9, 2)[board][:, None]
        picture[top:bottom] = (tints * first + (1.0 - tints) * second)[None]
        picture[top:bottom] *= np.roll(grain, int(rng.integers(_FLOOR_SIDE)), axis=1)[top:bottom, :, None]
        picture[top] *= 0.72
        picture[top:bottom, [joint, (joint + _FLOOR_SIDE // 2) % _FLOOR_SIDE]] *= 0.75
    return picture


def _tiles(rng: np.random.Generator, first: Picture, second: Picture) -> Picture:
    """Square tiles between grout."""
    side = _FLOOR_SIDE // _TILES
    tints = np.kron(rng.uniform(0.4, 0.8, (_TILES, _TILES)), np.ones((side, side)))[:, :, None]
    picture = tints * first + (1.0 - tints) * second
    picture *= (1.0 + 0.02 * _noise(rng, 64, _FLOOR_SIDE))[:, :, None]
    grout = np.arange(_FLOOR_SIDE) % side < 4
    picture[grout] = picture[:, grout] = 0.8 * (0.5 * first + 0.5 * second)
    return picture
