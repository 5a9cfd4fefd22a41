"""Breakage by impact: a breakable object that stops from a fall of 0.35 m within one recorder frame breaks."""

from __future__ import annotations

from typing import Final

from sim.world.poses import ObjectPoses
from sim.world.scene_state import SceneState
from sim.world.states import ObjectStates

BREAK_SPEED_M_S: Final = 2.6


class Impacts:
    """Watches the speeds of breakable objects.

    Args:
        scene: the running scene.
        poses: their speeds.
        states: where breakage is recorded.

    Attributes:
        speeds_m_s: speed of each breakable object one frame ago.
    """

    def __init__(self, scene: SceneState, poses: ObjectPoses, states: ObjectStates) -> None:
        self._scene, self._poses, self._states = scene, poses, states
        self.speeds_m_s: dict[str, float] = {}

    def step(self) -> None:
        """Breaks objects that were stopped abruptly since the last frame."""
        before = self.speeds_m_s
        for name, item in self._scene.objects.items():
            if not item.movable or not item.type.has("breakable") or item.state.isBroken or item.held_by:
                continue
            if before.get(name, 0.0) > BREAK_SPEED_M_S and self._poses.speed_m_s(name) < 0.5 * before[name]:
                self._states.set_state(name, "isBroken", True)
        breakable = (name for name, item in self._scene.objects.items() if item.type.has("breakable"))
        self.speeds_m_s = {name: self._poses.speed_m_s(name) for name in breakable}
