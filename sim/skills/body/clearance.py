"""Collision queries for arm postures, evaluated on a copy of the simulator's state: nothing moves in the world.

The hand's distance to an object is measured in the world itself, because the grasp depends on it.
"""

from __future__ import annotations

import copy
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Final

import mujoco
import numpy as np
from numpy.typing import NDArray

from interface.bodies import Arm
from robots.build_solver import RobotKit
from sim.scene.compiler import LIMB_BIT, OWN_BIT
from sim.scene.objects import MovingPart, ObjectInstance
from sim.skills.body.joints import JointMap
from sim.skills.body.posture import Posture
from sim.world.world import World

Array = NDArray[np.float64]

#: Penetration that still counts as touching only.
TOUCH_M: Final = 0.009
#: How much deeper than anything else what is held may be in the robot's own body on the way: the arm yields so far.
_YIELDS_M: Final = 0.02
#: Distance beyond which finger gaps are not measured.
_FAR_M: Final = 0.2


@dataclass(frozen=True, slots=True)
class _Cargo:
    """A held object that moves with the hand: pose in the grasp site's frame, address of its free joint, its geoms."""

    site: int
    qpos_adr: int
    offset: Array
    turn: Array
    geoms: frozenset[int]

    def follow(self, model: mujoco.MjModel, data: mujoco.MjData) -> None:
        """Moves the held object in a copy of the state to where the hand carries it."""
        rotation = data.site_xmat[self.site].reshape(3, 3)
        data.qpos[self.qpos_adr : self.qpos_adr + 3] = data.site_xpos[self.site] + rotation @ self.offset
        quaternion = np.empty(4)
        mujoco.mju_mat2Quat(quaternion, (rotation @ self.turn).ravel())
        data.qpos[self.qpos_adr + 3 : self.qpos_adr + 7] = quaternion
        mujoco.mj_kinematics(model, data)


@dataclass(frozen=True, slots=True)
class AtDoor:
    """An arm beside a door or drawer.

    Attributes:
        gap_m: signed distance between forearm or hand and the part.
        depth_m: deepest penetration of the arm into anything else.
        bones: (3, 3) shoulder, elbow and grasp site, world frame.
        hand: (N, 3) centres of the hand's geoms, world frame.
    """

    gap_m: float
    depth_m: float
    bones: Array
    hand: Array


class ClearanceProbe:
    """Collision queries for arm postures."""

    def __init__(self, world: World, joints: JointMap, kit: RobotKit, posture: Posture) -> None:
        self._world, self._joints, self._kit, self._posture = world, joints, kit, posture
        self._scratch = mujoco.MjData(world.model)
        model = world.model
        self._geoms = {arm: _limb_geoms(model, kit.spec.arms[arm.value].joints[-2]) for arm in Arm}
        self._limbs = {arm: sorted(_limb_geoms(model, kit.spec.arms[arm.value].joints[0])) for arm in Arm}
        self._hands = {arm: np.array([geom for geom in self._limbs[arm] if not _is_forearm(model, geom)]) for arm in Arm}
        self._base_adr = [int(model.joint(name).qposadr[0]) for name in ("base_x", "base_y", "base_yaw")]
        self._waist_adr = [int(model.joint(name).qposadr[0]) for name in kit.spec.waist_joints]
        self._bones = {
            arm: [int(model.body(kit.spec.key_bodies[f"{arm.value}_{name}"]).id) for name in ("shoulder", "elbow")]
            for arm in Arm
        }
        self._height_adr = [int(model.joint(name).qposadr[0]) for name in ("base_z", "base_pitch")]
        self._couplings = [
            (
                int(model.jnt_qposadr[model.eq_obj1id[e]]),
                int(model.jnt_qposadr[model.eq_obj2id[e]]),
                model.eq_data[e, 4::-1].copy(),
            )
            for e in range(model.neq)
            if int(model.eq_type[e]) == int(mujoco.mjtEq.mjEQ_JOINT) and model.eq_obj2id[e] >= 0
        ]
        self._groups = {
            arm: tuple(
                np.array([int(model.geom(name).id) for name in group]) for group in kit.spec.arms[arm.value].finger_groups
            )
            for arm in Arm
        }

    def under(self, posture: Posture) -> ClearanceProbe:
        """This probe for another posture."""
        there = copy.copy(self)
        there._posture = posture
        return there

    def _shape_hand(self, arm: Arm, opening: float) -> None:
        """Puts the fingers of the copy where a hand of that opening has them, coupled joints included."""
        model, qpos = self._world.model, self._scratch.qpos
        spec = self._kit.spec.arms[arm.value]
        for name, opened, closed in zip(spec.hand_joints, spec.hand_open, spec.hand_closed, strict=True):
            qpos[model.joint(name).qposadr[0]] = closed + opening * (opened - closed)
        for follower, leader, coefficients in self._couplings:
            qpos[follower] = np.polyval(coefficients, qpos[leader])

    def depths_m(
        self,
        arm: Arm,
        postures: Iterable[Array],
        ignore: Iterable[str | int] = (),
        opening: float | None = None,
        limit_m: float = np.inf,
        relief: Array | None = None,
    ) -> Array:
        """Deepest penetration of forearm and hand into furniture or objects for each arm posture, other joints as they are.

        Args:
            arm: which one.
            postures: (A,) arm joints each.
            ignore: ids of objects, or numbers of geoms, that may be touched; whatever is held is ignored too.
            opening: opening of the hand, None as it is.
            limit_m: the rest of the postures is left out after the first one deeper than this.
            relief: per posture, the share of the first one's depth that does not count towards the limit.
        """
        world, scratch, model = self._world, self._scratch, self._world.model
        allowed = {geom for geom in ignore if isinstance(geom, int)}
        for name, obj in world.objects.items():
            mine = arm.value in obj.held_by
            if name in ignore or mine or (obj.held_by and obj.movable):  # what the other hand holds open is in the way
                allowed.update(map(int, obj.geom_ids))
        self._copy_state()
        if opening is not None:
            self._shape_hand(arm, opening)
        mine = set(self._geoms[arm])
        cargo = self._cargo(arm)
        if cargo is not None:
            mine.update(cargo.geoms)
        touching = np.zeros(model.ngeom, dtype=bool)
        touching[list(mine)] = True
        barred = np.ones(model.ngeom, dtype=bool)
        barred[list(allowed)] = False
        depths: list[float] = []
        for posture in postures:
            scratch.qpos[self._joints.arm_positions[arm]] = posture
            mujoco.mj_kinematics(model, scratch)
            if cargo is not None:
                cargo.follow(model, scratch)
            mujoco.mj_collision(model, scratch)
            a, b = scratch.contact.geom[: scratch.ncon].T
            other = np.where(touching[a], b, a)
            counts = (touching[a] != touching[b]) & barred[other]
            depth_m = -scratch.contact.dist[: scratch.ncon] - _YIELDS_M * (model.geom_contype[other] == OWN_BIT)
            depths.append(float(np.max(depth_m[counts], initial=0.0)))
            if depths[-1] - (0.0 if relief is None else depths[0] * relief[len(depths) - 1]) > limit_m:
                break
        return np.array(depths)

    def _copy_state(self) -> None:
        """Copies the world's state and applies the assumed stance and pelvis height."""
        qpos, assumed = self._scratch.qpos, self._posture.hypothesis
        qpos[:] = self._world.data.qpos
        height, stance = assumed.pelvis_height_m, assumed.stance
        if height is not None:
            qpos[self._height_adr] = height, self._kit.crouches.pitch(height)
        if stance is not None:
            qpos[self._base_adr] = stance.x, stance.y, stance.yaw_rad

    def against_door(self, arm: Arm, posture: Array, part: MovingPart, position: float, fist: bool = True) -> AtDoor:
        """Clearance of an arm, with its fist closed or as it is, to a door or drawer at a given joint position."""
        world, scratch, model = self._world, self._scratch, self._world.model
        self._copy_state()
        base = self._posture.stance()
        scratch.qpos[self._base_adr] = base.x, base.y, base.yaw_rad
        scratch.qpos[self._waist_adr] = world.data.ctrl[self._joints.waist]  # it sways for a while after a walk
        if fist:
            self._shape_hand(arm, 0.0)
        scratch.qpos[self._joints.arm_positions[arm]] = posture
        scratch.qpos[part.qpos_adr] = position
        mujoco.mj_kinematics(model, scratch)
        limb, panel = self._limbs[arm], np.flatnonzero((model.geom_bodyid == part.body_id) & (model.geom_contype > 0))
        gap = self._gap(scratch, limb, panel)
        mujoco.mj_collision(model, scratch)
        barred = np.ones(model.ngeom, dtype=bool)
        barred[panel] = False
        for obj in world.objects.values():
            if obj.held_by:
                barred[obj.geom_ids] = False
        touching = np.zeros(model.ngeom, dtype=bool)
        touching[limb] = True
        a, b = scratch.contact.geom[: scratch.ncon].T
        counts = (touching[a] != touching[b]) & barred[np.where(touching[a], b, a)]
        depth = _deepest_m(scratch, counts)
        site = self._joints.grasp_sites[arm]
        bones = np.stack([*scratch.xpos[self._bones[arm]], scratch.site_xpos[site]])
        return AtDoor(gap, depth, bones, scratch.geom_xpos[self._hands[arm]].copy())

    def _cargo(self, arm: Arm) -> _Cargo | None:
        """The object that this arm alone holds, with its present pose in the hand."""
        world = self._world
        name = world.grasps.held(arm.value)
        obj = None if name is None else world.objects[name]
        if obj is None or not obj.movable or len(obj.held_by) != 1:
            return None
        site = self._joints.grasp_sites[arm]
        rotation = world.data.site_xmat[site].reshape(3, 3)
        offset = rotation.T @ (world.data.xpos[obj.body_id] - world.data.site_xpos[site])
        turn = rotation.T @ world.data.xmat[obj.body_id].reshape(3, 3)
        return _Cargo(site, obj.qpos_adr, offset, turn, frozenset(map(int, obj.geom_ids)))

    def free(self, arm: Arm, postures: Iterable[Array], ignore: Iterable[str | int] = (), opening: float | None = None) -> bool:
        """Whether arm postures are free of collisions; light contact is tolerated."""
        return bool(np.all(self.depths_m(arm, postures, ignore, opening, limit_m=TOUCH_M) <= TOUCH_M))

    def load_depths_m(self, obj: ObjectInstance, poses: Iterable[Array]) -> Array:
        """Penetration of an object into its surroundings for each of its poses (4, 4), world frame.

        The robot and what lies in the object do not count.
        """
        world, scratch, model = self._world, self._scratch, self._world.model
        scratch.qpos[:] = world.data.qpos
        place, turn = slice(obj.qpos_adr, obj.qpos_adr + 3), slice(obj.qpos_adr + 3, obj.qpos_adr + 7)
        load = np.isin(np.arange(model.ngeom), obj.geom_ids)
        barred = ~np.isin(model.geom_bodyid, list(world.scene.robot_bodies))
        for name in (obj.object_id, *world.containment.contents(obj.object_id)):
            barred[world.objects[name].geom_ids] = False
        depths: list[float] = []
        for pose in poses:
            quaternion = np.empty(4)
            mujoco.mju_mat2Quat(quaternion, pose[:3, :3].ravel())
            scratch.qpos[place], scratch.qpos[turn] = pose[:3, 3], quaternion
            mujoco.mj_kinematics(model, scratch)
            mujoco.mj_collision(model, scratch)
            a, b = scratch.contact.geom[: scratch.ncon].T
            counts = (load[a] != load[b]) & barred[np.where(load[a], b, a)]
            depths.append(_deepest_m(scratch, counts))
        return np.array(depths)

    def own_depth_m(self, obj: ObjectInstance, arms: Mapping[Arm, Array], waist: Array | None = None) -> float:
        """Penetration of a held object into the robot's trunk, head, legs and upper arms.

        Args:
            obj: moves with the hand that holds it; what both hold moves as the middle between them does, and does not turn.
            arms: arm joints (A,) of the arms that hold it.
            waist: waist joints; as they are when None.
        """
        world, scratch, model = self._world, self._scratch, self._world.model
        self._copy_state()
        for arm, posture in arms.items():
            scratch.qpos[self._joints.arm_positions[arm]] = posture
        if waist is not None:
            scratch.qpos[self._waist_adr] = waist
        mujoco.mj_kinematics(model, scratch)
        cargo = self._cargo(next(iter(arms)))
        if cargo is None:
            sites = [self._joints.grasp_sites[arm] for arm in arms]
            way = (scratch.site_xpos[sites] - world.data.site_xpos[sites]).mean(axis=0)
            scratch.qpos[obj.qpos_adr : obj.qpos_adr + 3] += way
            mujoco.mj_kinematics(model, scratch)
        else:
            cargo.follow(model, scratch)
        mujoco.mj_collision(model, scratch)
        load, own = np.isin(np.arange(model.ngeom), obj.geom_ids), model.geom_contype == OWN_BIT
        a, b = scratch.contact.geom[: scratch.ncon].T
        counts = (load[a] & own[b]) | (load[b] & own[a])
        return _deepest_m(scratch, counts)

    def finger_gaps_m(self, arm: Arm, geoms: NDArray[np.int64]) -> tuple[float, float]:
        """Distance of each of the two opposing finger groups to some geoms, in the world as it is, negative inside."""
        gaps = []
        for group in self._groups[arm]:
            gaps.append(self.gap_m(group, geoms))
        return gaps[0], gaps[1]

    def hand_gap_m(self, arm: Arm, geoms: NDArray[np.int64]) -> float:
        """Distance of the whole hand to some geoms."""
        return min(self.finger_gaps_m(arm, geoms))

    def gap_m(self, ours: NDArray[np.int64], theirs: NDArray[np.int64]) -> float:
        """Smallest distance between two sets of geoms."""
        return self._gap(self._world.data, ours, theirs)

    def limb_gap_m(self, arm: Arm, geoms: NDArray[np.int64]) -> float:
        """Distance of forearm and hand to some geoms, in the world as it is."""
        return self._gap(self._world.data, self._limbs[arm], geoms)

    def _gap(self, data: mujoco.MjData, ours: Iterable[int], theirs: Iterable[int]) -> float:
        model = self._world.model
        best = _FAR_M
        for a in ours:
            for b in theirs:
                reach = float(model.geom_rbound[a] + model.geom_rbound[b]) + best
                if float(np.linalg.norm(data.geom_xpos[a] - data.geom_xpos[b])) > reach:
                    continue
                best = min(best, float(mujoco.mj_geomDistance(model, data, int(a), int(b), best, None)))
        return best


def _deepest_m(data: mujoco.MjData, counts: NDArray[np.bool_]) -> float:
    """Deepest penetration of the contacts that count (ncon,)."""
    return max(0.0, float(-np.min(data.contact.dist[: data.ncon][counts], initial=0.0)))


def _limb_geoms(model: mujoco.MjModel, joint: str) -> frozenset[int]:
    """Colliding geoms of the body that a joint moves, and of all below it."""
    top = int(model.jnt_bodyid[model.joint(joint).id])
    below = {top}
    for index in range(top + 1, model.nbody):
        if int(model.body_parentid[index]) in below:
            below.add(index)
    geoms = np.flatnonzero(np.isin(model.geom_bodyid, sorted(below)) & ((model.geom_contype & LIMB_BIT) > 0))
    return frozenset(int(index) for index in geoms)


def _is_forearm(model: mujoco.MjModel, geom: int) -> bool:
    return str(model.geom(geom).name).endswith("forearm")
