"""One OpenGL context with MuJoCo's meshes in it, shared by all worlds of a thread with the same robot, room and image size.

Making a context costs 0.2 s, drawing 8 ms, so contexts live as long as the process and are handed from world to world. Two
passes give everything: colours from one, segment numbers and depth together from the other.
"""

from __future__ import annotations

import contextlib
import functools
import os
import threading

import mujoco
import numpy as np
from numpy.typing import NDArray

from robots.gl import RenderingError


class Canvas:
    """An offscreen buffer of one size.

    Args:
        model: any model of the robot and room; its meshes and textures are uploaded.
        height: rows.
        width: columns.
        samples: of each pixel; 0 and 1 draw hard edges.

    Raises:
        RenderingError: when no OpenGL context can be made.
    """

    def __init__(self, model: mujoco.MjModel, height: int, width: int, samples: int = 0) -> None:
        self._rect = mujoco.MjrRect(0, 0, width, height)
        self._shape = (height, width)
        quality, before = model.vis.quality, model.vis.quality.offsamples
        quality.offsamples = samples
        try:
            self._gl = mujoco.GLContext(width, height)
            self._gl.make_current()
            self._context = mujoco.MjrContext(model, int(mujoco.mjtFontScale.mjFONTSCALE_50))
        except (ImportError, RuntimeError, AttributeError, TypeError, mujoco.FatalError) as error:
            raise RenderingError(
                f"no OpenGL context with MUJOCO_GL={os.environ.get('MUJOCO_GL')}: {error}. "
                "Install libegl1 (MUJOCO_GL=egl) "
                "or libosmesa6 (MUJOCO_GL=osmesa): apt-get install libegl1 libgl1-mesa-dri libosmesa6. A program that "
                "imports mujoco before sim must set MUJOCO_GL itself."
            ) from error
        finally:
            quality.offsamples = before
        mujoco.mjr_setBuffer(int(mujoco.mjtFramebuffer.mjFB_OFFSCREEN), self._context)
        # zero far gives float depth buffers their precision at a distance
        self._context.readDepthMap = int(mujoco.mjtDepthMap.mjDEPTH_ZEROFAR)  # type: ignore[assignment]

    def __del__(self) -> None:
        """Frees the drawing context in its own OpenGL context: in another one that would delete the other one's objects."""
        with contextlib.suppress(Exception):  # a context that was never made, or an interpreter that is ending
            self._gl.make_current()
            self._context.free()
            self._gl.free()

    def colors(self, scene: mujoco.MjvScene) -> NDArray[np.uint8]:
        """(H, W, 3) uint8 picture of a scene."""
        self._gl.make_current()
        pixels = np.empty((*self._shape, 3), dtype=np.uint8)
        mujoco.mjr_render(self._rect, scene, self._context)
        mujoco.mjr_readPixels(pixels, None, self._rect, self._context)
        return np.flipud(pixels).copy()

    def depth_and_geoms(self, model: mujoco.MjModel, scene: mujoco.MjvScene) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
        """(H, W) metres along the optical axis, and (H, W) geom ids, -1 for the sky."""
        self._gl.make_current()
        flags = scene.flags.copy()
        scene.flags[int(mujoco.mjtRndFlag.mjRND_SEGMENT)] = 1
        scene.flags[int(mujoco.mjtRndFlag.mjRND_IDCOLOR)] = 1
        pixels, buffer = np.empty((*self._shape, 3), dtype=np.uint8), np.empty(self._shape, dtype=np.float32)
        mujoco.mjr_render(self._rect, scene, self._context)
        mujoco.mjr_readPixels(pixels, buffer, self._rect, self._context)
        scene.flags[:] = flags
        near, far = model.vis.map.znear * model.stat.extent, model.vis.map.zfar * model.stat.extent
        # The buffer is near (far - z) / (z (far - near)): 1 at the near plane, 0 at the far plane.
        metres = near * far / (near + buffer.astype(np.float64) * (far - near))
        segments = pixels.astype(np.int64) @ np.array([1, 256, 65536])
        geom_of_segment = np.full(scene.ngeom + 1, -1, dtype=np.int64)
        for geom in scene.geoms[: scene.ngeom]:
            if geom.segid >= 0 and geom.objtype == int(mujoco.mjtObj.mjOBJ_GEOM):
                geom_of_segment[geom.segid + 1] = geom.objid
        return np.flipud(metres).astype(np.float32), np.flipud(geom_of_segment[segments]).copy()


class _Key:
    """A model that compares equal to all models with the same name, so that they share a canvas."""

    def __init__(self, model: mujoco.MjModel, name: str) -> None:
        self.model, self.name = model, name

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Key) and other.name == self.name

    def __hash__(self) -> int:
        return hash(self.name)


class _Canvases(threading.local):
    """A thread's canvases: a context is current in one thread, and has to be given up there."""

    def __init__(self) -> None:
        self.of = functools.lru_cache(maxsize=24)(lambda key, *shape: Canvas(key.model, *shape))


_canvases = _Canvases()


def shared_canvas(model: mujoco.MjModel, name: str, height: int, width: int, samples: int = 0) -> Canvas:
    """The thread's canvas for a robot and room (`name` stands for their meshes and textures) at a size."""
    return _canvases.of(_Key(model, name), height, width, samples)
