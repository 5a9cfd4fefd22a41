"""Where the robot can stand and what is in comfortable reach from there."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from interface.bodies import Arm
from robots.build_solver import RobotKit
from sim.scene.objects import ObjectInstance
from sim.skills.body.posture import Posture
from sim.skills.navigation import NavigationMap
from sim.skills.obstacles import navigation_map
from sim.skills.reach_map import reach_maps
from sim.world.placement import OVERHANG_SHARE
from sim.world.world import World

Array = NDArray[np.float64]

#: Share of the shoulders' way forward in a lean by which the robot stands farther from things. Chosen by hand.
_LEANING: Final = 0.6


class Workspace:
    """Floor and surfaces around one robot, for the posture that is commanded or assumed."""

    def __init__(self, world: World, kit: RobotKit, posture: Posture) -> None:
        self._world, self._kit, self._posture = world, kit, posture

    def navigation(self) -> NavigationMap:
        """Free space for the base, as the room is now; a robot that leans forward keeps farther away."""
        return navigation_map(self._world, self._kit.spec.footprint_radius_m + self._leaning_m())

    def comfortable_distance_m(self) -> tuple[float, float]:
        """Horizontal distances between pelvis and object at which the arms work best: 55 to 80 % of the stretched arm."""
        reach, leaning = reach_maps(self._kit)["left"].reach_m, self._leaning_m()
        return 0.55 * reach + leaning, 0.8 * reach + leaning

    def free_spots(self, obj: ObjectInstance, receptacle: ObjectInstance, arm: Arm | None, count: int = 4) -> list[Array]:
        """Free spots (3,) on a receptacle for an object: those below its spout, or that the arm reaches most easily, first."""
        spout = self._world.liquids.spout(receptacle)
        easy = self._easy_point(arm) if spout is None else spout
        spots: list[Array] = []
        # What two hands carry is held with its long side across: its narrow side may stand a little over the edge.
        narrow = 0.5 * OVERHANG_SHARE * float(np.min(obj.local_max[:2] - obj.local_min[:2]))
        radius = obj.footprint_radius_m if arm is not None else narrow
        for gap in (0.04, 0.01):
            for dx, dy in (
                *((0.0, 0.0), *(((0.04, 0.0), (0.0, 0.04), (0.0, -0.04), (-0.04, 0.0)) if spout is not None else ())),
                (0.0, 0.12),
                (0.0, -0.12),
                (0.1, 0.0),
                (-0.1, 0.0),
                (0.0, 0.25),
                (0.0, -0.25),
                (0.15, 0.0),
            ):
                near = easy[:2] + self._posture.turn_to_world(np.array([dx, dy, 0.0]))[:2]
                spot = self._world.containment.free_spot(
                    receptacle.object_id, radius, height_m=obj.height_m, near=near, gap_m=gap,
                    ignore=(obj.object_id,), band_m=10.0,
                )  # fmt: skip
                if spot is not None and all(float(np.linalg.norm(spot - known)) > 0.03 for known in spots):
                    spots.append(spot)
                if len(spots) >= count:
                    return spots
            if spots:
                return spots
        return spots

    def _easy_point(self, arm: Arm | None) -> Array:
        """World point before the shoulder that the arm reaches most easily; between the shoulders for both arms."""
        low, high = self.comfortable_distance_m()
        side = 0.0 if arm is None else 0.6 if arm is Arm.LEFT else -0.6
        base = self._posture.stance()
        local = np.array([0.5 * (low + high), side * abs(float(reach_maps(self._kit)["left"].shoulder[1])), 0.0])
        return self._posture.turn_to_world(local) + (base.x, base.y, self._posture.pelvis_height_m)

    def _leaning_m(self) -> float:
        """By how much the trunk's lean brings the hands forward, the most of it, rounded so that maps are shared."""
        shoulder = reach_maps(self._kit)["left"].shoulder
        ahead = float((self._posture.lean(self._posture.pelvis_height_m) @ shoulder)[0] - shoulder[0])
        return round(_LEANING * max(ahead, 0.0), 2)
