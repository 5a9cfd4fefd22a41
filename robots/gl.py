"""Chooses the OpenGL backend before MuJoCo is first imported: EGL where its library exists, else OSMesa.

MuJoCo reads MUJOCO_GL once, at import, so the package `robots`, below simulator and data, calls `select_backend` before
anything else.
"""

from __future__ import annotations

import ctypes.util
import os
from typing import Final

BACKENDS: Final = ("egl", "osmesa", "glfw")


class RenderingError(RuntimeError):
    """No OpenGL context can be made; the message names the system packages that are missing."""


def select_backend() -> str:
    """Sets MUJOCO_GL when it is unset, and returns it.

    Raises:
        RenderingError: on a value outside egl, osmesa, glfw.
    """
    default = "egl" if ctypes.util.find_library("EGL") or not ctypes.util.find_library("OSMesa") else "osmesa"
    backend = os.environ.setdefault("MUJOCO_GL", default).lower()
    if backend not in BACKENDS:
        raise RenderingError(f"MUJOCO_GL={backend!r} is not supported; allowed: {', '.join(BACKENDS)}")
    return backend
