"""Rooms as data: floor, walls, furniture poses, wiring, and the objects that lie around by default.

One YAML file per room in this folder, or in `rooms/` of one's own assets (`configs.assets`). World frame: x and y in metres on
the floor, z up, origin at the centre of the floor. Paper: the DualTHOR scenes (kitchen, living room, bedroom, bathroom).
"""

from __future__ import annotations

import functools
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import yaml

from configs.assets import asset_files
from configs.validate import ConfigError, allowed_values, build
from sim.scene.catalogue import Catalogue, Part, load_catalogue

ROOMS_PATH: Final = Path(__file__).parent
_ID = re.compile(r"^([A-Za-z][A-Za-z0-9]*)_[1-9][0-9]*$")


@dataclass(frozen=True, slots=True)
class Furniture:
    """One fixed object of a room.

    Attributes:
        id: `Type_n`.
        xy: position of its frame, metres.
        yaw_deg: rotation about z; at 0 its front looks along -y.
        z: height of its frame above the floor, metres.
    """

    id: str
    xy: tuple[float, float]
    yaw_deg: float = 0.0
    z: float = 0.0

    @property
    def type_name(self) -> str:
        """Catalogue type, the part of the id before the number."""
        return self.id.rsplit("_", 1)[0]


@dataclass(frozen=True, slots=True)
class DefaultObject:
    """A movable object that lies in the room when no task says otherwise.

    Attributes:
        id: `Type_n`.
        receptacle: id of the furniture that carries it.
        yaw_deg: orientation about z; at 0 its front looks along -y.
    """

    id: str
    receptacle: str
    yaw_deg: float = 0.0


@dataclass(frozen=True, slots=True)
class Room:
    """A room.

    Attributes:
        name: file name without suffix.
        category: kitchen, living_room, bedroom or bathroom.
        bounds: (x_min, y_min, x_max, y_max) of the floor, metres.
        wall_height: metres.
        wall_colors: rgb of the walls at y_max, x_max, y_min, x_min.
        floor_colors: the two rgb colours of the floor's tiles.
        start: the robot's default pose, x, y in metres and yaw in degrees.
        furniture: fixed objects.
        decor: primitives in the world frame that are no objects (worktops around a sink, plinths).
        links: what a switch acts on: knob to burner, faucet to basin.
        objects: movable objects lying around by default.
    """

    name: str
    category: str
    bounds: tuple[float, float, float, float]
    wall_height: float
    wall_colors: tuple[tuple[float, float, float], ...]
    floor_colors: tuple[tuple[float, float, float], tuple[float, float, float]]
    start: tuple[float, float, float]
    furniture: tuple[Furniture, ...]
    decor: tuple[Part, ...] = ()
    links: Mapping[str, str] = field(default_factory=dict)
    objects: tuple[DefaultObject, ...] = ()

    def __post_init__(self) -> None:
        ids = [item.id for item in self.furniture]
        for object_id in (*ids, *(item.id for item in self.objects)):
            match = _ID.match(object_id)
            if match is None:
                raise ValueError(f"{self.name}: object id {object_id!r} is not of the form Type_1")
            load_catalogue().get(match.group(1))
        if len(set(ids)) != len(ids):
            raise ValueError(f"{self.name}: furniture ids repeat: {sorted({i for i in ids if ids.count(i) > 1})}")
        for source, target in self.links.items():
            if source not in ids or target not in ids:
                raise ValueError(f"{self.name}: link {source!r} -> {target!r} names no furniture; allowed: {', '.join(ids)}")
        for item in self.objects:
            if item.receptacle not in ids:
                raise ValueError(f"{self.name}: {item.id} lies on unknown {item.receptacle!r}; allowed: {', '.join(ids)}")


def room_names() -> tuple[str, ...]:
    """Names of all rooms, the user's included."""
    return tuple(sorted(asset_files("rooms", ROOMS_PATH)))


def load_room(name: str) -> Room:
    """Reads and validates a room.

    Raises:
        ValueError: on an unknown name or an entry that is not allowed.
    """
    files = asset_files("rooms", ROOMS_PATH)
    if name not in files:
        raise ValueError(f"unknown room {name!r}; {allowed_values(name, sorted(files))}")
    return _read(files[name], load_catalogue())


@functools.lru_cache(maxsize=32)
def _read(path: Path, catalogue: Catalogue) -> Room:
    """Reads one file; `catalogue` is part of the key, because the ids are checked against it."""
    name = path.stem
    raw = yaml.safe_load(path.read_text(encoding="utf-8"))
    if not isinstance(raw, dict):
        raise ConfigError(f"{path}: expected a mapping")
    decor = tuple(Part.parse(row, f"{name}.decor") for row in raw.pop("decor", ()))
    room = build(Room, {**raw, "name": name, "decor": ()}, name)
    return Room(**{**{key: getattr(room, key) for key in Room.__dataclass_fields__}, "decor": decor})
