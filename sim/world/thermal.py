"""Heat and cold: temperatures approach those of what objects lie in or on, and food cooks. An open door lets both out.

A temperature approaches that of its surroundings exponentially; what is cooked stays so. Paper: state changes of DualTHOR.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from sim.scene.objects import ROOM_TEMPERATURE_C
from sim.world.containment import Containment
from sim.world.scene_state import SceneState
from sim.world.states import ObjectStates

_HOT_C: Final = 95.0
_COLD_C: Final = 4.0
_COOKED_C: Final = 65.0
#: Time constants, seconds: on a heat source or in a closed one, in a closed cold one, in the room.
_HEATING_S: Final = 8.0
_COOLING_S: Final = 20.0
_ROOM_S: Final = 90.0


class Thermal:
    """Temperatures of the movable objects.

    Args:
        scene: the running scene.
        containment: what lies in or on what.
        states: where cooking is recorded.
    """

    def __init__(self, scene: SceneState, containment: Containment, states: ObjectStates) -> None:
        self._scene, self._containment, self._states = scene, containment, states

    def settle(self) -> None:
        """Cools whatever starts inside a cold source."""
        for item in self._scene.objects.values():
            if item.type.has("cold_source"):
                for name in self._containment.contents(item.object_id):
                    self._scene.objects[name].state.temperature = _COLD_C

    def step(self, seconds: float) -> None:
        """Advances temperatures and cooking."""
        objects = self._scene.objects
        active = any(item.state.isToggled for item in objects.values())
        cold = any(item.type.has("cold_source") for item in objects.values())
        settled = all(abs(item.state.temperature - ROOM_TEMPERATURE_C) < 0.5 for item in objects.values())
        if not active and settled and not cold:
            return
        for name, above in self._containment.all_parents().items():
            item = objects[name]
            target_c, time_constant_s = ROOM_TEMPERATURE_C, _ROOM_S
            for parent in (objects[p] for p in above):
                if parent.type.has("heat_source") and parent.state.isToggled and not (parent.moving and parent.is_open):
                    target_c, time_constant_s = _HOT_C, _HEATING_S
                elif parent.type.has("cold_source") and not parent.is_open:
                    target_c, time_constant_s = _COLD_C, _COOLING_S
            state = item.state
            state.temperature += (target_c - state.temperature) * (1.0 - float(np.exp(-seconds / time_constant_s)))
            if item.type.has("cookable") and state.temperature > _COOKED_C and not state.isCooked:
                self._states.set_state(name, "isCooked", True)
