"""Offscreen pictures of a world: RGB, metric depth and instance segmentation of one camera at one size.

The OpenGL backend is chosen in `sim.gl`: EGL unless MUJOCO_GL says otherwise, OSMesa where EGL is missing.
Planner images have no shadows, reflections or multisampling (measured on two shared CPU cores: 10 x and 3 x). Paper:
first-person and third-person cameras of DualTHOR. Left out: camera noise and lens distortion.

Camera frame: x right, y down, z forward. Shape letters: H rows, W columns.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import mujoco
import numpy as np
from numpy.typing import NDArray

from sim.gl import RenderingError

if TYPE_CHECKING:
    from sim.world import World

__all__ = ["CAMERAS", "Renderer", "RenderingError", "View", "camera_intrinsics", "camera_pose"]

CAMERAS: Final = ("head", "front", "left", "right", "behind", "top", "overview", "plan")
_ROBOT: Final = -2
_NOTHING: Final = -1


@dataclass(frozen=True, slots=True)
class View:
    """One picture with everything that was asked for.

    Attributes:
        rgb: (H, W, 3) uint8.
        depth: (H, W) float32 metres along the optical axis, or None.
        segmentation: (H, W) int32, index into `World.objects` in their order, -1 for walls, floor and sky, -2 for the
            robot; or None.
        intrinsics: (3, 3) K in pixels.
        camera_in_world: (4, 4) pose of the camera (x right, y down, z forward).
    """

    rgb: NDArray[np.uint8]
    depth: NDArray[np.float32] | None
    segmentation: NDArray[np.int32] | None
    intrinsics: NDArray[np.float64]
    camera_in_world: NDArray[np.float64]


def camera_intrinsics(world: World, camera: str, height: int, width: int) -> NDArray[np.float64]:
    """(3, 3) pinhole matrix in pixels; the field of view is vertical, pixels are square."""
    fovy = float(np.radians(world.model.cam_fovy[_camera_id(world, camera)]))
    focal = 0.5 * height / np.tan(fovy / 2.0)
    return np.array([[focal, 0.0, width / 2.0], [0.0, focal, height / 2.0], [0.0, 0.0, 1.0]])


def camera_pose(world: World, camera: str) -> NDArray[np.float64]:
    """(4, 4) pose of a camera in the world, x right, y down, z forward."""
    index, pose = _camera_id(world, camera), np.eye(4)
    pose[:3, :3] = world.data.cam_xmat[index].reshape(3, 3) * np.array([1.0, -1.0, -1.0])
    pose[:3, 3] = world.data.cam_xpos[index]
    return pose


def _camera_id(world: World, camera: str) -> int:
    name = world.robot.head_camera if camera == "head" and world.robot is not None else camera
    index = mujoco.mj_name2id(world.model, int(mujoco.mjtObj.mjOBJ_CAMERA), name)
    if index < 0:
        names = ", ".join(str(world.model.camera(i).name) for i in range(world.model.ncam))
        raise ValueError(f"unknown camera {camera!r}; allowed: {names}")
    return index


class Renderer:
    """Draws a world at one size; keeps its OpenGL context until `close`.

    Args:
        world: what is drawn; it may advance between calls.
        height: rows, at most 1280.
        width: columns, at most 1280.
        pretty: shadows and reflections, for demonstration videos.

    Raises:
        ValueError: on a size outside 1..1280.
        RenderingError: when no OpenGL context can be made.
    """

    def __init__(self, world: World, height: int = 112, width: int = 112, *, pretty: bool = False) -> None:
        if not (1 <= height <= 1280 and 1 <= width <= 1280):
            raise ValueError(f"image size {height} x {width} outside 1..1280")
        self._world, self._height, self._width = world, height, width
        self._renderer = _make_renderer(world.model, height, width)
        self._option = mujoco.MjvOption()
        self._option.geomgroup[:] = 0
        self._option.geomgroup[[0, 1, 2]] = 1
        self._option.sitegroup[:] = 0
        scene: Any = self._renderer.scene
        for flag in ("mjRND_SHADOW", "mjRND_REFLECTION"):
            scene.flags[int(getattr(mujoco.mjtRndFlag, flag))] = int(pretty)
        robot = np.isin(world.model.geom_bodyid, list(world.robot_body_ids))
        self._labels = np.where(robot, _ROBOT, world.object_of_geom).astype(np.int32)

    def view(self, camera: str = "head", *, depth: bool = False, segmentation: bool = False) -> View:
        """Draws one camera as the world is now.

        Raises:
            ValueError: on an unknown camera.
        """
        world, renderer = self._world, self._renderer
        mujoco.mj_camlight(world.model, world.data)
        renderer.update_scene(world.data, camera=_camera_id(world, camera), scene_option=self._option)
        rgb = renderer.render().copy()
        distances = labels = None
        if depth:
            renderer.enable_depth_rendering()
            distances = renderer.render().copy()
            renderer.disable_depth_rendering()
        if segmentation:
            renderer.enable_segmentation_rendering()
            pairs = renderer.render()  # (H, W, 2): object id, object type
            renderer.disable_segmentation_rendering()
            is_geom = pairs[..., 1] == int(mujoco.mjtObj.mjOBJ_GEOM)
            labels = np.where(is_geom, self._labels[np.where(is_geom, pairs[..., 0], 0)], _NOTHING).astype(np.int32)
        return View(
            rgb,
            distances,
            labels,
            camera_intrinsics(world, camera, self._height, self._width),
            camera_pose(world, camera),
        )

    def close(self) -> None:
        """Frees the OpenGL context."""
        self._renderer.close()


def _make_renderer(model: mujoco.MjModel, height: int, width: int) -> mujoco.Renderer:
    try:
        return mujoco.Renderer(model, height, width)
    except (ImportError, RuntimeError, AttributeError, mujoco.FatalError) as error:
        raise RenderingError(
            f"no OpenGL context with MUJOCO_GL={os.environ.get('MUJOCO_GL')}: {error}. Install libegl1 (MUJOCO_GL=egl) or "
            "libosmesa6 (MUJOCO_GL=osmesa), for example: apt-get install libegl1 libgl1-mesa-dri libosmesa6. A program that "
            "imports mujoco before sim must set MUJOCO_GL itself."
        ) from error
