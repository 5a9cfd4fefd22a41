"""The catalogue of object types: what exists, how big and heavy it is, what can be done with it, and what it is built from.

Types are data (`object_types.yaml`, and `types/` of one's own assets, see `configs.assets`): a shape is a list of primitives,
so a new type needs no code. Paper: the DualTHOR asset set; dimensions, masses and properties follow AI2-THOR's, the meshes are
replaced by primitives.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np
import yaml

from configs.assets import own_files
from configs.validate import ConfigError, build
from interface.facts import Affordances

CATALOGUE_PATH: Final = Path(__file__).parent / "object_types.yaml"
_VERSION: Final = 1

SOLIDS: Final = ("box", "cylinder", "cylinder_x", "cylinder_y", "capsule", "capsule_x", "capsule_y", "ellipsoid")
HOLLOWS: Final = ("tray", "cup", "shell")
SHAPES: Final = SOLIDS + HOLLOWS
OPTIONS: Final = ("ghost", "flat", "handle", "toggle", "glow", "hidden", "liquid", "whole", "slice", "spout")
PROPERTIES: Final = (
    "static",
    "pickupable",
    "two_handed",
    "openable",
    "toggleable",
    "receptacle",
    "fillable",
    "breakable",
    "dirtyable",
    "sliceable",
    "cookable",
    "used_up",
    "heat_source",
    "cold_source",
    "cutter",
    "wiper",
    "unsteady",
)


MATERIALS: Final = (
    "Metal", "Wood", "Plastic", "Glass", "Ceramic", "Stone", "Fabric", "Rubber", "Food", "Paper", "Wax", "Soap", "Sponge",
    "Organic", "Leather",
)  # fmt: skip
#: Width or depth from which on two hands find room on an object, metres. Chosen by hand.
_BROAD_M: Final = 0.2


@dataclass(frozen=True, slots=True)
class Part:
    """One primitive of a shape, in the type's frame.

    Attributes:
        shape: one of `SHAPES`.
        center: (x, y, z) metres.
        size: full extents along x, y, z, metres.
        color: name in `Catalogue.colors`.
        wall_m: wall thickness of hollow shapes, 0 for solids.
        options: subset of `OPTIONS`.
    """

    shape: str
    center: tuple[float, float, float]
    size: tuple[float, float, float]
    color: str
    wall_m: float = 0.0
    options: frozenset[str] = frozenset()

    @staticmethod
    def parse(row: Any, where: str) -> Part:
        """Reads `[shape, cx, cy, cz, sx, sy, sz, colour, options ...]`.

        Raises:
            ValueError: on an unknown shape or option, missing numbers, or a hollow shape without wall thickness.
        """
        if not isinstance(row, list) or len(row) < 8:
            raise ValueError(f"{where}: a part is [shape, cx, cy, cz, sx, sy, sz, colour, options ...], got {row!r}")
        shape, numbers, color, rest = row[0], row[1:7], row[7], row[8:]
        if shape not in SHAPES:
            raise ValueError(f"{where}: unknown shape {shape!r}; allowed: {', '.join(SHAPES)}")
        if not all(isinstance(value, int | float) for value in numbers) or min(numbers[3:]) <= 0:
            raise ValueError(f"{where}: centre and positive extents must be six numbers, got {numbers!r}")
        wall = 0.0
        if shape in HOLLOWS:
            if not rest or not isinstance(rest[0], int | float):
                raise ValueError(f"{where}: {shape} needs a wall thickness after its colour, got {rest!r}")
            wall, rest = float(rest[0]), rest[1:]
        unknown = [option for option in rest if option not in OPTIONS]
        if unknown:
            raise ValueError(f"{where}: unknown option {unknown[0]!r}; allowed: {', '.join(OPTIONS)}")
        x, y, z, sx, sy, sz = (float(value) for value in numbers)
        return Part(shape, (x, y, z), (sx, sy, sz), str(color), wall, frozenset(rest))


@dataclass(frozen=True, slots=True)
class SurfaceSpec:
    """A horizontal rectangle on which objects rest, in the type's frame.

    Attributes:
        name: unique within the type.
        rect: centre x, centre y, extent x, extent y, metres.
        z: height, metres.
        clearance: free height above it, metres.
        inside: reachable only when the object is open.
        all_sides: reachable from every side, not only from the front (-y).
    """

    name: str
    rect: tuple[float, float, float, float]
    z: float
    clearance: float
    inside: bool = False
    all_sides: bool = False


@dataclass(frozen=True, slots=True)
class MovingSpec:
    """A door, drawer or lid: a hinged or sliding body.

    Attributes:
        name: unique within the type.
        joint: hinge or slide.
        axis: joint axis, positive towards open.
        at: anchor (x, y, z) metres.
        range: closed and fully open position, radians or metres.
        parts: primitives, in the frame of the type at the closed position.
        surfaces: surfaces that travel with it.
        mass_kg: its mass, a share of the object's where that can be lifted; None for that of a door or drawer.
        friction, damping: of the joint, N m and N m s (N and N s/m of a slide); None for those of a door or drawer.
        start: share of the range by which it is open at the start.
    """

    name: str
    joint: Literal["hinge", "slide"]
    axis: tuple[float, float, float]
    at: tuple[float, float, float]
    range: tuple[float, float]
    parts: tuple[Part, ...]
    surfaces: tuple[SurfaceSpec, ...] = ()
    mass_kg: float | None = None
    friction: float | None = None
    damping: float | None = None
    start: float = 0.0

    def __post_init__(self) -> None:
        if not 0.0 <= self.start <= 1.0:
            raise ValueError(f"{self.name}: start must be in [0, 1], got {self.start!r}")
        for name in ("mass_kg", "friction", "damping"):
            value = getattr(self, name)
            if value is not None and value <= 0.0:
                raise ValueError(f"{self.name}: {name} must be positive, got {value!r}")

    @property
    def is_lid(self) -> bool:
        """Whether it turns about a level axis: a lid, a cover, a screen."""
        return self.joint == "hinge" and abs(self.axis[2]) < 0.5


@dataclass(frozen=True, slots=True)
class ObjectType:
    """One of the 68 types.

    Attributes:
        name: AI2-THOR type name.
        rooms: room categories in which it occurs.
        size: bounding box (long x, short y, height z), metres.
        mass: kilograms, None for fixtures.
        properties: subset of `PROPERTIES`.
        parts: primitives of the fixed body.
        moving: doors, drawers and lids.
        surfaces: where objects can rest.
        grips: `single` and `double` to preferred hand points in the type's frame, metres.
        capacity_l: litres of liquid that it holds; None for what the size suggests, see `volume_l`.
        materials: AI2-THOR's salient materials, subset of `MATERIALS`.
        note: remark from the measurements.
    """

    name: str
    rooms: tuple[str, ...]
    size: tuple[float, float, float]
    mass: float | None
    properties: frozenset[str]
    parts: tuple[Part, ...]
    moving: tuple[MovingSpec, ...] = ()
    surfaces: tuple[SurfaceSpec, ...] = ()
    grips: Mapping[str, tuple[tuple[float, float, float], ...]] = field(default_factory=dict)
    capacity_l: float | None = None
    materials: tuple[str, ...] = ()
    note: str = ""

    def __post_init__(self) -> None:
        strange = sorted(set(self.materials) - set(MATERIALS))
        if strange:
            raise ValueError(f"{self.name}: unknown material {strange[0]!r}; allowed: {', '.join(MATERIALS)}")
        unknown = sorted(self.properties - set(PROPERTIES))
        if unknown:
            raise ValueError(f"{self.name}: unknown property {unknown[0]!r}; allowed: {', '.join(PROPERTIES)}")
        strange = [key for key in self.grips if key not in ("single", "double")]
        if strange:
            raise ValueError(f"{self.name}: unknown grip {strange[0]!r}; allowed: single, double")

    def has(self, name: str) -> bool:
        """Whether the type has a property.

        Raises:
            ValueError: on a name outside `PROPERTIES`.
        """
        if name not in PROPERTIES:
            raise ValueError(f"unknown property {name!r}; allowed: {', '.join(PROPERTIES)}")
        return name in self.properties

    @property
    def pickupable(self) -> bool:
        """Whether one hand can lift it."""
        return "pickupable" in self.properties

    @property
    def two_handed(self) -> bool:
        """Whether lifting it takes both hands."""
        return "two_handed" in self.properties

    @property
    def openable(self) -> bool:
        """Whether it has a door, drawer or lid."""
        return bool(self.moving)

    @property
    def encloses(self) -> bool:
        """Whether all that it carries is shut away when it is closed; a toilet's lid shuts nothing away from its tank."""
        surfaces = [*self.surfaces, *(surface for moving in self.moving for surface in moving.surfaces)]
        return bool(self.moving) and bool(surfaces) and all(surface.inside for surface in surfaces)

    @property
    def starts_open(self) -> float:
        """How far it is open at the start, 0 to 1, when nothing else is said."""
        return max((moving.start for moving in self.moving), default=0.0)

    @property
    def lidded(self) -> bool:
        """Whether it opens at the top."""
        return any(moving.is_lid for moving in self.moving)

    @property
    def toggleable(self) -> bool:
        """Whether it can be switched on and off."""
        return "toggleable" in self.properties

    @property
    def receptacle(self) -> bool:
        """Whether objects can rest on or in it."""
        return bool(self.surfaces) or any(moving.surfaces for moving in self.moving)

    @property
    def movable(self) -> bool:
        """Whether it can be lifted, with one hand or two."""
        return "pickupable" in self.properties or "two_handed" in self.properties

    @property
    def broad(self) -> bool:
        """Whether two hands find room on it."""
        return max(self.size[:2]) >= _BROAD_M

    @property
    def volume_l(self) -> float:
        """Litres that it holds: the given figure, else a sixth of its box, at most 2.4; 0 for what holds none."""
        if not self.fillable:
            return 0.0
        return self.capacity_l if self.capacity_l is not None else float(min(150.0 * np.prod(self.size), 2.4))

    @property
    def fillable(self) -> bool:
        """Whether it can hold a liquid."""
        return "fillable" in self.properties

    @property
    def spouts(self) -> bool:
        """Whether a liquid comes out of it."""
        return any("spout" in part.options for part in self.parts)

    def affordances(self, movable: bool) -> Affordances:
        """What can be done with an object of the type, one that can be carried or one that belongs to the room."""
        return Affordances(
            movable=movable,
            pickupable=self.pickupable,
            liftable=self.broad,
            receptacle=self.receptacle,
            openable=self.openable,
            encloses=self.encloses,
            lidded=self.lidded,
            toggleable=self.toggleable,
            sliceable=self.has("sliceable"),
            consumable=self.has("used_up"),
            fillable=self.fillable,
            cutter=self.has("cutter"),
            wiper=self.has("wiper"),
            unsteady=self.has("unsteady"),
            heat_source=self.has("heat_source"),
        )


@dataclass(frozen=True, slots=True, eq=False)
class Catalogue:
    """All types and the colours they use.

    Attributes:
        version: data version.
        colors: name to (r, g, b, a) in [0, 1].
        types: name to type, in the file's order; the order gives the type index of segmentation images.
    """

    version: int
    colors: Mapping[str, tuple[float, float, float, float]]
    types: Mapping[str, ObjectType]

    def get(self, name: str) -> ObjectType:
        """The type of that name.

        Raises:
            ValueError: on an unknown name; the message lists the known ones.
        """
        if name not in self.types:
            raise ValueError(f"unknown object type {name!r}; allowed: {', '.join(self.types)}")
        return self.types[name]

    def index(self, name: str) -> int:
        """Position of the type in the catalogue, the label of segmentation images."""
        self.get(name)
        return list(self.types).index(name)


def load_catalogue(path: Path = CATALOGUE_PATH) -> Catalogue:
    """Reads and validates a catalogue; the user's types come after those of the file.

    Raises:
        ValueError: on an unknown version, colour, shape, option or property, or a type or colour that exists twice.
    """
    return _read((path, *own_files("types").values()))


@functools.lru_cache(maxsize=8)
def _read(paths: tuple[Path, ...]) -> Catalogue:
    colors: dict[str, tuple[float, float, float, float]] = {}
    types: dict[str, ObjectType] = {}
    for path in paths:
        raw = yaml.safe_load(path.read_text(encoding="utf-8"))
        if not isinstance(raw, dict) or raw.get("version") != _VERSION:
            version = raw.get("version") if isinstance(raw, dict) else None
            raise ConfigError(f"{path.name}: version {version!r} is not supported; expected {_VERSION}")
        for name, value in raw.get("colors", {}).items():
            if name in colors:
                raise ConfigError(f"{path.name}: colour {name!r} exists already")
            if not 3 <= len(value) <= 4 or not all(isinstance(v, int | float) and 0 <= v <= 1 for v in value):
                raise ConfigError(f"{path.name}: colour {name!r} must be three or four numbers in [0, 1], got {value!r}")
            r, g, b, a = (*map(float, value), 1.0)[:4]
            colors[name] = (r, g, b, a)
        for name, entry in raw.get("types", {}).items():
            if name in types:
                raise ConfigError(f"{path.name}: type {name!r} exists already")
            types[name] = kind = _type(name, entry, path.name)
            for part in (*kind.parts, *(part for moving in kind.moving for part in moving.parts)):
                if part.color not in colors:
                    raise ConfigError(f"{path.name}: {name}: unknown colour {part.color!r}; allowed: {', '.join(colors)}")
    return Catalogue(_VERSION, colors, types)


def _type(name: str, entry: Any, file: str) -> ObjectType:
    """Builds one type from its entry of a file."""
    where = f"{file}: {name}"
    if not isinstance(entry, dict):
        raise ConfigError(f"{where}: expected a mapping, got {entry!r}")
    values: dict[str, Any] = {**entry, "name": name, "parts": _parts(entry.get("parts"), f"{where}.parts")}
    properties = entry.get("properties", ())
    unknown = [word for word in properties if word not in PROPERTIES]
    if unknown:
        raise ConfigError(f"{where}: unknown property {unknown[0]!r}; allowed: {', '.join(PROPERTIES)}")
    values["properties"] = properties
    values["moving"] = tuple(
        build(
            MovingSpec,
            {**moving, "parts": _parts(moving.get("parts"), f"{where}.moving.{moving.get('name')}")},
            f"{where}.moving",
        )
        for moving in entry.get("moving", ())
    )
    values["grips"] = {key: tuple(tuple(point) for point in points) for key, points in entry.get("grips", {}).items()}
    values["surfaces"] = tuple(build(SurfaceSpec, surface, f"{where}.surfaces") for surface in entry.get("surfaces", ()))
    return build(ObjectType, values, where)


def _parts(rows: Any, where: str) -> tuple[Part, ...]:
    if not isinstance(rows, list) or not rows:
        raise ConfigError(f"{where}: expected a list of parts, got {rows!r}")
    return tuple(Part.parse(row, where) for row in rows)
