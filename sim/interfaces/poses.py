"""Poses of the robot and of objects, asked for and set: AI2-THOR's GetInteractablePoses, SetObjectPoses, InitialRandomSpawn.

These belong to whoever sets a scene up, not to a planner: what they tell or change is privileged. Interactable means within an
arm's sampled envelope (`sim.skills.reach_map`) from a free stance, at some pelvis height; whether the way of the arm is free is
found out by trying. Frames: world, metres; rotations in degrees about x, y, z, in that order.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import mujoco
import numpy as np
from numpy.typing import NDArray

from interface.bodies import Arm
from sim.scene.catalogue import load_catalogue
from sim.scene.objects import ObjectPlacement
from sim.scene.rooms import load_room
from sim.skills.body.body import Body
from sim.world.placement import fits_on
from sim.world.world import World, WorldError

Array = NDArray[np.float64]

_RING_M: Final = 0.1
_DIRECTIONS: Final = 24
#: Deepest overlap with anything else at which a pose that is asked for counts as free.
_TOUCH_M: Final = 0.004
_SPAWN_ATTEMPTS: Final = 200


@dataclass(frozen=True, slots=True)
class InteractablePose:
    """A pose of the base from which an object is within reach.

    Attributes:
        x_m, y_m, yaw_deg: base pose.
        pelvis_height_m: a height at which it is.
        arms: arms whose envelope holds it there.
    """

    x_m: float
    y_m: float
    yaw_deg: float
    pelvis_height_m: float
    arms: tuple[str, ...]


def interactable_poses(body: Body, object_id: str, limit: int = 100) -> list[InteractablePose]:
    """Base poses from which an object is within reach, the nearest to the object first.

    Args:
        body: the robot.
        object_id: what to reach.
        limit: the most poses to return.
    """
    point = body.objects.interaction_point(object_id)
    far = max(reach_map.reach_m for reach_map in body.ik.maps.values()) + 0.1
    navigation = body.workspace.navigation()
    ways = navigation.ways(body.posture.stance().position)
    heights = sorted(body.ik.heights(), reverse=True)
    found: list[InteractablePose] = []
    distances = np.arange(body.spec.footprint_radius_m, far, _RING_M)
    for stance in navigation.stances(point[:2], distances, count=_DIRECTIONS):
        if not np.isfinite(ways.costs_m(stance.position[None])[0]):
            continue
        for height in heights:
            arms = tuple(arm.value for arm in Arm if body.ik.within(arm, point, height, stance))
            if arms:
                found.append(InteractablePose(stance.x, stance.y, float(np.degrees(stance.yaw_rad)), height, arms))
                break
        if len(found) >= limit:
            break
    return found


def set_object_poses(world: World, poses: Sequence[Mapping[str, Any]], settle_s: float = 0.2) -> None:
    """Puts movable objects where they are asked for, at rest, then lets them settle.

    Args:
        world: the scene; unchanged when one of the poses is refused.
        poses: mappings of AI2-THOR: `objectName` (or `objectId`), `position` {x, y, z} of the object's frame, and
            `rotation` {x, y, z} in degrees, upright when missing.
        settle_s: simulated seconds afterwards, 0 for none.

    Raises:
        WorldError: on an unknown or held or fixed object, numbers that are missing or not finite, a pose outside the room, or
            one that overlaps with something.
    """
    before = world.save()
    try:
        for entry in poses:
            _set_pose(world, entry)
        mujoco.mj_forward(world.model, world.data)
        for entry in poses:
            _check_overlap(world, _name_of(entry))
    except WorldError:
        world.restore(before)
        raise
    if settle_s > 0.0:
        world.advance(settle_s)


def _name_of(entry: Mapping[str, Any]) -> str:
    if not isinstance(entry, Mapping):
        raise WorldError(f"an object pose is a mapping with objectName, position and rotation, got {entry!r}")
    unknown = sorted(set(map(str, entry)) - {"objectName", "objectId", "position", "rotation"})
    if unknown:
        raise WorldError(f"object pose: unknown key {unknown[0]!r}; allowed: objectName, objectId, position, rotation")
    return str(entry.get("objectName", entry.get("objectId", "")))


def _vector(entry: Mapping[str, Any], key: str, name: str) -> Array:
    values = entry.get(key)
    try:
        vector = np.array([float(values[axis]) for axis in "xyz"])  # type: ignore[index]
    except (KeyError, TypeError, ValueError):
        raise WorldError(f"{name}: {key} must be a mapping of three numbers x, y, z, got {values!r}") from None
    if not np.isfinite(vector).all():
        raise WorldError(f"{name}: {key} must be finite, got {values!r}")
    return vector


def _set_pose(world: World, entry: Mapping[str, Any]) -> None:
    name = _name_of(entry)
    obj = world.object(name)
    if not obj.movable:
        raise WorldError(f"{name} is furniture and stays where it is")
    if obj.held_by:
        raise WorldError(f"{name} is held by the {' and '.join(obj.held_by)} arm")
    position = _vector(entry, "position", name)
    x0, y0, x1, y1 = world.room.bounds
    if not (x0 <= position[0] <= x1 and y0 <= position[1] <= y1 and 0.0 <= position[2] <= world.room.wall_height):
        raise WorldError(f"{name}: position {position.tolist()} is outside the room {world.room.bounds}")
    quat = np.array([1.0, 0.0, 0.0, 0.0])
    if entry.get("rotation") is not None:
        mujoco.mju_euler2Quat(quat, np.radians(_vector(entry, "rotation", name)), "XYZ")
    adr, dof = obj.qpos_adr, obj.dof_adr
    world.data.qpos[adr : adr + 3] = position
    world.data.qpos[adr + 3 : adr + 7] = quat
    world.data.qvel[dof : dof + 6] = 0.0


def _check_overlap(world: World, name: str) -> None:
    mine = set(map(int, world.object(name).geom_ids))
    for contact in world.data.contact[: world.data.ncon]:
        if (int(contact.geom1) in mine) != (int(contact.geom2) in mine) and contact.dist < -_TOUCH_M:
            other = int(contact.geom2) if int(contact.geom1) in mine else int(contact.geom1)
            index = int(world.scene.object_of_geom[other])
            what = list(world.objects)[index] if index >= 0 else str(world.model.geom(other).name)
            raise WorldError(f"{name} would overlap with {what} by {-contact.dist:.3f} m")


def random_placements(
    room: str,
    rng: np.random.Generator,
    *,
    excluded_receptacles: Sequence[str] = (),
    excluded_objects: Sequence[str] = (),
) -> list[ObjectPlacement]:
    """The room's objects on receptacles drawn at random, each where it fits; AI2-THOR's InitialRandomSpawn.

    Args:
        room: room name.
        rng: random stream; the same one gives the same placements.
        excluded_receptacles: ids or types of furniture that get nothing.
        excluded_objects: ids or types of objects that stay where the room has them.

    Raises:
        WorldError: on an unknown id or type, or when no arrangement is found.
    """
    layout = load_room(room)
    names = {item.id for item in layout.furniture} | {item.type_name for item in layout.furniture}
    movable = {item.id for item in layout.objects} | {item.id.rsplit("_", 1)[0] for item in layout.objects}
    for wanted, known in ((excluded_receptacles, names), (excluded_objects, movable)):
        unknown = sorted(set(wanted) - known)
        if unknown:
            raise WorldError(f"unknown {unknown[0]!r} in {room}; allowed: {', '.join(sorted(known))}")

    def excluded(object_id: str, these: Sequence[str]) -> bool:
        return object_id in these or object_id.rsplit("_", 1)[0] in these

    catalogue = load_catalogue()
    places = [
        item
        for item in layout.furniture
        if catalogue.get(item.type_name).receptacle and not excluded(item.id, excluded_receptacles)
    ]
    if not places and not all(excluded(item.id, excluded_objects) for item in layout.objects):
        raise WorldError(f"no receptacle is left in {room}")
    for _ in range(_SPAWN_ATTEMPTS):
        placements: list[ObjectPlacement] = []
        for item in layout.objects:
            place = item.receptacle
            if not excluded(item.id, excluded_objects):
                kind = catalogue.get(item.id.rsplit("_", 1)[0])
                fitting = [place.id for place in places if fits_on(kind, catalogue.get(place.type_name))]
                if not fitting:
                    raise WorldError(f"{item.id} fits on none of the receptacles that are left in {room}")
                place = fitting[int(rng.integers(len(fitting)))]
            placements.append(ObjectPlacement(item.id, place, yaw_deg=float(rng.integers(360))))
        try:
            World(None, room, placements, seed=int(rng.integers(2**31)), settle_s=0.0)
        except WorldError:
            continue
        return placements
    raise WorldError(f"no arrangement of {len(layout.objects)} objects was found in {room}")
