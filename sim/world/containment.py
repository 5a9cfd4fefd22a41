"""Containment: what is on or in what, total masses, and free space on surfaces."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np
from numpy.typing import NDArray

from sim.world.placement import REACH_BAND_M, above_surfaces, find_free_spot
from sim.world.scene_state import SceneState


class Containment:
    """Receptacles and their contents, read from the objects' poses.

    Args:
        scene: the running scene.
    """

    def __init__(self, scene: SceneState) -> None:
        self._scene = scene

    def all_parents(self) -> dict[str, tuple[str, ...]]:
        """Receptacles of every movable object, the direct one first, then what carries that one."""
        found = above_surfaces(self._scene.data, self._scene.objects)
        direct = {name: above[0] for name, above in found.items() if above}
        chains: dict[str, tuple[str, ...]] = {}
        for name in direct:
            chain: list[str] = []
            current = direct.get(name)
            while current is not None and current not in chain:
                chain.append(current)
                current = direct.get(current)
            chains[name] = tuple(chain)
        return chains

    def parents(self, object_id: str) -> tuple[str, ...]:
        """Receptacles of one object, the direct one first."""
        self._scene.object(object_id)
        return self.all_parents().get(object_id, ())

    def contents(self, object_id: str) -> tuple[str, ...]:
        """Ids of what rests on or in an object, indirectly too."""
        self._scene.object(object_id)
        return tuple(name for name, above in self.all_parents().items() if object_id in above)

    def free_spot(
        self,
        receptacle_id: str,
        footprint_radius_m: float,
        *,
        height_m: float = 0.1,
        near: NDArray[np.float64] | None = None,
        rng: np.random.Generator | None = None,
        gap_m: float = 0.03,
        ignore: Iterable[str] = (),
        band_m: float = REACH_BAND_M,
        through_doors: bool = False,
    ) -> NDArray[np.float64] | None:
        """A (3,) world point where an object can be put, None when there is no room; see `find_free_spot`."""
        return find_free_spot(
            self._scene.data, self._scene.objects, self._scene.object(receptacle_id), footprint_radius_m,
            height_m=height_m, near=near, rng=rng, gap_m=gap_m, ignore=ignore, band_m=band_m, through_doors=through_doors,
        )  # fmt: skip

    def masses_kg(self, parents: Mapping[str, tuple[str, ...]]) -> dict[str, float]:
        """Masses of all objects with liquid and contents.

        Args:
            parents: of `all_parents`.
        """
        own = {name: obj.laden_mass_kg for name, obj in self._scene.objects.items()}
        masses = dict(own)
        for name, carriers in parents.items():
            for carrier in carriers:
                masses[carrier] += own[name]
        return masses

    def total_mass_kg(self, object_id: str) -> float:
        """Mass with liquid and contents."""
        self._scene.object(object_id)
        return self.masses_kg(self.all_parents())[object_id]

    def needs_two_hands(self, object_id: str) -> bool:
        """Whether its type or its present weight asks for both hands."""
        limit = self._scene.the_robot().max_load_kg(1)
        return self._scene.object(object_id).type.two_handed or self.total_mass_kg(object_id) > limit
