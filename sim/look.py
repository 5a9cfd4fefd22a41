"""Pictures of every room and of all object types, for the eye: `python -m sim.look [folder]`.

Writes each room from above and through the robot's head camera, and a contact sheet of the types. Not part of any experiment.
"""

from __future__ import annotations

import sys
from pathlib import Path

import imageio.v3 as iio
import mujoco
import numpy as np
from numpy.typing import NDArray

from sim.catalogue import load_catalogue
from sim.robots.spec import load_robot
from sim.rooms import room_names
from sim.scene import build_type_spec
from sim.world import World

__all__ = ["contact_sheet", "main", "room_pictures"]


def room_pictures(folder: Path, robot: str = "h1") -> list[Path]:
    """Overview, plan, head view at 500 and 112 pixels and side view of every room with its default objects."""
    written: list[Path] = []
    for room in room_names():
        world = World(load_robot(robot), room)
        for camera, height, width in (
            ("overview", 720, 960),
            ("plan", 720, 720),
            ("head", 500, 500),
            ("head", 112, 112),
            ("left", 500, 500),
        ):
            path = folder / f"{room}_{camera}_{width}.png"
            iio.imwrite(path, world.render(camera, height, width).rgb)
            written.append(path)
    return written


def contact_sheet(size: int = 112, columns: int = 12) -> NDArray[np.uint8]:
    """(rows * size, columns * size, 3) every type of the catalogue alone, in the catalogue's order."""
    tiles = [_tile(name, size) for name in load_catalogue().types]
    blank = np.full_like(tiles[0], 255)
    rows = -(-len(tiles) // columns)
    tiles += [blank] * (rows * columns - len(tiles))
    return np.concatenate([np.concatenate(tiles[r * columns : (r + 1) * columns], axis=1) for r in range(rows)], axis=0)


def _tile(type_name: str, size: int) -> NDArray[np.uint8]:
    model = build_type_spec(type_name).compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    with mujoco.Renderer(model, size, size) as renderer:
        renderer.update_scene(data, camera="view")
        return renderer.render().copy()


def main(folder: Path) -> list[Path]:
    """Writes all pictures and returns their paths."""
    folder.mkdir(parents=True, exist_ok=True)
    sheet = folder / "types.png"
    iio.imwrite(sheet, contact_sheet())
    return [sheet, *room_pictures(folder)]


if __name__ == "__main__":
    for written in main(Path(sys.argv[1] if len(sys.argv) > 1 else "outputs/look")):
        print(written)  # noqa: T201 this is what the command is for
