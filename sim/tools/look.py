"""Pictures of rooms, object types and robots, for the eye: `python -m sim look [out=outputs/look]`.

Writes each room from above and through the robot's head camera, a contact sheet of the types, their lids, and each robot
standing, crouching and holding a box with both hands. Not part of any experiment.
"""

from __future__ import annotations

import functools
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import imageio.v3 as iio
import mujoco
import numpy as np
from numpy.typing import NDArray

from configs.arguments import command, read_arguments
from interface.bodies import DEFAULT_ROBOT
from interface.steps import Action, PlanStep
from robots.spec import available_robots, load_robot
from sim.expert.expert import Expert
from sim.scene.catalogue import load_catalogue
from sim.scene.compiler import build_type_spec
from sim.scene.rooms import room_names
from sim.session.session import Session
from sim.tasks.task import load_benchmark
from sim.world.world import World


def room_pictures(folder: Path, robot: str = DEFAULT_ROBOT) -> Iterator[Path]:
    """Overview, plan, head view at 500 and 112 pixels and side view of every room with its default objects."""
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
            iio.imwrite(path, world.cameras.render(camera, height, width, pretty=camera != "head").rgb)
            yield path


def room_sheet(width: int = 400, columns: int = 4) -> NDArray[np.uint8]:
    """(rows * 0.75 * width, columns * width, 3) every room from above, with its objects, in the order of their names."""
    tiles = [World(None, room).cameras.render("overview", width * 3 // 4, width, pretty=True).rgb for room in room_names()]
    rows = -(-len(tiles) // columns)
    tiles += [np.full_like(tiles[0], 255)] * (rows * columns - len(tiles))
    return np.concatenate([np.concatenate(tiles[r * columns : (r + 1) * columns], axis=1) for r in range(rows)], axis=0)


def contact_sheet(size: int = 112, columns: int = 12) -> NDArray[np.uint8]:
    """(rows * size, columns * size, 3) every type of the catalogue alone, in the catalogue's order."""
    tiles = [_tile(name, size) for name in load_catalogue().types]
    blank = np.full_like(tiles[0], 255)
    rows = -(-len(tiles) // columns)
    tiles += [blank] * (rows * columns - len(tiles))
    return np.concatenate([np.concatenate(tiles[r * columns : (r + 1) * columns], axis=1) for r in range(rows)], axis=0)


def robot_poses(robot: str, size: int = 420) -> NDArray[np.uint8]:
    """(size, 3 * size, 3) the robot standing, crouching as low as it can, and holding a box with both hands."""
    session = Session(robot)
    task = next(task for task in load_benchmark() if task.family == "lift" and task.room == "living_room_1")
    session.reset(task, seed=0)
    low, high = session.body.spec.pelvis_height_range_m
    pictures = []
    for height in (high, low):
        change = height - session.body.posture.pelvis_height_m
        if abs(change) > 0.005:
            session.act(PlanStep((Action("MoveUp" if change > 0 else "MoveDown", amount=round(abs(change), 2)),)))
        pictures.append(_portrait(session, size))
    session.reset(task, seed=0)
    expert = Expert(session)
    expert.reset()
    while session.body.hands.lifted is None and not session.finished:
        session.step(expert.next_step())
    return np.concatenate([*pictures, _portrait(session, size)], axis=1)


def _portrait(session: Session, size: int) -> NDArray[np.uint8]:
    """The robot from its front left, without the walls between."""
    base, tall_m = session.body.base.measured(), session.body.spec.standing_pelvis_height_m
    yaw, down, away_m = base.yaw_rad + np.deg2rad(35.0), np.deg2rad(12.0), 1.0 + 2.1 * tall_m
    ahead = -np.array([np.cos(yaw) * np.cos(down), np.sin(yaw) * np.cos(down), np.sin(down)])
    right = np.array([ahead[1], -ahead[0], 0.0]) / np.hypot(ahead[0], ahead[1])
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(ahead, right), ahead], axis=1)
    pose[:3, 3] = np.array([base.x, base.y, 0.9 * tall_m]) - away_m * ahead
    return session.world.cameras.render_from(pose, 45.0, size, size, pretty=True)


def lid_sheet(size: int = 224) -> NDArray[np.uint8]:
    """(rows * size, 3 * size, 3) every type with a lid: closed, half open and open."""
    names = [name for name, kind in load_catalogue().types.items() if kind.lidded]
    return np.concatenate([np.concatenate([_tile(name, size, share) for share in (0.0, 0.5, 1.0)], axis=1) for name in names])


def _tile(type_name: str, size: int, openness: float | None = None) -> NDArray[np.uint8]:
    """A type alone, its doors and lids as at the start or open by that share."""
    model = build_type_spec(type_name).compile()
    data = mujoco.MjData(model)
    for moving in load_catalogue().get(type_name).moving:
        share = moving.start if openness is None else openness
        joint = model.joint(f"{type_name}_1/{moving.name}")
        data.qpos[joint.qposadr[0]] = moving.range[0] + share * (moving.range[1] - moving.range[0])
    mujoco.mj_forward(model, data)
    with mujoco.Renderer(model, size, size) as renderer:
        renderer.update_scene(data, camera="view")
        return renderer.render().copy()


def draw_all(folder: Path) -> Iterator[Path]:
    """Writes all pictures; gives each path as soon as it is there."""
    folder.mkdir(parents=True, exist_ok=True)
    poses = {f"{robot}_poses": functools.partial(robot_poses, robot) for robot in available_robots()}
    sheets: dict[str, Callable[[], NDArray[np.uint8]]] = {
        "rooms": room_sheet,
        **poses,
        "types": contact_sheet,
        "lids": lid_sheet,
    }
    for name, draw in sheets.items():
        iio.imwrite(folder / f"{name}.png", draw())
        yield folder / f"{name}.png"
    yield from room_pictures(folder)


@dataclass(frozen=True)
class LookConfig:
    """Where the pictures go.

    Attributes:
        out: folder.
    """

    out: str = "outputs/look"


@command()
def main(arguments: Sequence[str]) -> int:
    """Command line; 0 on success, 2 on wrong arguments."""
    config = read_arguments(LookConfig, arguments)
    for written in draw_all(Path(config.out)):
        sys.stdout.write(f"{written}\n")
    return 0
