"""Masses in the physics: an object weighs what it is made of and the liquid in it."""

from __future__ import annotations

from sim.scene.objects import ObjectInstance
from sim.world.scene_state import SceneState


class Masses:
    """Body masses and inertias of MuJoCo's model.

    Args:
        scene: the running scene, as it was compiled.
    """

    def __init__(self, scene: SceneState) -> None:
        self._scene = scene
        self._mass, self._inertia = scene.model.body_mass.copy(), scene.model.body_inertia.copy()

    def update(self, item: ObjectInstance) -> None:
        """Brings an object's bodies in line with its mass and its liquid; furniture stays as it is."""
        if not item.movable:
            return
        model, body, lids = self._scene.model, item.body_id, list(item.body_ids[1:])
        total, moving = item.laden_mass_kg, float(self._mass[lids].sum())
        # what it holds weighs on the object itself: its door or lid stays as heavy as it is, unless all is lighter than that
        share = min(1.0, 0.5 * total / moving) if moving > 0.0 else 1.0
        factor = (total - share * moving) / float(self._mass[body])
        for index, by in ((body, factor), *((lid, share) for lid in lids)):
            model.body_mass[index] = self._mass[index] * by
            model.body_inertia[index] = self._inertia[index] * by
        model.body_subtreemass[body] = total
