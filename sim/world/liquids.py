"""Liquids as volumes: what vessels hold, what flows where, what is spilled, and a ledger that shows that nothing is lost.

A vessel holds litres of one liquid up to its capacity (density 1 kg/l); AI2-THOR's `isFilledWithLiquid` is true from a tenth of
it. A tap fills the vessel below its spout, else its basin, whose overflow drains; a coffee machine fills what stands below its
nozzle; a vessel that is tilted by more than 60 degrees runs out over its lower rim, into the vessel below that rim if there is
one; what misses a vessel is a puddle on the surface below, until it is wiped up. At any time what is in vessels and puddles,
drained and wiped equals what was given (`balance_l`). Paper: filling and spilling of DualTHOR, there switches without volume.
Left out: waves, mixing (the larger part names the liquid), evaporation.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Final

import mujoco
import numpy as np
from numpy.typing import NDArray

from interface.facts import FILLED_SHARE
from sim.scene.compiler import PUDDLES
from sim.scene.objects import ObjectInstance
from sim.world.appearance import Appearance
from sim.world.masses import Masses
from sim.world.poses import ObjectPoses
from sim.world.scene_state import SceneState

LIQUIDS: Final = ("water", "coffee", "wine")
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


class LiquidLedger:
    """All liquid of a running scene: what every vessel and puddle holds, and where it came from and went to, litres.

    Args:
        scene: the running scene.
        poses: where its objects are.
        masses, appearance: what follows from a level.

    Attributes:
        given: put in at the start or by hand, and delivered by taps and machines.
        drained: run off through a basin's overflow, or gone beyond the room.
        wiped: cleaned up.
        puddles: what lies about.
    """

    def __init__(self, scene: SceneState, poses: ObjectPoses, masses: Masses, appearance: Appearance) -> None:
        self._scene, self._poses, self._masses, self._appearance = scene, poses, masses, appearance
        self.given = self.drained = self.wiped = 0.0
        self.puddles: list[Puddle] = []

    def save(self) -> tuple[float, float, float, tuple[Puddle, ...]]:
        """The ledger's own figures; levels are states of the vessels."""
        return self.given, self.drained, self.wiped, tuple(self.puddles)

    def restore(self, saved: tuple[float, float, float, tuple[Puddle, ...]]) -> None:
        """Returns to figures of `save`."""
        self.given, self.drained, self.wiped = saved[:3]
        self.puddles = list(saved[3])

    def balance_l(self) -> float:
        """Litres unaccounted for: always 0 up to rounding."""
        held = sum(item.state.fillLitres for item in self._scene.objects.values())
        return self.given - self.drained - self.wiped - held - sum(puddle.litres for puddle in self.puddles)

    def set_level(self, item: ObjectInstance, litres: float, liquid: str) -> None:
        """Changes how much a vessel holds, without bookkeeping, and what follows: AI2-THOR's states, mass and look."""
        state = item.state
        state.fillLitres = float(np.clip(litres, 0.0, item.type.volume_l))
        state.fillLiquid = liquid if state.fillLitres > 0.0 else ""
        state.isFilledWithLiquid = state.fillLitres >= FILLED_SHARE * item.type.volume_l > 0.0
        self._masses.update(item)
        self._appearance.update(item)

    def _add(self, item: ObjectInstance, litres: float, liquid: str) -> float:
        """Adds what there is room for; returns how much that was."""
        state = item.state
        room = max(item.type.volume_l - state.fillLitres, 0.0)
        added = min(litres, room)
        if added > 0.0:
            kind = liquid if added > state.fillLitres or not state.fillLiquid else state.fillLiquid
            self.set_level(item, state.fillLitres + added, kind)
        return added

    def give(self, item: ObjectInstance, litres: float, liquid: str) -> float:
        """Delivers liquid from outside into a vessel; returns how much went in."""
        before = item.state.fillLitres
        self._add(item, litres, liquid)
        added = item.state.fillLitres - before
        self.given += added
        return added

    def pour(self, source: ObjectInstance, target: ObjectInstance | None, litres: float) -> float:
        """Moves liquid from a vessel into another one; without a target, or beyond its capacity, it is spilled below it.

        Returns:
            Litres that came into the target.
        """
        before, liquid = source.state.fillLitres, source.state.fillLiquid
        if before <= 0.0 or litres <= 0.0:
            return 0.0
        self.set_level(source, before - litres, liquid)
        moved = before - source.state.fillLitres
        came = 0.0
        if target is not None:
            held = target.state.fillLitres
            self._add(target, moved, liquid)
            came = target.state.fillLitres - held
        if moved - came > _DROP_L:
            self._land(target if target is not None else source, moved - came, liquid)
        return came

    def spill(self, item: ObjectInstance, litres: float | None = None) -> float:
        """Lets a vessel run out, all of it by default, onto what is below; returns how much it lost."""
        before = item.state.fillLitres
        self.pour(item, None, before if litres is None else litres)
        return before - item.state.fillLitres

    def wipe(self, surface: str) -> float:
        """Takes up the puddles on a surface; returns the litres."""
        gone = [puddle for puddle in self.puddles if puddle.surface == surface]
        self.puddles = [puddle for puddle in self.puddles if puddle.surface != surface]
        litres = sum(puddle.litres for puddle in gone)
        self.wiped += litres
        self._show()
        return litres

    def _land(self, above: ObjectInstance, litres: float, liquid: str) -> None:
        """Liquid that falls from beside a vessel: into a basin below, or onto the surface below as a puddle."""
        start = self._scene.data.xpos[above.body_id] + self._scene.data.xmat[above.body_id].reshape(3, 3) @ (
            0.5 * (above.local_min + above.local_max)
        )
        surface, point = self._below(start, above)
        if surface is not None and surface.type.fillable and not surface.movable:
            litres -= self._add(surface, litres, liquid)
            self.drained += litres
            return
        name = "Floor" if surface is None else surface.object_id
        puddles = self.puddles
        near = [p for p in puddles if p.surface == name and float(np.hypot(*(np.subtract(p.position, point)[:2]))) < _MERGE_M]
        if not near and len(puddles) >= PUDDLES:
            near = sorted(puddles, key=lambda p: float(np.linalg.norm(np.subtract(p.position, point))))
        if near:
            index = puddles.index(near[0])
            kind = liquid if litres > near[0].litres else near[0].liquid
            puddles[index] = replace(near[0], litres=near[0].litres + litres, liquid=kind)
        else:
            puddles.append(Puddle(name, (float(point[0]), float(point[1]), float(point[2])), litres, liquid))
        self._show()

    def _below(self, start: NDArray[np.float64], above: ObjectInstance) -> tuple[ObjectInstance | None, NDArray[np.float64]]:
        """What furniture is below a point, and where; the floor when there is none."""
        model, data = self._scene.model, self._scene.data
        names = list(self._scene.objects)
        origin = start.copy()
        hit = np.zeros(1, dtype=np.int32)
        for _ in range(64):
            distance = mujoco.mj_ray(model, data, origin, np.array([0.0, 0.0, -1.0]), None, 1, above.body_id, hit)
            if distance < 0.0:
                break
            origin = origin - (0.0, 0.0, distance + 1e-4)
            owner = int(self._scene.object_of_geom[hit[0]])
            if owner >= 0 and not self._scene.objects[names[owner]].movable and model.geom_contype[hit[0]] > 0:
                return self._scene.objects[names[owner]], origin + (0.0, 0.0, 1e-4)
        return None, np.array([start[0], start[1], 0.0])

    def spout(self, source: ObjectInstance) -> NDArray[np.float64] | None:
        """(3,) world point below which a source's liquid falls, None for what has no spout."""
        for geom, part in self._scene.part_of_geom[source.object_id]:
            if "spout" in part.options:
                return self._scene.data.geom_xpos[geom] - (0.0, 0.0, part.size[2] / 2.0)
        return None

    def run_out(self, seconds: float) -> None:
        """Flow out of tilted vessels over some time: into the vessel below the rim, or onto the surface there."""
        for item in self._scene.objects.values():
            if item.movable and item.state.fillLitres > 0.0 and float(self._scene.data.xmat[item.body_id, 8]) < STEEP:
                self.pour(item, self.opening_below(self.rim(item), item), POUR_L_S * seconds)

    def rim(self, item: ObjectInstance, pose: NDArray[np.float64] | None = None) -> NDArray[np.float64]:
        """(3,) lowest point of a vessel's rim, where liquid leaves it; for its present pose or a (4, 4) other one."""
        pose = self._poses.pose(item.object_id) if pose is None else pose
        top = 0.5 * (item.local_min + item.local_max)
        top[2] = item.local_max[2]
        down = -pose[2, :3]
        length = float(np.hypot(down[0], down[1]))
        if length > 1e-6:
            top[:2] += down[:2] / length * opening_radius_m(item)
        return pose[:3, 3] + pose[:3, :3] @ top

    def opening_below(self, point: NDArray[np.float64], but: ObjectInstance | None = None) -> ObjectInstance | None:
        """The vessel whose opening is below a point, the highest one, else the basin; tipped and broken ones do not count."""
        best: tuple[tuple[bool, float], ObjectInstance] | None = None
        for item in self._scene.objects.values():
            if item is but or not item.type.fillable or item.state.isBroken or self._scene.data.xmat[item.body_id, 8] < 0.5:
                continue
            pose = self._poses.pose(item.object_id)
            local = pose[:3, :3].T @ (point - pose[:3, 3])
            middle, half = 0.5 * (item.local_min + item.local_max), 0.5 * (item.local_max - item.local_min)
            if item.movable:
                off = float(np.hypot(*(local - middle)[:2]))
                within = off <= opening_radius_m(item) + _BESIDE_M
            else:
                within = bool(np.all(np.abs((local - middle)[:2]) <= half[:2]))
            top = float(pose[2, 3] + item.local_max[2])
            rank = (item.movable, top)
            if within and top - 0.02 <= point[2] <= top + 0.6 and (best is None or rank > best[0]):
                best = (rank, item)
        return None if best is None else best[1]

    def flow(self, seconds: float) -> None:
        """Flow from taps and coffee machines over some time."""
        for source in self._scene.objects.values():
            if not source.state.isToggled:
                continue
            outlet = self.spout(source)
            if outlet is None:
                continue
            basin = self._scene.room.links.get(source.object_id)
            vessel = self.opening_below(outlet)
            if vessel is not None and (not vessel.movable or vessel.state.fillLitres >= vessel.type.volume_l):
                vessel = None
            if basin is None:
                if vessel is not None and self.give(vessel, COFFEE_L_S * seconds, "coffee") > 0.0:
                    vessel.state.temperature = max(vessel.state.temperature, _HOT_C)
                continue
            litres = TAP_L_S * seconds
            if vessel is not None:
                litres -= self.give(vessel, litres, "water")
            if litres > _DROP_L:
                poured = self.give(self._scene.objects[basin], litres, "water")
                self.given += litres - poured
                self.drained += litres - poured

    def _show(self) -> None:
        """Puts the scene's puddle geoms where liquid lies, as wide as a film of 1.5 mm, 3 to 30 cm in radius."""
        for index in range(PUDDLES):
            geom = int(self._scene.model.geom(f"puddle/{index}").id)
            if index >= len(self.puddles):
                self._appearance.hide(geom)
                continue
            puddle = self.puddles[index]
            radius = float(np.clip(np.sqrt(1e-3 * puddle.litres / (np.pi * _FILM_M)), 0.03, 0.3))
            self._appearance.show_disc(geom, np.add(puddle.position, (0.0, 0.0, 0.002)), radius, puddle.liquid)

    def metadata(self) -> list[dict[str, Any]]:
        """The puddles, for the scene's metadata."""
        return [
            {
                "surface": puddle.surface,
                "position": dict(zip("xyz", puddle.position, strict=True)),
                "litres": puddle.litres,
                "liquid": puddle.liquid,
            }
            for puddle in self.puddles
        ]


def opening_radius_m(item: ObjectInstance) -> float:
    """Radius of a vessel's opening, metres: half the short side of its box."""
    return 0.5 * float(np.min((item.local_max - item.local_min)[:2]))
