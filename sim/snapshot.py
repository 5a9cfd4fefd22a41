"""Exact copies of a world: restoring one and repeating the same commands gives bit-equal results.

A snapshot holds MuJoCo's integration state (positions, velocities, controls, solver warm start, active constraints), the
parts of the model that the world changes while it runs (grasp constraints, collision bits, colours, masses), every object's
state, the recorder and the random stream. Paper: undo, redo, save and load of DualTHOR, which drop held objects there.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import mujoco
import numpy as np
from numpy.typing import NDArray

__all__ = ["MODEL_FIELDS", "STATE_SIGNATURE", "WorldSnapshot", "read_physics", "write_physics"]

STATE_SIGNATURE: Final = int(mujoco.mjtState.mjSTATE_INTEGRATION)
#: Arrays of the model that a running world writes to.
MODEL_FIELDS: Final = (
    "eq_obj1id",
    "eq_obj2id",
    "eq_data",
    "geom_contype",
    "geom_conaffinity",
    "geom_rgba",
    "mat_emission",
    "body_mass",
    "body_inertia",
    "body_subtreemass",
)


@dataclass(frozen=True, slots=True)
class WorldSnapshot:
    """Everything that the future of a world depends on.

    Attributes:
        scene: name of the scene it was taken in; restoring into another one is refused.
        physics: MuJoCo integration state.
        model: arrays of `MODEL_FIELDS`.
        objects: per object id its state, holders and openness.
        counters: step counters and pending releases.
        history: the recorder's frames.
        rng: state of the random generator.
    """

    scene: str
    physics: NDArray[np.float64]
    model: dict[str, NDArray[Any]]
    objects: dict[str, dict[str, Any]]
    counters: dict[str, Any]
    history: tuple[Any, ...]
    rng: dict[str, Any]


def read_physics(model: mujoco.MjModel, data: mujoco.MjData) -> tuple[NDArray[np.float64], dict[str, NDArray[Any]]]:
    """Copies of the integration state and of the model's changing arrays."""
    state = np.empty(mujoco.mj_stateSize(model, STATE_SIGNATURE))
    mujoco.mj_getState(model, data, state, STATE_SIGNATURE)
    return state, {name: getattr(model, name).copy() for name in MODEL_FIELDS}


def write_physics(
    model: mujoco.MjModel, data: mujoco.MjData, physics: NDArray[np.float64], arrays: dict[str, NDArray[Any]]
) -> None:
    """Writes them back and recomputes positions, leaving the solver's warm start untouched."""
    for name, values in arrays.items():
        getattr(model, name)[...] = values
    mujoco.mj_setState(model, data, physics, STATE_SIGNATURE)
    mujoco.mj_forward(model, data)
    mujoco.mj_setState(model, data, physics, STATE_SIGNATURE)
