"""Exact copies of a world: restoring one and repeating the same commands gives bit-equal results.

A snapshot holds a copy of MuJoCo's data (state, solver warm start, active constraints, contacts, and which objects sleep:
MuJoCo's state vector alone would wake them), the parts of the model that the world changes while it runs (grasp constraints,
collision bits, colours, masses), every object's state, the recorder and the random stream. Paper: undo, redo, save and load of
DualTHOR, which drop held objects there.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass
from typing import Any, Final

import mujoco
from numpy.typing import NDArray

#: Arrays of the model that a running world writes to.
MODEL_FIELDS: Final = (
    "eq_obj1id",
    "eq_obj2id",
    "eq_data",
    "eq_solref",
    "eq_solimp",
    "geom_contype",
    "geom_conaffinity",
    "geom_pos",
    "geom_size",
    "geom_rbound",
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
        physics: copy of MuJoCo's data, about a megabyte.
        model: arrays of `MODEL_FIELDS`.
        objects: per object id its state, holders and openness.
        counters: step counters and pending releases.
        history: the recorder's frames.
        rng: state of the random generator.
    """

    scene: str
    physics: mujoco.MjData
    model: dict[str, NDArray[Any]]
    objects: dict[str, dict[str, Any]]
    counters: dict[str, Any]
    history: tuple[Any, ...]
    rng: dict[str, Any]


def read_physics(model: mujoco.MjModel, data: mujoco.MjData) -> tuple[mujoco.MjData, dict[str, NDArray[Any]]]:
    """Copies of the data and of the model's changing arrays."""
    return copy.copy(data), {name: getattr(model, name).copy() for name in MODEL_FIELDS}


def write_physics(model: mujoco.MjModel, data: mujoco.MjData, physics: mujoco.MjData, arrays: dict[str, NDArray[Any]]) -> None:
    """Writes them back, everything derived included."""
    for name, values in arrays.items():
        getattr(model, name)[...] = values
    mujoco.mj_copyData(data, model, physics)
