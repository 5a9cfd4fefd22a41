"""Replays retargeted clips in furnished rooms and takes the head camera's pictures.

The clip is placed where the whole path of the base is free; then every pictured frame sets the robot's joints (kinematics, no
physics) and renders. The scene's base has no roll joint, so that a sideways lean of the trunk is not shown; the camera poses
that are stored are the rendered ones.

Paper: alignment data, "replayed in the simulator". Left out: contact with objects.
"""

from __future__ import annotations

from functools import lru_cache

import mujoco
import numpy as np
from numpy.typing import NDArray

from configs.schema.data import ReplayConfig
from data.motion import yaw_from_quaternion
from data.pipeline import Pictures
from data.shards import encode_png
from interface.motion import Motion
from robots.spec import load_robot
from sim.collection.view_sampling import camera_in_pelvis
from sim.scene.compiler import BASE_JOINTS
from sim.scene.rooms import load_room
from sim.skills.obstacles import navigation_map
from sim.tasks.sample import UNSEEN_TYPES
from sim.world.world import World, own_placements

Array = NDArray[np.float64]
_PATH_STRIDE = 4


@lru_cache(maxsize=6)
def _world(robot: str, room: str) -> World:
    """A room with its own things, but none of a type that training does not show."""
    seen = [one for one in own_placements(load_room(room)) if one.object_id.rsplit("_", 1)[0] not in UNSEEN_TYPES]
    return World(load_robot(robot), room, seen)


def picture_frames(frames: int, fps: float, pictures_per_s: float) -> NDArray[np.int64]:
    """Frames that are pictured: the middle of each interval of 1 / `pictures_per_s`, at least one."""
    count = max(1, int(frames / fps * pictures_per_s))
    return np.minimum(((np.arange(count) + 0.5) * frames / count).astype(np.int64), frames - 1)


def place_path(path_xy: Array, world: World, rng: np.random.Generator, attempts: int) -> tuple[Array, float] | None:
    """Where a path can be laid without touching anything.

    Args:
        path_xy: (T, 2) metres.
        world: room with a robot.
        rng: draws.
        attempts: tries.

    Returns:
        Offset (2,) in metres and turn in rad to apply to the path about its first point, or None.
    """
    assert world.robot is not None
    nav = navigation_map(world, world.robot.footprint_radius_m)
    free = nav.free_positions()
    if len(free) == 0:
        return None
    relative = path_xy[::_PATH_STRIDE] - path_xy[0]
    for _ in range(attempts):
        start, turn = free[int(rng.integers(len(free)))], float(rng.uniform(-np.pi, np.pi))
        points = start + relative @ _turn(turn).T
        if all(nav.is_free(point) for point in points):
            return start, turn
    return None


def set_frame(world: World, motion: Motion, frame: int, start_xy: Array, turn_rad: float) -> None:
    """Puts the robot into one frame of a clip, moved so that the clip begins at `start_xy` and is turned by `turn_rad`.

    Raises:
        ValueError: when the motion has no joint positions or is of another robot.
    """
    if motion.root_pose is None or motion.joint_positions is None:
        raise ValueError(f"{motion.name}: a motion without joint positions cannot be replayed")
    if world.robot is None or world.robot.name != motion.robot:
        raise ValueError(f"{motion.name} is of robot {motion.robot!r}, the world has {world.robot and world.robot.name!r}")
    pose = motion.root_pose[frame]
    xy = start_xy + _turn(turn_rad) @ (pose[:2] - motion.root_pose[0, :2])
    w, x, y, z = pose[3:7]
    pitch = float(np.arcsin(np.clip(2.0 * (w * y - z * x), -1.0, 1.0)))
    yaw = float(yaw_from_quaternion(pose[3:7])) + turn_rad
    values = dict(zip(BASE_JOINTS, (xy[0], xy[1], pose[2], yaw, pitch), strict=True))
    values |= dict(zip(world.robot.joints, motion.joint_positions[frame], strict=True))
    for name, value in values.items():
        world.data.qpos[world.model.joint(name).qposadr[0]] = value
    mujoco.mj_kinematics(world.model, world.data)


def replay_clip(motion: Motion, cfg: ReplayConfig, seed: int) -> Pictures | None:
    """Replays a clip in the first room, beginning with a drawn one, that has a free path.

    Args:
        motion: retargeted clip.
        cfg: configuration.
        seed: of room and placement.

    Returns:
        The pictures, or None when no room has a free path.
    """
    assert motion.root_pose is not None
    rng = np.random.default_rng(seed)
    first = int(rng.integers(len(cfg.rooms)))
    for shift in range(len(cfg.rooms)):
        room = cfg.rooms[(first + shift) % len(cfg.rooms)]
        world = _world(motion.robot, room)
        before = world.data.qpos.copy()
        placed = place_path(motion.root_pose[:, :2], world, rng, cfg.attempts)
        if placed is None:
            continue
        frames = picture_frames(len(motion.root_pose), motion.fps, cfg.pictures_per_s)
        views, cameras = [], []
        for frame in frames:
            set_frame(world, motion, int(frame), *placed)
            views.append(world.cameras.render("head", cfg.image_size, cfg.image_size, depth=True))
            cameras.append(camera_in_pelvis(world, views[-1]))
        world.data.qpos[:] = before
        mujoco.mj_kinematics(world.model, world.data)
        depths = tuple(np.clip(v.depth, 0.0, 60000.0).astype("<f2").tobytes() for v in views if v.depth is not None)
        return Pictures(
            images=tuple(encode_png(v.rgb) for v in views),
            depths=depths,
            frames=tuple(int(f) for f in frames),
            cameras_in_pelvis=tuple(cameras),
            intrinsics=views[0].intrinsics,
            height=cfg.image_size,
            width=cfg.image_size,
            room=room,
            seed=seed,
        )
    return None


def _turn(angle_rad: float) -> Array:
    cos, sin = np.cos(angle_rad), np.sin(angle_rad)
    return np.array([[cos, -sin], [sin, cos]])
