"""What a planner gets to see: the head camera's picture, the robot's own state, names of what is in view, and the past.

Nothing here tells positions or states of objects. Paper: egocentric observation and proprioception.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from data.motion import encode_frames, world_to_heading
from interface.observation import Camera, HistoryItem, Observation, Proprioception
from sim.world.recorder import FRAME_DT_S
from sim.world.rendering import VISIBILITY_SIZE, camera_intrinsics, camera_pose
from sim.world.world import World


def visible_ids(visible: Iterable[str], names: Iterable[str]) -> tuple[str, ...]:
    """Ids in the order of the scene."""
    seen = set(visible)
    return tuple(name for name in names if name in seen)


def proprioception(world: World) -> Proprioception:
    """The robot's motion over the last 3.2 s and its present joints, from its own recorder."""
    window = world.motion()
    motion = encode_frames(window.root_pose, window.key_bodies, window.hands)
    return Proprioception(
        motion=motion,
        fps=1.0 / FRAME_DT_S,
        joint_positions=window.joints[-1].copy(),
        key_bodies_in_pelvis=world_to_heading(window.key_bodies[-1], window.root_pose[-1]),
    )


def head_camera(world: World, size: int) -> Camera:
    """The head camera with its pose in the pelvis heading frame, which follows from the robot's own joints."""
    in_world = camera_pose(world.scene, "head")
    root = world.motion(1).root_pose[-1]
    position = world_to_heading(in_world[None, :3, 3], root)[0]
    axes = world_to_heading(in_world[:3, :3].T + root[:3], root).T
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = axes, position
    return Camera(camera_intrinsics(world.scene, "head", size, size), pose, size, size)


def observe(
    world: World,
    instruction: str,
    image_size: int,
    known: Sequence[str],
    history: Sequence[HistoryItem],
    step: int,
    time_limit: int,
    step_limit: int,
) -> Observation:
    """Builds an observation.

    Args:
        world: the running scene.
        instruction: the task in words.
        image_size: side of the picture, pixels; 0 gives a picture without pixels. What is visible does not depend on it.
        known: ids known before this look; what is visible now is added.
        history: earlier steps.
        step: index of the coming step.
        time_limit: steps within which the task is done in time.
        step_limit: steps after which the episode ends.
    """
    image: NDArray[np.uint8] = np.zeros((0, 0, 3), dtype=np.uint8)
    if image_size:
        image = world.cameras.render("head", image_size, image_size).rgb
    visible = visible_ids(world.cameras.visible_objects(), world.objects)
    assert world.robot is not None
    return Observation(
        instruction=instruction,
        robot=world.robot.name,
        image=image,
        camera=head_camera(world, image_size or VISIBILITY_SIZE),
        visible_objects=visible,
        known_objects=visible_ids((*known, *visible), world.objects),
        proprioception=proprioception(world),
        history=tuple(history),
        step=step,
        time_limit=time_limit,
        step_limit=step_limit,
    )
