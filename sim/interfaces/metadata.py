"""AI2-THOR-style metadata of a world: one record per object, and the robot's.

Paper: the scene state that DualTHOR returns. Frames: MuJoCo's (z up, metres); AI2-THOR's y-up frame is not used. Key names are
AI2-THOR's, plus `heldBy` (arms that hold the object), `center`, `temperatureCelsius`, and DualTHOR's `isMoveable`.
"""

from __future__ import annotations

import math
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from sim.scene.objects import ObjectInstance
from sim.world.placement import box_in_world
from sim.world.world import World

Array = NDArray[np.float64]
_CORNERS: Final = np.array([(i, j, k) for i in (0.0, 1.0) for j in (0.0, 1.0) for k in (0.0, 1.0)])
#: A pelvis that is lower than standing by more than this is crouching, metres.
_STANDING_M: Final = 0.05


def temperature_name(celsius: float) -> str:
    """AI2-THOR's class of a temperature: Cold below 12 °C, Hot above 45 °C, RoomTemp between."""
    if celsius < 12.0:
        return "Cold"
    return "Hot" if celsius > 45.0 else "RoomTemp"


def object_metadata(
    world: World, obj: ObjectInstance, parents: tuple[str, ...], contents: tuple[str, ...], mass_kg: float
) -> dict[str, Any]:
    """One object's record."""
    kind, state = obj.type, obj.state
    low, high = box_in_world(world.data, obj)
    position, rotation = world.data.xpos[obj.body_id], world.data.xmat[obj.body_id].reshape(3, 3)
    center = (low + high) / 2.0
    entry: dict[str, Any] = {
        "objectId": obj.object_id,
        "name": obj.object_id,
        "objectType": kind.name,
        "position": _xyz(position),
        "center": _xyz(center),
        "rotation": _euler(rotation),
        "distance": world.servos.distance_to((low, high)),
        "receptacle": kind.receptacle,
        "toggleable": kind.toggleable,
        "isToggled": state.isToggled,
        "breakable": kind.has("breakable"),
        "isBroken": state.isBroken,
        "canFillWithLiquid": kind.fillable,
        "isFilledWithLiquid": state.isFilledWithLiquid,
        "fillLiquid": state.fillLiquid or None,
        "fillLitres": state.fillLitres,
        "dirtyable": kind.has("dirtyable"),
        "isDirty": state.isDirty,
        "canBeUsedUp": kind.has("used_up"),
        "isUsedUp": state.isUsedUp,
        "cookable": kind.has("cookable"),
        "isCooked": state.isCooked,
        "sliceable": kind.has("sliceable"),
        "isSliced": state.isSliced,
        "openable": kind.openable,
        "isOpen": obj.is_open if kind.openable else False,
        "openness": obj.openness,
        "selfClosing": obj.self_closing,
        "pickupable": kind.pickupable,
        "isPickedUp": bool(obj.held_by),
        "heldBy": list(obj.held_by),
        "moveable": obj.movable and not kind.pickupable,
        "isMoveable": obj.movable,
        "isMoving": world.poses.speed_m_s(obj.object_id) > 0.02,
        "isHeatSource": kind.has("heat_source"),
        "isColdSource": kind.has("cold_source"),
        "temperature": temperature_name(state.temperature),
        "temperatureCelsius": state.temperature,
        "mass": mass_kg if obj.movable else 0.0,
        "salientMaterials": list(kind.materials),
        "parentReceptacles": list(parents),
        "receptacleObjectIds": list(contents),
        "axisAlignedBoundingBox": {"center": _xyz(center), "size": _xyz(high - low)},
        "objectOrientedBoundingBox": {"cornerPoints": _corners(obj, position, rotation)},
    }
    return entry


def world_metadata(world: World) -> dict[str, Any]:
    """The whole scene's record: `objects`, `agent`, `sceneName`, `sceneBounds`, `inventoryObjects`."""
    parents = world.containment.all_parents()
    masses = world.containment.masses_kg(parents)
    contents: dict[str, list[str]] = {}
    for name, above in parents.items():
        for parent in above:
            contents.setdefault(parent, []).append(name)
    objects = [
        object_metadata(world, obj, parents.get(name, ()), tuple(contents.get(name, ())), masses[name])
        for name, obj in world.objects.items()
    ]
    x0, y0, x1, y1 = world.room.bounds
    record: dict[str, Any] = {
        "objects": objects,
        "sceneName": world.room.name,
        "sceneBounds": {"center": _xyz([(x0 + x1) / 2, (y0 + y1) / 2, 1.3]), "size": _xyz([x1 - x0, y1 - y0, 2.6])},
        "inventoryObjects": [
            {"objectId": obj.object_id, "objectType": obj.type.name, "arms": list(obj.held_by)}
            for obj in world.objects.values()
            if obj.held_by
        ],
        "spills": world.liquids.metadata(),
        "time": world.time_s,
    }
    if world.robot is not None:
        pose = world.servos.base_pose
        record["agent"] = {
            "name": world.robot.name,
            "position": _xyz(pose[:3]),
            "rotation": {"x": 0.0, "y": 0.0, "z": float(np.degrees(pose[3]))},
            "pelvisHeight": float(pose[2]),
            "isStanding": bool(pose[2] > world.robot.standing_pelvis_height_m - _STANDING_M),
            "cameraHorizon": _horizon(world),
            "jointAngles": world.servos.joint_positions(),
            "handOpening": {"left": world.servos.hand_opening("left"), "right": world.servos.hand_opening("right")},
        }
    return record


def _horizon(world: World) -> float:
    """Degrees by which the head camera looks below the horizon."""
    assert world.robot is not None
    camera = int(world.model.camera(world.robot.head_camera).id)
    return float(np.degrees(np.arcsin(np.clip(world.data.cam_xmat[camera].reshape(3, 3)[2, 2], -1.0, 1.0))))


def _xyz(values: Any) -> dict[str, float]:
    return {"x": float(values[0]), "y": float(values[1]), "z": float(values[2])}


def _corners(obj: ObjectInstance, position: Array, rotation: Array) -> list[list[float]]:
    """Eight corners of the box in the object's own axes, world frame, metres."""
    local = obj.local_min + _CORNERS * (obj.local_max - obj.local_min)
    return (local @ rotation.T + position).tolist()


def _euler(m: Array) -> dict[str, float]:
    """Roll, pitch, yaw in degrees (rotations about x, y, z, in that order, in the world)."""
    roll = math.degrees(math.atan2(m[2, 1], m[2, 2]))
    pitch = math.degrees(math.asin(min(max(-float(m[2, 0]), -1.0), 1.0)))
    return {"x": roll, "y": pitch, "z": math.degrees(math.atan2(m[1, 0], m[0, 0]))}
