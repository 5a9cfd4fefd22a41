"""Visual appearance of states: lit lamps and screens, liquid levels, puddles, dirt, browning, breakage."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from sim.scene.catalogue import Part
from sim.scene.objects import ObjectInstance
from sim.world.scene_state import SceneState

_WATER: Final = (0.30, 0.55, 0.95, 0.9)


class Appearance:
    """Colours, and places of the geoms that only show something.

    Args:
        scene: the running scene, as it was compiled.
    """

    def __init__(self, scene: SceneState) -> None:
        self._scene = scene
        self._geom_pos, self._geom_size = scene.model.geom_pos.copy(), scene.model.geom_size.copy()

    def update(self, item: ObjectInstance) -> None:
        """Updates the appearance of an object from its state."""
        model, state, colors = self._scene.model, item.state, self._scene.catalogue.colors
        for geom, part in self._scene.part_of_geom[item.object_id]:
            rgba = np.array(colors[part.color], dtype=float)
            if "liquid" in part.options:
                rgba = self.color_of(state.fillLiquid)
                if state.fillLitres <= 0.0:
                    rgba[3] = 0.0
                self._show_level(item, geom, part)
            elif part.options & {"whole", "slice"} and state.isSliced != ("slice" in part.options):
                rgba[3] = 0.0
            elif "glow" in part.options:
                if state.isToggled:
                    rgba = np.array(colors.get(f"{part.color}_on", colors[part.color]), dtype=float)
                elif "hidden" in part.options:
                    rgba[3] = 0.0
                material = int(model.geom_matid[geom])
                if material >= 0:
                    model.mat_emission[material] = 0.7 if state.isToggled else 0.0
            elif state.isBroken:
                rgba[:3] = 0.35 * rgba[:3]
            else:
                if state.isCooked:
                    rgba[:3] *= (0.55, 0.42, 0.30)
                if state.isDirty:
                    rgba[:3] = 0.55 * rgba[:3] + 0.45 * np.array([0.30, 0.22, 0.12])
            model.geom_rgba[geom] = rgba

    def color_of(self, liquid: str) -> NDArray[np.float64]:
        """(4,) colour of a liquid."""
        names = {"coffee": "coffee", "wine": "maroon"}
        return np.array(self._scene.catalogue.colors[names[liquid]] if liquid in names else _WATER)

    def show_disc(self, geom: int, position: NDArray[np.float64], radius_m: float, liquid: str) -> None:
        """Puts a puddle's geom somewhere on the ground (3,), as wide as asked."""
        model = self._scene.model
        self._move_geom(geom, position)
        model.geom_size[geom, 0] = model.geom_rbound[geom] = radius_m
        model.geom_rgba[geom] = self.color_of(liquid)

    def hide(self, geom: int) -> None:
        """Makes a geom invisible."""
        self._scene.model.geom_rgba[geom, 3] = 0.0

    def _show_level(self, item: ObjectInstance, geom: int, part: Part) -> None:
        """Puts the visible liquid of a vessel at its level: higher in a hollow vessel, wider on a solid one."""
        model, full = self._scene.model, item.type.volume_l
        share = item.state.fillLitres / full if full > 0.0 else 0.0
        position, size = self._geom_pos[geom], self._geom_size[geom]
        if any(other.wall_m > 0.0 for other in item.type.parts):
            floor = max(other.wall_m for other in item.type.parts) + part.size[2] / 2.0
            height = min(floor, position[2]) + share * (position[2] - min(floor, position[2]))
            if height != model.geom_pos[geom, 2]:
                self._move_geom(geom, np.array([position[0], position[1], height]))
        else:
            model.geom_size[geom, 0] = size[0] * float(np.sqrt(0.3 + 0.7 * share))

    def _move_geom(self, geom: int, position: NDArray[np.float64]) -> None:
        """Moves a geom within its body; MuJoCo does not compute again what is fixed to the world, so that is done here."""
        model, data = self._scene.model, self._scene.data
        body = int(model.geom_bodyid[geom])
        model.geom_pos[geom] = position
        data.geom_xpos[geom] = data.xpos[body] + data.xmat[body].reshape(3, 3) @ position
