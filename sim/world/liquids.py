"""Liquids as volumes: what vessels hold, what flows where, what is spilled, and books that show that nothing is lost.

A vessel holds litres of one liquid up to its capacity (density 1 kg/l); AI2-THOR's `isFilledWithLiquid` is true from a tenth of
it. A tap fills the vessel below its spout, else its basin, whose overflow drains; a coffee machine fills what stands below its
nozzle; a vessel that is tilted by more than 60 degrees runs out over its lower rim, into the vessel below that rim if there is
one; what misses a vessel is a puddle on the surface below, until it is wiped up. At any time what is in vessels and puddles,
drained and wiped equals what was given (`balance_l`). Paper: filling and spilling of DualTHOR, there switches without volume.
Left out: waves, mixing (the larger part names the liquid), evaporation.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Final

import mujoco
import numpy as np
from numpy.typing import NDArray

from sim.scene.catalogue import ObjectType
from sim.scene.compiler import PUDDLES

if TYPE_CHECKING:
    from sim.scene.objects import ObjectInstance
    from sim.world.world import World

__all__ = [
    "LIQUIDS",
    "Books",
    "Puddle",
    "balance_l",
    "capacity_l",
    "flow",
    "give",
    "opening_below",
    "opening_radius_m",
    "pour",
    "rim",
    "run_out",
    "set_level",
    "spill",
    "spout",
    "wipe",
]

LIQUIDS: Final = ("water", "coffee", "wine")
FILLED_SHARE: Final = 0.1
TAP_L_S: Final = 0.15
COFFEE_L_S: Final = 0.05
POUR_L_S: Final = 0.25
STEEP: Final = float(np.cos(np.radians(60.0)))
_BESIDE_M: Final = 0.02
_DROP_L: Final = 1e-9
_FILM_M: Final = 0.0015
_MERGE_M: Final = 0.3
_HOT_C: Final = 80.0


@dataclass(frozen=True, slots=True)
class Puddle:
    """Spilled liquid.

    Attributes:
        surface: id of what it lies on, `Floor` for the floor.
        position: (x, y, z) in the world, metres.
        litres: how much.
        liquid: what.
    """

    surface: str
    position: tuple[float, float, float]
    litres: float
    liquid: str


@dataclass(slots=True)
class Books:
    """Where all liquid came from and went to, litres.

    Attributes:
        given: put in at the start or by hand, and delivered by taps and machines.
        drained: run off through a basin's overflow, or gone beyond the room.
        wiped: cleaned up.
        puddles: what lies about.
    """

    given: float = 0.0
    drained: float = 0.0
    wiped: float = 0.0
    puddles: list[Puddle] = field(default_factory=list)

    def copy(self) -> Books:
        """An independent copy."""
        return Books(self.given, self.drained, self.wiped, list(self.puddles))


def capacity_l(kind: ObjectType) -> float:
    """Litres that a type holds: the catalogue's figure, else a sixth of its box, at most 2.4; 0 for what holds none."""
    if not kind.fillable:
        return 0.0
    return kind.capacity_l if kind.capacity_l is not None else float(min(150.0 * np.prod(kind.size), 2.4))


def balance_l(world: World) -> float:
    """Litres that are unaccounted for: 0 up to rounding, whatever has happened."""
    books = world.liquids
    held = sum(thing.state.fillLitres for thing in world.objects.values())
    return books.given - books.drained - books.wiped - held - sum(puddle.litres for puddle in books.puddles)


def set_level(world: World, thing: ObjectInstance, litres: float, liquid: str) -> None:
    """Changes how much a vessel holds, without bookkeeping, and what follows: AI2-THOR's states, mass and look."""
    state = thing.state
    state.fillLitres = float(np.clip(litres, 0.0, capacity_l(thing.type)))
    state.fillLiquid = liquid if state.fillLitres > 0.0 else ""
    state.isFilledWithLiquid = state.fillLitres >= FILLED_SHARE * capacity_l(thing.type) > 0.0
    world.refresh(thing)


def _add(world: World, thing: ObjectInstance, litres: float, liquid: str) -> float:
    """Adds what there is room for; returns how much that was."""
    state = thing.state
    room = max(capacity_l(thing.type) - state.fillLitres, 0.0)
    added = min(litres, room)
    if added > 0.0:
        kind = liquid if added > state.fillLitres or not state.fillLiquid else state.fillLiquid
        set_level(world, thing, state.fillLitres + added, kind)
    return added


def give(world: World, thing: ObjectInstance, litres: float, liquid: str) -> float:
    """Delivers liquid from outside into a vessel; returns how much went in."""
    before = thing.state.fillLitres
    _add(world, thing, litres, liquid)
    added = thing.state.fillLitres - before
    world.liquids.given += added
    return added


def pour(world: World, source: ObjectInstance, target: ObjectInstance | None, litres: float) -> float:
    """Moves liquid from a vessel into another one; without a target, or beyond its capacity, it is spilled below it.

    Returns:
        Litres that came into the target.
    """
    before, liquid = source.state.fillLitres, source.state.fillLiquid
    if before <= 0.0 or litres <= 0.0:
        return 0.0
    set_level(world, source, before - litres, liquid)
    moved = before - source.state.fillLitres
    came = 0.0
    if target is not None:
        held = target.state.fillLitres
        _add(world, target, moved, liquid)
        came = target.state.fillLitres - held
    if moved - came > _DROP_L:
        _land(world, target if target is not None else source, moved - came, liquid)
    return came


def spill(world: World, thing: ObjectInstance, litres: float | None = None) -> float:
    """Lets a vessel run out, all of it by default, onto what is below; returns how much it lost."""
    before = thing.state.fillLitres
    pour(world, thing, None, before if litres is None else litres)
    return before - thing.state.fillLitres


def wipe(world: World, surface: str) -> float:
    """Takes up the puddles on a surface; returns the litres."""
    gone = [puddle for puddle in world.liquids.puddles if puddle.surface == surface]
    world.liquids.puddles = [puddle for puddle in world.liquids.puddles if puddle.surface != surface]
    litres = sum(puddle.litres for puddle in gone)
    world.liquids.wiped += litres
    show(world)
    return litres


def _land(world: World, above: ObjectInstance, litres: float, liquid: str) -> None:
    """Liquid that falls from beside a vessel: into a basin below, or onto the surface below as a puddle."""
    start = world.data.xpos[above.body_id] + world.data.xmat[above.body_id].reshape(3, 3) @ (
        0.5 * (above.local_min + above.local_max)
    )
    surface, point = _below(world, start, above)
    if surface is not None and surface.type.fillable and not surface.movable:
        litres -= _add(world, surface, litres, liquid)
        world.liquids.drained += litres
        return
    name = "Floor" if surface is None else surface.object_id
    puddles = world.liquids.puddles
    near = [p for p in puddles if p.surface == name and float(np.hypot(*(np.subtract(p.position, point)[:2]))) < _MERGE_M]
    if not near and len(puddles) >= PUDDLES:
        near = sorted(puddles, key=lambda p: float(np.linalg.norm(np.subtract(p.position, point))))
    if near:
        index = puddles.index(near[0])
        kind = liquid if litres > near[0].litres else near[0].liquid
        puddles[index] = replace(near[0], litres=near[0].litres + litres, liquid=kind)
    else:
        puddles.append(Puddle(name, (float(point[0]), float(point[1]), float(point[2])), litres, liquid))
    show(world)


def _below(
    world: World, start: NDArray[np.float64], above: ObjectInstance
) -> tuple[ObjectInstance | None, NDArray[np.float64]]:
    """What furniture is below a point, and where; the floor when there is none."""
    model, data = world.model, world.data
    names = list(world.objects)
    origin = start.copy()
    hit = np.zeros(1, dtype=np.int32)
    for _ in range(64):
        distance = mujoco.mj_ray(model, data, origin, np.array([0.0, 0.0, -1.0]), None, 1, above.body_id, hit)
        if distance < 0.0:
            break
        origin = origin - (0.0, 0.0, distance + 1e-4)
        owner = int(world.object_of_geom[hit[0]])
        if owner >= 0 and not world.objects[names[owner]].movable and model.geom_contype[hit[0]] > 0:
            return world.objects[names[owner]], origin + (0.0, 0.0, 1e-4)
    return None, np.array([start[0], start[1], 0.0])


def spout(world: World, source: ObjectInstance) -> NDArray[np.float64] | None:
    """(3,) world point below which a source's liquid falls, None for what has no spout."""
    for geom, part in world.part_of_geom[source.object_id]:
        if "spout" in part.options:
            return world.data.geom_xpos[geom] - (0.0, 0.0, part.size[2] / 2.0)
    return None


def run_out(world: World, seconds: float) -> None:
    """What leaves tilted vessels in a while: into the vessel whose opening is below the rim, or onto what is below."""
    for thing in world.objects.values():
        if thing.movable and thing.state.fillLitres > 0.0 and float(world.data.xmat[thing.body_id, 8]) < STEEP:
            pour(world, thing, opening_below(world, rim(world, thing), thing), POUR_L_S * seconds)


def rim(world: World, thing: ObjectInstance, pose: NDArray[np.float64] | None = None) -> NDArray[np.float64]:
    """(3,) lowest point of a vessel's rim, where liquid leaves it; for its present pose or a (4, 4) other one."""
    pose = world.pose(thing.object_id) if pose is None else pose
    top = 0.5 * (thing.local_min + thing.local_max)
    top[2] = thing.local_max[2]
    down = -pose[2, :3]
    length = float(np.hypot(down[0], down[1]))
    if length > 1e-6:
        top[:2] += down[:2] / length * opening_radius_m(thing)
    return pose[:3, 3] + pose[:3, :3] @ top


def opening_radius_m(thing: ObjectInstance) -> float:
    """Radius of a vessel's opening, metres: half the short side of its box."""
    return 0.5 * float(np.min((thing.local_max - thing.local_min)[:2]))


def opening_below(world: World, point: NDArray[np.float64], but: ObjectInstance | None = None) -> ObjectInstance | None:
    """The vessel whose opening is below a point, the highest one, else the basin; tipped and broken ones do not count."""
    best: tuple[tuple[bool, float], ObjectInstance] | None = None
    for thing in world.objects.values():
        if thing is but or not thing.type.fillable or thing.state.isBroken or world.data.xmat[thing.body_id, 8] < 0.5:
            continue
        pose = world.pose(thing.object_id)
        local = pose[:3, :3].T @ (point - pose[:3, 3])
        middle, half = 0.5 * (thing.local_min + thing.local_max), 0.5 * (thing.local_max - thing.local_min)
        if thing.movable:
            off = float(np.hypot(*(local - middle)[:2]))
            within = off <= opening_radius_m(thing) + _BESIDE_M
        else:
            within = bool(np.all(np.abs((local - middle)[:2]) <= half[:2]))
        top = float(pose[2, 3] + thing.local_max[2])
        rank = (thing.movable, top)
        if within and top - 0.02 <= point[2] <= top + 0.6 and (best is None or rank > best[0]):
            best = (rank, thing)
    return None if best is None else best[1]


def flow(world: World, seconds: float) -> None:
    """What taps and coffee machines deliver in a while."""
    for source in world.objects.values():
        if not source.state.isToggled:
            continue
        outlet = spout(world, source)
        if outlet is None:
            continue
        basin = world.room.links.get(source.object_id)
        vessel = opening_below(world, outlet)
        if vessel is not None and (not vessel.movable or vessel.state.fillLitres >= capacity_l(vessel.type)):
            vessel = None
        if basin is None:
            if vessel is not None and give(world, vessel, COFFEE_L_S * seconds, "coffee") > 0.0:
                vessel.state.temperature = max(vessel.state.temperature, _HOT_C)
            continue
        litres = TAP_L_S * seconds
        if vessel is not None:
            litres -= give(world, vessel, litres, "water")
        if litres > _DROP_L:
            poured = give(world, world.objects[basin], litres, "water")
            world.liquids.given += litres - poured
            world.liquids.drained += litres - poured


def show(world: World) -> None:
    """Puts the scene's puddle geoms where liquid lies, as wide as a film of 1.5 mm, 3 to 30 cm in radius."""
    model = world.model
    for index in range(PUDDLES):
        geom = int(model.geom(f"puddle/{index}").id)
        if index >= len(world.liquids.puddles):
            model.geom_rgba[geom, 3] = 0.0
            continue
        puddle = world.liquids.puddles[index]
        radius = float(np.clip(np.sqrt(1e-3 * puddle.litres / (np.pi * _FILM_M)), 0.03, 0.3))
        world.move_geom(geom, np.add(puddle.position, (0.0, 0.0, 0.002)))
        model.geom_size[geom, 0] = model.geom_rbound[geom] = radius
        model.geom_rgba[geom] = color_of(world, puddle.liquid)


def color_of(world: World, liquid: str) -> NDArray[np.float64]:
    """(4,) colour of a liquid."""
    if liquid == "coffee":
        return np.array(world.catalogue.colors["coffee"])
    return np.array(world.catalogue.colors["maroon"]) if liquid == "wine" else np.array([0.30, 0.55, 0.95, 0.9])


def facts(world: World) -> list[dict[str, Any]]:
    """The puddles, for the scene's metadata."""
    return [
        {
            "surface": puddle.surface,
            "position": dict(zip("xyz", puddle.position, strict=True)),
            "litres": puddle.litres,
            "liquid": puddle.liquid,
        }
        for puddle in world.liquids.puddles
    ]
