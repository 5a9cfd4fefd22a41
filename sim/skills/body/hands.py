"""Hands: commanded opening and held objects."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from interface.bodies import Arm
from robots.spec import RobotSpec
from sim.skills.body.joints import JointMap
from sim.skills.runner import CONTROL_DT_S, Skill
from sim.world.world import World

Array = NDArray[np.float64]

#: Time that a hand takes to open or close, seconds. Chosen by hand.
HAND_SECONDS: Final = 0.35


class Hands:
    """Both hands of one robot."""

    def __init__(self, world: World, joints: JointMap, spec: RobotSpec) -> None:
        self._world, self._joints, self._spec = world, joints, spec

    @property
    def held(self) -> dict[Arm, str | None]:
        """What each hand holds."""
        found: dict[Arm, str | None] = dict.fromkeys(Arm)
        for name, obj in self._world.objects.items():
            for arm in obj.held_by:
                found[Arm(arm)] = name
        return found

    def place(self, object_id: str) -> Array:
        """(3,) centre of an object, world frame."""
        return self._world.poses.center(object_id)

    @property
    def lifted(self) -> str | None:
        """The object that both hands hold together."""
        return next((name for name, obj in self._world.objects.items() if len(obj.held_by) == 2), None)

    def at_furniture(self, arm: Arm | None = None) -> bool:
        """Whether a hand, any or the given one, holds a door or drawer, so that the base must not move."""
        held = self.held.values() if arm is None else (self.held[arm],)
        return any(name is not None and not self._world.objects[name].movable for name in held)

    def command(self, arm: Arm, opening: float) -> None:
        """Sets the hand between closed (0) and open (1)."""
        spec = self._spec.arms[arm.value]
        closed, opened = np.asarray(spec.hand_closed), np.asarray(spec.hand_open)
        self._world.data.ctrl[self._joints.hands[arm]] = closed + opening * (opened - closed)

    def opening(self, arm: Arm) -> float:
        """Commanded opening, 0 closed to 1 open."""
        spec = self._spec.arms[arm.value]
        closed, opened = np.asarray(spec.hand_closed), np.asarray(spec.hand_open)
        span = opened - closed
        used = np.abs(span) > 1e-6
        return float(np.mean((self._target(arm) - closed)[used] / span[used]))

    def move(self, arm: Arm, opening: float, seconds: float = HAND_SECONDS) -> Skill:
        """Opens or closes the hand at a constant rate."""
        start = self.opening(arm)
        if abs(start - opening) < 0.02:
            return
        steps = max(1, round(seconds / CONTROL_DT_S))
        for k in range(1, steps + 1):
            self.command(arm, start + (opening - start) * k / steps)
            yield

    def _target(self, arm: Arm) -> Array:
        """Commanded hand joints."""
        return self._world.data.ctrl[self._joints.hands[arm]].copy()
