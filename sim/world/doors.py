"""Doors, drawers and lids: how far each stands open, and springs that shut some of them."""

from __future__ import annotations

from typing import Final

import mujoco
import numpy as np

from sim.scene.objects import ObjectInstance
from sim.world.scene_state import SceneState, WorldError

#: What a self-closing door or drawer is shut with, and how long its damper lets that take.
_SPRING_TORQUE_N_M: Final = 2.0
_SPRING_FORCE_N: Final = 6.0
_CLOSING_S: Final = 1.2


class Doors:
    """Openness of every object that opens.

    Args:
        scene: the running scene.
    """

    def __init__(self, scene: SceneState) -> None:
        self._scene = scene

    def update(self) -> None:
        """Updates every object's openness from its joints."""
        qpos = self._scene.data.qpos
        for item in self._scene.objects.values():
            if item.moving:
                item.openness = max(
                    float(np.clip((qpos[part.qpos_adr] - part.range[0]) / (part.range[1] - part.range[0]), 0.0, 1.0))
                    for part in item.moving
                )

    def put(self, item: ObjectInstance, openness: float) -> None:
        """Sets all doors of an object to a share of their range at once, for the start of a scene.

        Raises:
            WorldError: when it has none.
        """
        if not item.moving:
            raise WorldError(f"{item.object_id} has no door, drawer or lid, openness {openness!r} is not possible")
        for part in item.moving:
            self._scene.data.qpos[part.qpos_adr] = part.range[0] + openness * (part.range[1] - part.range[0])
        item.openness = openness

    def set_self_closing(self, item: ObjectInstance, value: bool) -> None:
        """Adds closing springs with dampers to an object's doors or drawers, or removes them.

        Raises:
            WorldError: when it has no door or drawer.
        """
        if value and (not item.moving or any(part.spec.is_lid for part in item.moving)):
            raise WorldError(f"{item.object_id} has no door or drawer, selfClosing=True is not possible")
        model = self._scene.model
        item.self_closing = value
        for part in item.moving:
            hinge = int(model.jnt_type[part.joint_id]) == int(mujoco.mjtJoint.mjJNT_HINGE)
            shut, travel = _SPRING_TORQUE_N_M if hinge else _SPRING_FORCE_N, part.range[1] - part.range[0]
            model.jnt_stiffness[part.joint_id] = 0.5 * shut / travel if value else 0.0
            model.qpos_spring[part.qpos_adr] = part.range[0] - 2.0 * travel
            if value:
                model.dof_damping[part.dof_adr] = _CLOSING_S * 1.25 * shut / travel
