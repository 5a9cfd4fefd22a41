"""Objects of a scene: what belongs to one id in the MuJoCo model, and its state under AI2-THOR's names.

Paper: object states of DualTHOR. Positions, openness and containment are read from physics; what physics does not know
(toggled, filled, dirty, cooked, broken, temperature) is kept here and shown by colours.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any, Final, Protocol

import mujoco
import numpy as np
from numpy.typing import NDArray

from interface.facts import OPEN_SHARE, Affordances
from sim.scene.catalogue import Catalogue, MovingSpec, ObjectType, SurfaceSpec

ROOM_TEMPERATURE_C: Final = 20.0


class Placement(Protocol):
    """One movable object to put into a room; `sim.tasks.task.Placement` has this shape."""

    @property
    def object_id(self) -> str: ...
    @property
    def receptacle(self) -> str: ...
    @property
    def xy(self) -> tuple[float, float] | None: ...
    @property
    def yaw_deg(self) -> float: ...
    @property
    def state(self) -> Mapping[str, bool | float | str]: ...


@dataclass(frozen=True, slots=True)
class ObjectPlacement:
    """A plain `Placement`.

    Attributes:
        object_id: `Type_n`.
        receptacle: id of what carries it; placed before it.
        xy: world position (m), None for a free spot drawn from the world's seed.
        yaw_deg: orientation about z.
        state: start state under AI2-THOR names, see `STATE_NAMES`; `mass` in kilograms and `selfClosing` are allowed too.
    """

    object_id: str
    receptacle: str
    xy: tuple[float, float] | None = None
    yaw_deg: float = 0.0
    state: Mapping[str, bool | float | str] = field(default_factory=dict)


@dataclass(slots=True)
class ObjectState:
    """What an object carries beyond physics, under AI2-THOR's names.

    Attributes:
        isToggled, isBroken, isFilledWithLiquid, isDirty, isCooked, isSliced, isUsedUp: as in AI2-THOR.
        fillLiquid: water, coffee or wine, `""` when empty.
        fillLitres: how much of it.
        temperature: degrees Celsius.
    """

    isToggled: bool = False  # noqa: N815
    isBroken: bool = False  # noqa: N815
    isFilledWithLiquid: bool = False  # noqa: N815
    fillLiquid: str = ""  # noqa: N815
    fillLitres: float = 0.0  # noqa: N815
    isDirty: bool = False  # noqa: N815
    isCooked: bool = False  # noqa: N815
    isSliced: bool = False  # noqa: N815
    isUsedUp: bool = False  # noqa: N815
    temperature: float = ROOM_TEMPERATURE_C


#: State names that `World.set_state` accepts; `isOpen` and `openness` follow the joints and are start values only.
STATE_NAMES: Final = tuple(f.name for f in fields(ObjectState))


@dataclass(frozen=True, slots=True)
class MovingPart:
    """A door, drawer or lid in the model.

    Attributes:
        name: name in the catalogue.
        body_id, joint_id, qpos_adr, dof_adr: MuJoCo indices.
        range: closed and open joint position.
        handle_site: MuJoCo site id of the handle, -1 without one.
        spec: its entry of the catalogue.
    """

    name: str
    body_id: int
    joint_id: int
    qpos_adr: int
    dof_adr: int
    range: tuple[float, float]
    handle_site: int
    spec: MovingSpec

    def travel_m(self, change: float) -> float:
        """About how far the handle moves while the joint does by `change`: a door's is half a metre from its hinge."""
        return abs(change) * (0.5 if self.spec.joint == "hinge" else 1.0)


@dataclass(frozen=True, slots=True)
class Surface:
    """A supporting surface and its body; `spec` is given in the type's frame, `origin` is the body's origin there."""

    spec: SurfaceSpec
    body_id: int
    origin: NDArray[np.float64]


@dataclass(slots=True)
class ObjectInstance:
    """One object of the scene.

    Attributes:
        object_id: `Type_n`.
        type: its catalogue type.
        movable: whether it has a free joint in this scene.
        can: what can be done with it.
        body_id: MuJoCo body.
        body_ids: the body and its doors, drawers and lids.
        geom_ids: all geoms.
        qpos_adr, dof_adr: of the free joint, -1 for furniture.
        moving: doors, drawers and lids.
        surfaces: where things can rest.
        toggle_site: MuJoCo site a finger touches to switch it, -1 without one.
        local_min, local_max: bounding box of the resting shape in the body frame, metres.
        state: current state.
        held_by: arms that hold it, in the order of grasping.
        openness: how far its door, drawer or lid is open, 0 to 1.
        self_closing: whether a spring shuts its door or drawer as soon as nothing holds it open.
        mass_kg: mass without contents.
    """

    object_id: str
    type: ObjectType
    movable: bool
    can: Affordances
    body_id: int
    body_ids: tuple[int, ...]
    geom_ids: NDArray[np.int64]
    qpos_adr: int
    dof_adr: int
    moving: tuple[MovingPart, ...]
    surfaces: tuple[Surface, ...]
    toggle_site: int
    local_min: NDArray[np.float64]
    local_max: NDArray[np.float64]
    mass_kg: float
    state: ObjectState = field(default_factory=ObjectState)
    held_by: list[str] = field(default_factory=list)
    openness: float = 0.0
    self_closing: bool = False

    @property
    def is_open(self) -> bool:
        """Whether its door, drawer or lid is more than a third open; True for what cannot be closed."""
        return self.openness > OPEN_SHARE if self.moving else True

    @property
    def is_shut(self) -> bool:
        """Whether what it carries is out of reach, because it is closed."""
        return self.type.encloses and not self.is_open

    @property
    def walled(self) -> bool:
        """Whether what is in it may lean on its walls: what has an inside, or is a tray or a vessel."""
        return self.type.encloses or any(part.shape in ("tray", "cup") for part in self.type.parts)

    @property
    def laden_mass_kg(self) -> float:
        """Mass with the liquid that it holds; the liquid of furniture does not weigh."""
        return self.mass_kg + (self.state.fillLitres if self.movable else 0.0)

    @property
    def footprint_radius_m(self) -> float:
        """Radius of the circle around its footprint, metres."""
        return float(np.hypot(*np.maximum(np.abs(self.local_min[:2]), np.abs(self.local_max[:2]))))

    @property
    def height_m(self) -> float:
        """Height of its resting shape, metres."""
        return float(self.local_max[2] - self.local_min[2])


def index_object(model: mujoco.MjModel, object_id: str, catalogue: Catalogue) -> ObjectInstance:
    """Finds everything that belongs to an object in a compiled scene."""
    kind = catalogue.get(object_id.rsplit("_", 1)[0])
    body = int(model.body(object_id).id)
    movable = int(model.body_jntnum[body]) == 1
    joint = int(model.body_jntadr[body])
    parts: list[MovingPart] = []
    surfaces = [Surface(spec, body, np.zeros(3)) for spec in kind.surfaces]
    for moving in kind.moving:
        name = f"{object_id}/{moving.name}"
        j = model.joint(name)
        door = int(model.body(name).id)
        site = mujoco.mj_name2id(model, int(mujoco.mjtObj.mjOBJ_SITE), f"{name}/handle")
        address, dof = int(j.qposadr[0]), int(j.dofadr[0])
        parts.append(MovingPart(moving.name, door, int(j.id), address, dof, moving.range, site, moving))
        surfaces += [Surface(spec, door, np.asarray(moving.at, dtype=float)) for spec in moving.surfaces]
    bodies = (body, *(part.body_id for part in parts))
    geoms = np.flatnonzero(np.isin(model.geom_bodyid, bodies))
    slices = {f"{object_id}/{index}" for index, part in enumerate(kind.parts) if "slice" in part.options}
    # what appears when it is sliced lies within or beside the whole, whose box counts
    whole = geoms if not slices else np.array([geom for geom in geoms if str(model.geom(int(geom)).name) not in slices])
    low, high = _local_box(model, body, whole)
    toggle = mujoco.mj_name2id(model, int(mujoco.mjtObj.mjOBJ_SITE), f"{object_id}/toggle")
    return ObjectInstance(
        object_id=object_id,
        type=kind,
        movable=movable,
        can=kind.affordances(movable),
        body_id=body,
        body_ids=bodies,
        geom_ids=geoms,
        qpos_adr=int(model.jnt_qposadr[joint]) if movable else -1,
        dof_adr=int(model.jnt_dofadr[joint]) if movable else -1,
        moving=tuple(parts),
        surfaces=tuple(surfaces),
        toggle_site=toggle,
        local_min=low,
        local_max=high,
        mass_kg=float(model.body_subtreemass[body]),
    )


def _local_box(model: mujoco.MjModel, body: int, geoms: NDArray[np.int64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Bounding box in the body's frame with doors closed, from the boxes of its geoms."""
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    rotation = np.zeros(9)
    for geom in geoms:
        mujoco.mju_quat2Mat(rotation, model.geom_quat[geom])
        center = model.geom_pos[geom] + rotation.reshape(3, 3) @ model.geom_aabb[geom, :3]
        half = np.abs(rotation.reshape(3, 3)) @ model.geom_aabb[geom, 3:]
        if model.geom_bodyid[geom] != body:
            center = center + model.body_pos[model.geom_bodyid[geom]]
        low, high = np.minimum(low, center - half), np.maximum(high, center + half)
    return low, high


def copy_state(state: ObjectState) -> dict[str, Any]:
    """Plain values of a state."""
    return {name: getattr(state, name) for name in STATE_NAMES}
