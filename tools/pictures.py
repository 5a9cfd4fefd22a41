"""Draws the pictures of rooms and robots, and the film of README.md, into docs/pictures: `make pictures`.

Figures of runs, motion and training come from the commands that stand below them in the docs.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import imageio.v3 as iio
from PIL import Image

from robots.spec import load_robot
from sim.tools.look import robot_poses, room_sheet
from sim.tools.video import VideoConfig, film
from sim.world.world import World

FOLDER = Path(__file__).parents[1] / "docs" / "pictures"
#: Two things for two arms: both hands take and put down at once.
TASK, FPS = "benchmark_transport_two_15218", 10


def two_arms(target: Path) -> None:
    """The expert on H1, from the front and through its own eyes, as an animated WebP that repeats."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "film.mp4"
        film(VideoConfig(str(path), "h1", task=TASK, cameras=("front", "head"), size=320, fps=FPS))
        frames = [Image.fromarray(frame) for frame in iio.imread(path)]
    frames[0].save(target, save_all=True, append_images=frames[1:], duration=1000 // FPS, loop=0, quality=55, method=6)


def main() -> int:
    """Writes them all."""
    for robot in ("h1", "x1"):
        iio.imwrite(FOLDER / f"{robot}_poses.png", robot_poses(robot))
    iio.imwrite(FOLDER / "rooms.png", room_sheet(360, 5))
    for room in ("kitchen_1", "living_room_1"):
        cameras = World(load_robot("h1"), room).cameras
        iio.imwrite(FOLDER / f"{room}_above.png", cameras.render("overview", 540, 720, pretty=True).rgb)
        iio.imwrite(FOLDER / f"{room}_head.png", cameras.render("head", 400, 400).rgb)
    two_arms(FOLDER / "two_arms.webp")
    sys.stdout.write(f"{FOLDER}\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
