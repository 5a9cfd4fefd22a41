"""The running scene that the owners in `sim.world` share: MuJoCo's model and data, and the objects in them.

The record itself decides nothing. Each owner (`containment`, `liquids`, `states` …) reads it and writes the part that it owns.
Frames: world, z up, metres, radians.
"""

from __future__ import annotations

import copy
import dataclasses
import functools
from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from interface.bodies import SIDES
from robots.spec import RobotSpec
from sim.scene.catalogue import Catalogue, Part
from sim.scene.compiler import SceneKey, compile_scene
from sim.scene.objects import ObjectInstance, ObjectState, index_object
from sim.scene.rooms import Room


class WorldError(ValueError):
    """A world that cannot be built or asked as requested; the message names the value and what is allowed."""


@dataclass(frozen=True, slots=True)
class SceneState:
    """One compiled scene while it runs.

    Attributes:
        key: everything that the compiled scene depends on, as text.
        name: of the robot's file and the room: scenes of equal name have equal meshes and textures.
        robot: the robot's description, None for a room alone.
        room, catalogue: what the scene was built from.
        model, data: MuJoCo's; the model is this world's own copy.
        objects: every object by id, furniture first.
        part_of_geom: visible geoms of each object with the catalogue part each was built from.
        object_of_geom: (ngeom,) index of the object that a geom belongs to, in the order of `objects`; -1 for none.
        robot_bodies: MuJoCo bodies of the robot.
    """

    key: str
    name: str
    robot: RobotSpec | None
    room: Room
    catalogue: Catalogue
    model: mujoco.MjModel
    data: mujoco.MjData
    objects: dict[str, ObjectInstance]
    part_of_geom: dict[str, list[tuple[int, Part]]]
    object_of_geom: NDArray[np.int64]
    robot_bodies: frozenset[int]

    def object(self, object_id: str) -> ObjectInstance:
        """The object of that id.

        Raises:
            WorldError: on an unknown id; the message lists the known ones.
        """
        found = self.objects.get(object_id)
        if found is None:
            raise WorldError(f"unknown object {object_id!r} in {self.room.name}; allowed: {', '.join(self.objects)}")
        return found

    def the_robot(self) -> RobotSpec:
        """The robot's description.

        Raises:
            WorldError: when the room is without a robot.
        """
        if self.robot is None:
            raise WorldError("this world has no robot")
        return self.robot


def build_scene(
    robot: RobotSpec | None, room: Room, catalogue: Catalogue, furniture: Sequence[str], movable: Sequence[str]
) -> SceneState:
    """A fresh scene in its initial state; what is compiled is shared between equal scenes.

    Args:
        robot: the robot's description, None for a room alone.
        room: the room.
        catalogue: types of the objects.
        furniture: ids of the room's furniture.
        movable: ids of all other objects, in the order in which they will be placed.
    """
    key = scene_key(robot, room, movable)
    model = copy.copy(compile_scene(key))
    templates, parts, owners = _indexed(key, (*furniture, *movable), catalogue)
    objects = {name: dataclasses.replace(item, state=ObjectState(), held_by=[]) for name, item in templates.items()}
    roots = [] if robot is None else [int(model.body(robot.root_body).id)]
    bodies = frozenset(body for body in range(1, model.nbody) if int(model.body_rootid[body]) in roots)
    name = f"{key.mjcf_path}|{room.name}"
    return SceneState(repr(key), name, robot, room, catalogue, model, mujoco.MjData(model), objects, parts, owners, bodies)


def scene_key(robot: RobotSpec | None, room: Room, movable: Sequence[str]) -> SceneKey:
    """What decides a compiled scene."""
    ids = tuple(sorted(movable))
    if robot is None:
        return SceneKey("", "", "", (), room.name, ids)
    path = str(robot.mjcf_path)
    hands = _hand_bodies(path, tuple(robot.arms[side].grasp_site for side in SIDES))
    return SceneKey(robot.name, path, robot.root_body, hands, room.name, ids)


@functools.cache
def _hand_bodies(mjcf_path: str, grasp_sites: tuple[str, ...]) -> tuple[str, ...]:
    """Names of the bodies that carry the grasp sites of a robot's file."""
    spec = mujoco.MjSpec.from_file(mjcf_path)
    return tuple(spec.site(site).parent.name for site in grasp_sites)


@functools.lru_cache(maxsize=24)
def _indexed(
    key: SceneKey, names: tuple[str, ...], catalogue: Catalogue
) -> tuple[dict[str, ObjectInstance], dict[str, list[tuple[int, Part]]], NDArray[np.int64]]:
    """What belongs to which object of a compiled scene: objects to be copied, parts by geom, and the object of each geom."""
    model = compile_scene(key)
    objects = {name: index_object(model, name, catalogue) for name in names}
    owners = np.full(model.ngeom, -1, dtype=np.int64)
    for index, item in enumerate(objects.values()):
        owners[item.geom_ids] = index
    return objects, {name: _parts(model, item) for name, item in objects.items()}, owners


def _parts(model: mujoco.MjModel, item: ObjectInstance) -> list[tuple[int, Part]]:
    """Visible geoms of an object with the catalogue part each was built from."""
    sources = {f"{item.object_id}/{i}": part for i, part in enumerate(item.type.parts)}
    for moving in item.type.moving:
        sources |= {f"{item.object_id}/{moving.name}/{i}": part for i, part in enumerate(moving.parts)}
    found: list[tuple[int, Part]] = []
    for geom in item.geom_ids:
        name = str(model.geom(int(geom)).name)
        if name.endswith("/foot"):
            continue
        part = sources.get(name) or sources.get(name.rsplit("/", 1)[0])
        if part is not None:
            found.append((int(geom), part))
    return found
