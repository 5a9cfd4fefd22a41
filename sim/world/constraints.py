"""Grasp constraints: they make an object follow the hand once contact justifies it.

Every arm has one weld (objects) and one ball joint (handles of doors and drawers). They are pointed at a body at run time by
writing `eq_obj2id` and `eq_data`, which MuJoCo reads at every step. A held body no longer touches the hands (a door: the hand
that holds it), which keeps the contact count and the internal forces small; after release it touches them again as soon as
nothing overlaps. Paper: grasps of DualTHOR, which need no contact there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import mujoco
import numpy as np
from numpy.typing import NDArray

from sim.scene.compiler import ARM_BITS, HELD_BITS, HELD_DOOR_BITS, LIMB_BIT, MOVABLE_BITS, OWN_BIT, STATIC_BITS

_SEPARATION_M = 0.001
#: Of a tree that has just moved.
_AWAKE = -(1 + mujoco.mjMINAWAKE)
#: Time constants with which a grasp takes up an error of the hand.
_FIRM_S = 0.01
_GENTLE_S = 0.036
#: Impedance of a weld; of one that steadies, and of both where two hands hold one thing: rigid ones would fight each other.
_RIGID = (0.99, 0.999, 0.001)
_SOFT = (0.9, 0.95, 0.001)
#: A weld that is off by more than this holds no longer.
_TORN_M = 0.05
_TORN_RAD = float(np.radians(30.0))


@dataclass(slots=True)
class GraspConstraints:
    """The constraints of both arms.

    Attributes:
        model, data: the running scene.
        hand_bodies: arm to the body that carries its grasp site.
        grasp_sites: arm to that site.
        released: (arm, body) pairs that may still overlap after a release.
    """

    model: mujoco.MjModel
    data: mujoco.MjData
    hand_bodies: dict[str, int]
    grasp_sites: dict[str, int]
    released: list[tuple[str, int]] = field(default_factory=list)
    _hand_geoms: dict[str, NDArray[np.int64]] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        model = self.model
        self._hand_geoms = {}
        for arm, hand in self.hand_bodies.items():
            bodies = [body for body in range(model.nbody) if self._below(body, hand)]
            inside = np.isin(model.geom_bodyid, bodies) & (model.geom_contype != 0)
            self._hand_geoms[arm] = np.flatnonzero(inside)
            chain = [body for body in range(model.nbody) if self._below(hand, body)]
            limb = inside | (np.isin(model.geom_bodyid, chain) & (model.geom_contype == LIMB_BIT))
            model.geom_contype[limb] |= ARM_BITS[arm]
        self._meet_the_body()

    def _meet_the_body(self) -> None:
        """Lets what is held meet the robot's trunk, head, upper arms and legs."""
        model = self.model
        fore = [body for body in range(model.nbody) if np.any(model.geom_contype[model.geom_bodyid == body] & LIMB_BIT)]
        roots = {int(model.body_rootid[hand]) for hand in self.hand_bodies.values()}
        for body in range(model.nbody):
            if int(model.body_rootid[body]) in roots and not any(self._below(body, limb) for limb in fore):
                own = (model.geom_bodyid == body) & (model.geom_type != int(mujoco.mjtGeom.mjGEOM_MESH))
                model.geom_contype[own] = OWN_BIT
                model.body_contype[body] |= OWN_BIT
            elif model.body_contype[body] & MOVABLE_BITS[0]:
                model.body_conaffinity[body] |= OWN_BIT

    def _below(self, body: int, ancestor: int) -> bool:
        while body > 0:
            if body == ancestor:
                return True
            body = int(self.model.body_parentid[body])
        return False

    def hand_geoms(self, arm: str) -> NDArray[np.int64]:
        """Ids of the geoms of a hand and its fingers that take part in contacts."""
        return self._hand_geoms[arm]

    def holds(self, arm: str) -> bool:
        """Whether the arm's constraint is active."""
        return any(self.data.eq_active[self._eq(arm, kind)] for kind in ("weld", "ball"))

    def _eq(self, arm: str, kind: str) -> int:
        return int(self.model.equality(f"{arm}_{kind}").id)

    def held_body(self, arm: str) -> int | None:
        """The body that an arm holds, and None when it holds none."""
        active = [eq for eq in (self._eq(arm, "weld"), self._eq(arm, "ball")) if self.data.eq_active[eq]]
        return int(self.model.eq_obj2id[active[0]]) if active else None

    def attach(
        self,
        arm: str,
        body: int,
        *,
        rigid: bool,
        lids: Sequence[int] = (),
        point: NDArray[np.float64] | None = None,
        gentle: bool = False,
        steady: bool = False,
    ) -> None:
        """Ties a body to a hand in their present relative pose.

        Args:
            arm: left or right.
            body: MuJoCo body id.
            rigid: weld, else a ball joint (a door turns about its hinge, not with the hand).
            lids: bodies hinged to it that are carried along: they do not touch the hands either.
            point: (3,) where the ball joint is, world frame; the grasp site when None.
            gentle: whether the fingers give: a lid would drag a light object along else, when the hand errs by millimetres.
            steady: whether it stays on what carries it, where a rigid weld would tilt it as the hand sways.
        """
        model, data, hand = self.model, self.data, self.hand_bodies[arm]
        eq = self._eq(arm, "weld" if rigid else "ball")
        r1, r2 = data.xmat[hand].reshape(3, 3), data.xmat[body].reshape(3, 3)
        model.eq_obj1id[eq], model.eq_obj2id[eq] = hand, body
        values = np.zeros(model.eq_data.shape[1])
        if rigid:
            inverse, relative = np.zeros(4), np.zeros(4)
            mujoco.mju_negQuat(inverse, data.xquat[hand])
            mujoco.mju_mulQuat(relative, inverse, data.xquat[body])
            values[3:6] = r1.T @ (data.xpos[body] - data.xpos[hand])
            values[6:10] = relative
            values[10] = 1.0
        else:
            if point is None:
                point = data.site_xpos[self.grasp_sites[arm]]
            values[0:3] = r1.T @ (point - data.xpos[hand])
            values[3:6] = r2.T @ (point - data.xpos[body])
        model.eq_data[eq] = values
        model.eq_solref[eq, 0] = _GENTLE_S if gentle else _FIRM_S
        model.eq_solimp[eq, :3] = _RIGID if rigid and not steady else _SOFT
        for other in self.hand_bodies:
            if other != arm and rigid and self.held_body(other) == body:
                model.eq_solimp[[eq, self._eq(other, "weld")], :3] = _SOFT
        data.eq_active[eq] = 1
        others = sum(bit for other, bit in ARM_BITS.items() if other != arm)
        for moved in (body, *lids):
            self._set_bits(moved, HELD_BITS if rigid else (HELD_DOOR_BITS[0], others))
        self.released = [pair for pair in self.released if pair[1] not in (body, *lids)]

    def torn(self, arm: str) -> bool:
        """Whether what an arm holds rigidly is no longer where it was taken."""
        eq = self._eq(arm, "weld")
        if not self.data.eq_active[eq]:
            return False
        model, data = self.model, self.data
        hand, body, values = int(model.eq_obj1id[eq]), int(model.eq_obj2id[eq]), model.eq_data[eq]
        place, turn = np.zeros(3), np.zeros(4)
        mujoco.mju_rotVecQuat(place, values[3:6], data.xquat[hand])
        mujoco.mju_mulQuat(turn, data.xquat[hand], values[6:10])
        error_m = float(np.linalg.norm(data.xpos[hand] + place - data.xpos[body]))
        half = min(1.0, abs(float(turn @ data.xquat[body])))
        return error_m > _TORN_M or 2.0 * float(np.arccos(half)) > _TORN_RAD

    def give_way(self, lid: int, below: int | None) -> None:
        """Ends the contacts of a lid, and of the free body below it, with both hands."""
        self._set_bits(lid, HELD_DOOR_BITS)
        if below is not None:
            self._set_bits(below, HELD_BITS)

    def detach(self, arm: str, bodies: Sequence[int], *, last: bool) -> None:
        """Releases a body and the lids hinged to it; `last` means that no other hand still holds it."""
        for kind in ("weld", "ball"):
            self.data.eq_active[self._eq(arm, kind)] = 0
        for body in bodies:  # what a still hand held has long been slow enough to sleep, and would do so in the air
            self.data.tree_asleep[self.model.body_treeid[body]] = _AWAKE
        if last:
            self.released += [(arm, body) for body in bodies]

    def settle_released(self, movable: dict[int, bool]) -> None:
        """Restores contacts between released bodies and the hands once they are clear of both."""
        waiting: list[tuple[str, int]] = []
        for arm, body in self.released:
            if self._clear(body):
                self._set_bits(body, MOVABLE_BITS if movable[body] else STATIC_BITS)
            else:
                waiting.append((arm, body))
        self.released = waiting

    def _clear(self, body: int) -> bool:
        model, data = self.model, self.data
        own = [g for g in np.flatnonzero(model.geom_bodyid == body) if model.geom_contype[g] != 0]
        for geoms in self._hand_geoms.values():
            near = [g for g in geoms if np.linalg.norm(data.geom_xpos[g] - data.xpos[body]) < 1.5]
            for g in near:
                for other in own:
                    if mujoco.mj_geomDistance(model, data, int(g), int(other), 0.01, None) < _SEPARATION_M:
                        return False
        return True

    def _set_bits(self, body: int, bits: tuple[int, int]) -> None:
        mask = (self.model.geom_bodyid == body) & (self.model.geom_contype != 0)
        self.model.geom_contype[mask], self.model.geom_conaffinity[mask] = bits
