"""A running scene: one robot, one room, its objects; servo targets in, physics forward, states out.

`World` is the only owner of `MjModel` and `MjData`. Skills write targets of named joints and of the base, call `advance`, and
decide when a grasp is justified (`attach`). Everything a later step depends on is in `save()`. Paper: the DualTHOR simulator.
Left out: balance in physics (the base is servoed), fluids, cloth.

Frames: world, z up, metres, radians; the base pose is (x, y, pelvis height, yaw); the trunk's forward lean follows
from the height.
"""

from __future__ import annotations

import copy
import dataclasses
import functools
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Final

import mujoco
import numpy as np
from numpy.typing import NDArray

from data.interface.bodies import SIDES
from sim.robots.build_solver import robot_kit
from sim.robots.spec import RobotSpec
from sim.scene.catalogue import Catalogue, Part, load_catalogue
from sim.scene.compiler import BASE_JOINTS, TIMESTEP_S, SceneKey, compile_scene
from sim.scene.objects import (
    STATE_NAMES,
    MovingPart,
    ObjectInstance,
    ObjectPlacement,
    ObjectState,
    Placement,
    copy_state,
    index_object,
)
from sim.scene.rooms import Room, load_room
from sim.world import dynamics, liquids
from sim.world.constraints import GraspConstraints
from sim.world.metadata import world_metadata
from sim.world.placement import OVERHANG_SHARE, REACH_BAND_M, box_in_world, find_free_spot, resting_on
from sim.world.recorder import FRAME_DT_S, MotionWindow, Recorder
from sim.world.rendering import Renderer, View
from sim.world.snapshot import WorldSnapshot, read_physics, write_physics

__all__ = ["World", "WorldError"]

_STEPS_PER_FRAME: Final = round(FRAME_DT_S / TIMESTEP_S)
_FRAMES_PER_TICK: Final = round(dynamics.TICK_S / FRAME_DT_S)
#: Objects that are lighter than this are opened with gentle fingers.
_LIGHT_KG: Final = 1.5
#: Free distance between objects that the world places by itself: a hand fits between.
_HAND_GAP_M: Final = 0.09
#: What a self-closing door or drawer is shut with, and how long its damper lets that take.
_SPRING_TORQUE_N_M: Final = 2.0
_SPRING_FORCE_N: Final = 6.0
_CLOSING_S: Final = 1.2


class WorldError(ValueError):
    """A world that cannot be built or asked as requested; the message names the value and what is allowed."""


class World:
    """One robot in one furnished room.

    Args:
        robot: description from `sim.robots.spec.load_robot`, None for a room alone.
        room: room name.
        placements: movable objects, carriers before what they carry; None takes the room's own default objects.
        states: start states of furniture by id (`{"Fridge_1": {"isOpen": True}}`).
        start: base x, y (m) and yaw (rad); None takes the room's default.
        pelvis_height_m: start height, legs and trunk follow; None is standing.
        joint_positions: start positions of named joints; arms default to rest, hands to open, the waist to 0.
        seed: of the random stream that places objects.
        settle_s: simulated seconds that objects get to come to rest before time 0.

    Attributes:
        robot, room, catalogue: what the world was built from.
        model, data: MuJoCo's; the model is this world's own copy.
        objects: every object by id, furniture first.
        rng: the world's random stream, part of snapshots.
        recorder: 20 Hz motion recorder, None without a robot.
        liquids: where all liquid came from and went to.

    Raises:
        WorldError: on unknown ids, states or receptacles, or when an object finds no place.
    """

    def __init__(
        self,
        robot: RobotSpec | None,
        room: str,
        placements: Sequence[Placement] | None = None,
        *,
        states: Mapping[str, Mapping[str, bool | float | str]] | None = None,
        start: tuple[float, float, float] | None = None,
        pelvis_height_m: float | None = None,
        joint_positions: Mapping[str, float] | None = None,
        seed: int = 0,
        settle_s: float = 0.4,
    ) -> None:
        self.robot = robot
        self.room: Room = load_room(room)
        self.catalogue = load_catalogue()
        self.rng = np.random.default_rng(seed)
        if placements is None:
            placements = [ObjectPlacement(item.id, item.receptacle, yaw_deg=item.yaw_deg) for item in self.room.objects]
        ids = [placement.object_id for placement in placements]
        fixed = [item.id for item in self.room.furniture]
        repeated = sorted({name for name in ids if ids.count(name) > 1} | (set(ids) & set(fixed)))
        if repeated:
            raise WorldError(f"object {repeated[0]!r} exists twice in {self.room.name}")
        key = _scene_key(robot, room, ids)
        self.model: mujoco.MjModel = copy.copy(compile_scene(key))
        self.data = mujoco.MjData(self.model)
        self._key = key
        templates, parts, owners = _indexed(key, (*fixed, *ids), self.catalogue)
        self.objects: dict[str, ObjectInstance] = {
            name: dataclasses.replace(thing, state=ObjectState(), held_by=[]) for name, thing in templates.items()
        }
        self._base_mass = self.model.body_mass.copy()
        self._base_inertia = self.model.body_inertia.copy()
        self._base_geom_pos, self._base_geom_size = self.model.geom_pos.copy(), self.model.geom_size.copy()
        self.liquids = liquids.Books()
        self.part_of_geom, self.object_of_geom = parts, owners
        self._movable_body = {body: thing.movable for thing in self.objects.values() for body in thing.body_ids}
        roots = [] if robot is None else [int(self.model.body(robot.root_body).id)]
        self._robot_bodies = frozenset(b for b in range(1, self.model.nbody) if int(self.model.body_rootid[b]) in roots)
        self._actuator = {self.model.actuator(i).name: i for i in range(self.model.nu)}
        self.recorder: Recorder | None = None
        self.constraints: GraspConstraints | None = None
        self._steps = 0
        self._speeds: dict[str, float] = {}
        self._renderers: dict[tuple[int, int], Renderer] = {}
        if robot is not None:
            self._reset_robot(robot, start, pelvis_height_m, joint_positions or {})
        for thing in self.objects.values():
            if thing.type.starts_open > 0.0:
                self._start_state(thing, {"openness": thing.type.starts_open})
        for name, values in (states or {}).items():
            self._start_state(self.object(name), values)
        for placement in placements:
            self._place(placement)
        if robot is not None:
            sites = {side: int(self.model.site(robot.arms[side].grasp_site).id) for side in SIDES}
            hands = {side: int(self.model.site_bodyid[site]) for side, site in sites.items()}
            self.constraints = GraspConstraints(self.model, self.data, hands, sites)
            self.recorder = Recorder(self.model, robot)
        self._settle(settle_s)

    # ---- building -----------------------------------------------------------------------------------------------------------

    def _reset_robot(
        self,
        robot: RobotSpec,
        start: tuple[float, float, float] | None,
        pelvis_height_m: float | None,
        joint_positions: Mapping[str, float],
    ) -> None:
        x, y, yaw_deg = self.room.start
        x, y, yaw = start if start is not None else (x, y, float(np.radians(yaw_deg)))
        height = robot.standing_pelvis_height_m if pelvis_height_m is None else pelvis_height_m
        crouches = robot_kit(robot).crouches
        height = crouches.clamp(height)
        targets: dict[str, float] = dict(zip(BASE_JOINTS, (x, y, height, yaw, crouches.pitch(height)), strict=True))
        targets |= dict(zip(robot.leg_joints, map(float, crouches.legs(height)), strict=True))
        for side in SIDES:
            arm = robot.arms[side]
            targets |= dict(zip(arm.joints, arm.rest, strict=True))
            targets |= dict(zip(arm.hand_joints, arm.hand_open, strict=True))
        targets |= joint_positions
        for name, value in targets.items():
            if name not in robot.joints and name not in BASE_JOINTS:
                raise WorldError(f"unknown joint {name!r}; allowed: {', '.join(robot.joints)}")
            self.data.qpos[self.model.joint(name).qposadr[0]] = value
        self._follow_couplings()
        for name, index in self._actuator.items():
            self.data.ctrl[index] = self.data.qpos[self.model.joint(name).qposadr[0]]
        mujoco.mj_forward(self.model, self.data)

    def _follow_couplings(self) -> None:
        """Puts coupled finger joints where their leaders want them."""
        model, data = self.model, self.data
        for eq in range(model.neq):
            if int(model.eq_type[eq]) != int(mujoco.mjtEq.mjEQ_JOINT) or model.eq_obj2id[eq] < 0:
                continue
            follower, leader = (int(model.jnt_qposadr[j]) for j in (model.eq_obj1id[eq], model.eq_obj2id[eq]))
            data.qpos[follower] = np.polyval(model.eq_data[eq, 4::-1], data.qpos[leader])

    def _place(self, placement: Placement) -> None:
        thing, carrier = self.object(placement.object_id), self.object(placement.receptacle)
        mujoco.mj_kinematics(self.model, self.data)
        pending = [name for name, other in self.objects.items() if other.movable and self.data.xpos[other.body_id, 1] > 15.0]
        if carrier.object_id in pending:
            raise WorldError(f"{placement.object_id} is placed on {carrier.object_id} before that has its own place")
        was_open = carrier.openness
        carrier.openness = 1.0  # a start in a closed cabinet is allowed; only hands need the door open
        target = None if placement.xy is None else np.asarray(placement.xy, dtype=float)
        spot: NDArray[np.float64] | None = None
        # An explicit place only has to carry the object: it may stand a little over the edge.
        narrow = OVERHANG_SHARE * float(np.min(thing.local_max[:2] - thing.local_min[:2])) / 2.0
        for gap in (0.0,) if target is not None else (_HAND_GAP_M, 0.04, 0.01):
            spot = find_free_spot(
                self.data,
                self.objects,
                carrier,
                thing.footprint_radius_m if target is None else narrow,
                height_m=thing.height_m,
                near=target,
                rng=self.rng,
                gap_m=gap,
                ignore=(thing.object_id, *pending),
                band_m=10.0 if target is not None else REACH_BAND_M,
            )
            if spot is not None:
                break
        carrier.openness = was_open
        if spot is None:
            raise WorldError(f"no room for {placement.object_id} on {placement.receptacle} in {self.room.name}")
        if target is not None:
            if np.linalg.norm(spot[:2] - target) > 0.03:
                raise WorldError(
                    f"{placement.object_id} does not fit at {placement.xy} on {placement.receptacle}; nearest is {spot[:2]}"
                )
            spot[:2] = target
        half = np.radians(placement.yaw_deg) / 2.0
        adr = thing.qpos_adr
        self.data.qpos[adr : adr + 3] = spot + np.array([0.0, 0.0, 0.002 - thing.local_min[2]])
        self.data.qpos[adr + 3 : adr + 7] = (np.cos(half), 0.0, 0.0, np.sin(half))
        self._start_state(thing, placement.state)
        mujoco.mj_kinematics(self.model, self.data)

    def _start_state(self, thing: ObjectInstance, values: Mapping[str, bool | float | str]) -> None:
        for name, value in values.items():
            if name in ("isOpen", "openness"):
                if not thing.moving:
                    raise WorldError(f"{thing.object_id} has no door, drawer or lid, {name}={value!r} is not possible")
                for part in thing.moving:
                    self.data.qpos[part.qpos_adr] = part.range[0] + float(value) * (part.range[1] - part.range[0])
                thing.openness = float(value)
            elif name == "selfClosing":
                self._set_self_closing(thing, bool(value))
            elif name == "mass":
                thing.mass_kg = float(value)
                self._update_mass(thing)
            else:
                self.set_state(thing.object_id, name, value)

    def _set_self_closing(self, thing: ObjectInstance, value: bool) -> None:
        """Puts springs on an object's doors or drawers that shut them, slowed by dampers, or takes the springs away."""
        if value and (not thing.moving or any(part.spec.is_lid for part in thing.moving)):
            raise WorldError(f"{thing.object_id} has no door or drawer, selfClosing=True is not possible")
        thing.self_closing = value
        for part in thing.moving:
            hinge = int(self.model.jnt_type[part.joint_id]) == int(mujoco.mjtJoint.mjJNT_HINGE)
            shut, travel = _SPRING_TORQUE_N_M if hinge else _SPRING_FORCE_N, part.range[1] - part.range[0]
            self.model.jnt_stiffness[part.joint_id] = 0.5 * shut / travel if value else 0.0
            self.model.qpos_spring[part.qpos_adr] = part.range[0] - 2.0 * travel
            if value:
                self.model.dof_damping[part.dof_adr] = _CLOSING_S * 1.25 * shut / travel

    def _settle(self, seconds: float) -> None:
        for _ in range(round(seconds / TIMESTEP_S)):
            mujoco.mj_step(self.model, self.data)
        self.data.qvel[:] = 0.0
        self.data.qacc_warmstart[:] = 0.0
        self.data.time = 0.0
        mujoco.mj_forward(self.model, self.data)
        self._update_openness()
        if self.recorder is not None:
            self.recorder.fill(self.data)
        for thing in self.objects.values():
            if thing.type.has("cold_source"):
                for name in self.contents(thing.object_id):
                    self.objects[name].state.temperature = 4.0
            dynamics.look(self, thing)

    # ---- time ---------------------------------------------------------------------------------------------------------------

    @property
    def time_s(self) -> float:
        """Simulated seconds since the start."""
        return self._steps * TIMESTEP_S

    def advance(self, seconds: float) -> None:
        """Steps physics; records frames every 50 ms and updates states every second.

        Raises:
            WorldError: when `seconds` is not a positive multiple of the 5 ms step, or physics diverged.
        """
        steps = round(seconds / TIMESTEP_S)
        if steps <= 0 or abs(steps * TIMESTEP_S - seconds) > 1e-6:
            raise WorldError(f"advance needs a positive multiple of {TIMESTEP_S} s, got {seconds!r}")
        while steps > 0:
            chunk = min(steps, _STEPS_PER_FRAME - self._steps % _STEPS_PER_FRAME)
            mujoco.mj_step(self.model, self.data, chunk)
            self._steps += chunk
            steps -= chunk
            if self._steps % _STEPS_PER_FRAME == 0:
                self._frame()
        self._update_openness()

    def _frame(self) -> None:
        if not np.isfinite(self.data.qpos).all() or int(self.data.warning[int(mujoco.mjtWarning.mjWARN_BADQACC)].number):
            raise WorldError(f"physics diverged at {self.time_s:.3f} s in {self.room.name}")
        mujoco.mj_kinematics(self.model, self.data)
        if self.recorder is not None:
            self.recorder.record(self.data)
        if self.constraints is not None and self.constraints.released:
            self.constraints.settle_released(self._movable_body)
        liquids.run_out(self, FRAME_DT_S)
        dynamics.break_by_impact(self, self._speeds)
        self._speeds = {name: self.speed_of(name) for name, thing in self.objects.items() if thing.type.has("breakable")}
        if (self._steps // _STEPS_PER_FRAME) % _FRAMES_PER_TICK == 0:
            dynamics.tick(self)

    def _update_openness(self) -> None:
        for thing in self.objects.values():
            if thing.moving:
                thing.openness = max(
                    float(np.clip((self.data.qpos[part.qpos_adr] - part.range[0]) / (part.range[1] - part.range[0]), 0.0, 1.0))
                    for part in thing.moving
                )

    # ---- robot --------------------------------------------------------------------------------------------------------------

    def _robot(self) -> RobotSpec:
        if self.robot is None:
            raise WorldError("this world has no robot")
        return self.robot

    @property
    def base_pose(self) -> NDArray[np.float64]:
        """(4,) x, y, pelvis height (m) and yaw (rad) of the base."""
        return np.array([self.data.qpos[self.model.joint(name).qposadr[0]] for name in BASE_JOINTS[:4]])

    @property
    def base_target(self) -> NDArray[np.float64]:
        """(4,) commanded base pose."""
        return np.array([self.data.ctrl[self._actuator[name]] for name in BASE_JOINTS[:4]])

    def set_base_target(self, *, x: float | None = None, y: float | None = None, yaw: float | None = None) -> None:
        """Commands the base; what is None keeps its target. Yaw is not wrapped: the servo turns the way the numbers go."""
        for name, value in (("base_x", x), ("base_y", y), ("base_yaw", yaw)):
            if value is not None:
                self.data.ctrl[self._actuator[name]] = value

    def command_height(self, pelvis_height_m: float) -> None:
        """Commands a pelvis height with the legs and the trunk's lean that belong to it, clipped to the robot's range."""
        robot = self._robot()
        crouches = robot_kit(robot).crouches
        height = crouches.clamp(pelvis_height_m)
        self.data.ctrl[self._actuator["base_z"]] = height
        self.data.ctrl[self._actuator["base_pitch"]] = crouches.pitch(height)
        self.set_joint_targets(dict(zip(robot.leg_joints, map(float, crouches.legs(height)), strict=True)))

    def put_base(self, x_m: float, y_m: float, yaw_rad: float, pelvis_height_m: float | None = None) -> None:
        """Puts the robot somewhere at once, at rest, with what its hands hold; nothing else moves."""
        mujoco.mj_forward(self.model, self.data)
        held = {thing.object_id: None for thing in self.objects.values() if thing.movable and thing.held_by}
        before = self.grasp_poses()
        carried = {name: np.linalg.inv(before[self.objects[name].held_by[0]]) @ self.pose(name) for name in held}
        self.set_base_target(x=x_m, y=y_m, yaw=yaw_rad)
        if pelvis_height_m is not None:
            self.command_height(pelvis_height_m)
            for name in self._robot().leg_joints:
                self.data.qpos[self.model.joint(name).qposadr[0]] = self.data.ctrl[self._actuator[name]]
        for name in BASE_JOINTS if pelvis_height_m is not None else ("base_x", "base_y", "base_yaw"):
            joint = self.model.joint(name)
            self.data.qpos[joint.qposadr[0]] = self.data.ctrl[self._actuator[name]]
            self.data.qvel[joint.dofadr[0]] = 0.0
        mujoco.mj_kinematics(self.model, self.data)
        after = self.grasp_poses()
        for name, offset in carried.items():
            thing = self.objects[name]
            pose = after[thing.held_by[0]] @ offset
            self.data.qpos[thing.qpos_adr : thing.qpos_adr + 3] = pose[:3, 3]
            mujoco.mju_mat2Quat(self.data.qpos[thing.qpos_adr + 3 : thing.qpos_adr + 7], pose[:3, :3].flatten())
            self.data.qvel[thing.dof_adr : thing.dof_adr + 6] = 0.0
        mujoco.mj_forward(self.model, self.data)

    def grasp_poses(self) -> dict[str, NDArray[np.float64]]:
        """(4, 4) pose of each arm's grasp site, world frame."""
        return {side: self.grasp_pose(side) for side in SIDES}

    def set_joint_targets(self, targets: Mapping[str, float]) -> None:
        """Commands named actuated joints (rad or m).

        Raises:
            WorldError: on a joint without actuator.
        """
        for name, value in targets.items():
            index = self._actuator.get(name)
            if index is None:
                raise WorldError(f"joint {name!r} has no actuator; allowed: {', '.join(self._actuator)}")
            self.data.ctrl[index] = value

    def joint_targets(self) -> dict[str, float]:
        """Commanded positions of the actuated joints, the base left out."""
        return {name: float(self.data.ctrl[i]) for name, i in self._actuator.items() if name not in BASE_JOINTS}

    def joint_positions(self) -> dict[str, float]:
        """Positions of all joints of the robot, by name."""
        robot = self._robot()
        return {name: float(self.data.qpos[self.model.joint(name).qposadr[0]]) for name in robot.joints}

    def set_hand(self, arm: str, opening: float) -> None:
        """Commands a hand, 0 closed to 1 open."""
        spec = self._robot().arms[arm]
        share = float(np.clip(opening, 0.0, 1.0))
        values = np.asarray(spec.hand_closed) + share * (np.asarray(spec.hand_open) - np.asarray(spec.hand_closed))
        self.set_joint_targets(dict(zip(spec.hand_joints, map(float, values), strict=True)))

    def hand_opening(self, arm: str) -> float:
        """Measured opening of a hand, 0 closed to 1 open."""
        self._robot()
        assert self.recorder is not None
        return float(self.recorder.hands(self.data)[SIDES.index(arm)])

    def grasp_pose(self, arm: str) -> NDArray[np.float64]:
        """(4, 4) pose of the grasp site, world frame."""
        return self._site_pose(int(self.model.site(self._robot().arms[arm].grasp_site).id))

    def motion(self, frames: int = 64) -> MotionWindow:
        """The last frames of the robot's motion at 20 Hz."""
        self._robot()
        assert self.recorder is not None
        return self.recorder.window(frames)

    def _site_pose(self, site: int) -> NDArray[np.float64]:
        pose = np.eye(4)
        pose[:3, :3] = self.data.site_xmat[site].reshape(3, 3)
        pose[:3, 3] = self.data.site_xpos[site]
        return pose

    # ---- grasps -------------------------------------------------------------------------------------------------------------

    def attach(
        self, arm: str, object_id: str, part: MovingPart | None = None, point: NDArray[np.float64] | None = None
    ) -> None:
        """Ties an object to a hand as it is now: free objects rigidly, doors, drawers and lids by a ball joint.

        Whether contact justifies it is the caller's decision.

        Args:
            arm: left or right.
            object_id: the object.
            part: its door, drawer or lid that is taken; None takes a free object as a whole, and the nearest door of furniture.
            point: (3,) where the ball joint is, world frame; the grasp site when None.

        Raises:
            WorldError: when the arm holds something, or the object is furniture without a door.
        """
        thing, constraints = self.object(object_id), self._constraints()
        if constraints.holds(arm):
            raise WorldError(f"the {arm} arm already holds {self.held(arm)}")
        if not thing.movable and not thing.moving:
            raise WorldError(f"{object_id} is furniture and cannot be held")
        if thing.movable and part is None:
            constraints.attach(arm, thing.body_id, rigid=True, lids=thing.body_ids[1:])
        else:
            body = self._nearest_door(arm, thing) if part is None else part.body_id
            constraints.attach(arm, body, rigid=False, point=point, gentle=thing.movable and thing.mass_kg < _LIGHT_KG)
        thing.held_by.append(arm)

    def give_way(self, object_id: str, part: MovingPart) -> None:
        """Lets the hands into a lid that one of them is about to take, and into a free object below it.

        Fingers around a tab would else press on the object, or hook into its rim and lift it.
        """
        thing = self.object(object_id)
        self._constraints().give_way(part.body_id, thing.body_id if thing.movable else None)

    def detach(self, arm: str) -> str | None:
        """Lets go of whatever the arm holds and returns its id."""
        name = self.held(arm)
        if name is None:
            return None
        thing = self.objects[name]
        thing.held_by.remove(arm)
        constraints = self._constraints()
        body = constraints.held_body(arm)
        if body is not None:
            constraints.detach(arm, thing.body_ids if thing.movable else (body,), last=not thing.held_by)
        return name

    def held(self, arm: str) -> str | None:
        """Id of what an arm holds, a door's furniture included."""
        return next((name for name, thing in self.objects.items() if arm in thing.held_by), None)

    def is_held_body(self, body_id: int) -> bool:
        """Whether a MuJoCo body is part of a free object in some hand."""
        return any(thing.movable and thing.held_by and body_id in thing.body_ids for thing in self.objects.values())

    @property
    def robot_body_ids(self) -> frozenset[int]:
        """MuJoCo bodies of the robot."""
        return self._robot_bodies

    def _constraints(self) -> GraspConstraints:
        self._robot()
        assert self.constraints is not None
        return self.constraints

    def _nearest_door(self, arm: str, thing: ObjectInstance) -> int:
        hand = self.grasp_pose(arm)[:3, 3]
        door = min(thing.moving, key=lambda part: float(np.linalg.norm(self.data.site_xpos[part.handle_site] - hand)))
        return door.body_id

    def contacts(self, arm: str, object_id: str) -> set[str]:
        """Names of the arm's geoms that touch an object now."""
        thing, constraints = self.object(object_id), self._constraints()
        own = set(map(int, thing.geom_ids))
        hand = {int(g) for g in constraints.hand_geoms(arm)}
        touched: set[str] = set()
        for contact in self.data.contact[: self.data.ncon]:
            a, b = int(contact.geom1), int(contact.geom2)
            for mine, other in ((a, b), (b, a)):
                if mine in hand and other in own:
                    touched.add(str(self.model.geom(mine).name))
        return touched

    # ---- objects ------------------------------------------------------------------------------------------------------------

    def object(self, object_id: str) -> ObjectInstance:
        """The object of that id.

        Raises:
            WorldError: on an unknown id; the message lists the known ones.
        """
        thing = self.objects.get(object_id)
        if thing is None:
            raise WorldError(f"unknown object {object_id!r} in {self.room.name}; allowed: {', '.join(self.objects)}")
        return thing

    def pose(self, object_id: str) -> NDArray[np.float64]:
        """(4, 4) pose of an object's frame (centre of the footprint, on the ground), world frame."""
        thing, pose = self.object(object_id), np.eye(4)
        pose[:3, :3] = self.data.xmat[thing.body_id].reshape(3, 3)
        pose[:3, 3] = self.data.xpos[thing.body_id]
        return pose

    def center(self, object_id: str) -> NDArray[np.float64]:
        """(3,) centre of the bounding box, world frame."""
        low, high = self.bounds(object_id)
        return (low + high) / 2.0

    def bounds(self, object_id: str) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Axis-aligned bounding box (minimum, maximum) in the world, doors closed."""
        return box_in_world(self.data, self.object(object_id))

    def front(self, object_id: str) -> NDArray[np.float64]:
        """(2,) horizontal unit vector out of the object's front, where a robot stands to use it."""
        axis = -self.data.xmat[self.object(object_id).body_id].reshape(3, 3)[:2, 1]
        return axis / max(float(np.linalg.norm(axis)), 1e-9)

    def grips(self, object_id: str, kind: str = "single") -> NDArray[np.float64]:
        """(N, 3) points where hands hold it, world frame: one for `single`, two (at +x and -x of the object) for `double`."""
        thing = self.object(object_id)
        points = thing.type.grips.get(kind)
        if points is None:
            middle = (thing.local_min + thing.local_max) / 2.0
            ends = (middle[0],) if kind == "single" else (thing.local_max[0], thing.local_min[0])
            points = tuple((x, middle[1], middle[2]) for x in ends)
        pose = self.pose(object_id)
        return np.asarray(points) @ pose[:3, :3].T + pose[:3, 3]

    def handle(self, object_id: str) -> NDArray[np.float64]:
        """(3,) position of the handle of a door or drawer, world frame.

        Raises:
            WorldError: when the object has none.
        """
        thing = self.object(object_id)
        sites = [part.handle_site for part in thing.moving if part.handle_site >= 0]
        if not sites:
            raise WorldError(f"{object_id} has no handle")
        return self.data.site_xpos[sites[0]].copy()

    def toggle_point(self, object_id: str) -> NDArray[np.float64]:
        """(3,) point a finger touches to switch an object, world frame.

        Raises:
            WorldError: when the object cannot be switched.
        """
        thing = self.object(object_id)
        if thing.toggle_site < 0:
            raise WorldError(f"{object_id} has no switch")
        return self.data.site_xpos[thing.toggle_site].copy()

    def distance_to(self, object_id: str) -> float:
        """Horizontal metres from the base to the nearest point of the object's bounding box, 0 without a robot."""
        if self.robot is None:
            return 0.0
        low, high = self.bounds(object_id)
        gap = np.maximum(np.maximum(low[:2] - self.base_pose[:2], self.base_pose[:2] - high[:2]), 0.0)
        return float(np.hypot(*gap))

    def speed_of(self, object_id: str) -> float:
        """Metres per second of a free object, 0 for furniture."""
        thing = self.object(object_id)
        return float(np.linalg.norm(self.data.qvel[thing.dof_adr : thing.dof_adr + 3])) if thing.movable else 0.0

    def all_parents(self) -> dict[str, tuple[str, ...]]:
        """Receptacles of every movable object, the direct one first, then what carries that one."""
        direct = resting_on(self.data, self.objects)
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
        self.object(object_id)
        return self.all_parents().get(object_id, ())

    def contents(self, object_id: str) -> tuple[str, ...]:
        """Ids of what rests on or in an object, indirectly too."""
        self.object(object_id)
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
    ) -> NDArray[np.float64] | None:
        """A (3,) world point where an object can be put, None when there is no room; see `find_free_spot`."""
        return find_free_spot(
            self.data, self.objects, self.object(receptacle_id), footprint_radius_m,
            height_m=height_m, near=near, rng=rng, gap_m=gap_m, ignore=ignore, band_m=band_m,
        )  # fmt: skip

    def set_state(self, object_id: str, name: str, value: bool | float | str) -> None:
        """Sets a state and what follows from it: colours, mass of a liquid, the burner behind a knob.

        Raises:
            WorldError: on a name outside `STATE_NAMES`, or a state the type does not have.
        """
        thing = self.object(object_id)
        needs = {"isToggled": "toggleable", "isBroken": "breakable", "isFilledWithLiquid": "fillable", "fillLiquid": "fillable",
                 "fillLitres": "fillable", "isDirty": "dirtyable", "isCooked": "cookable", "isSliced": "sliceable",
                 "isUsedUp": "used_up"}  # fmt: skip
        if name not in STATE_NAMES:
            raise WorldError(f"unknown state {name!r}; allowed: {', '.join(STATE_NAMES)}")
        linked = object_id in self.room.links.values()
        if name in needs and not thing.type.has(needs[name]) and not (linked and name == "isToggled"):
            raise WorldError(f"{thing.type.name} is not {needs[name]}, {name}={value!r} is not possible")
        if name in ("isFilledWithLiquid", "fillLiquid", "fillLitres"):
            self._set_filling(thing, name, value)
            return
        if name == "isBroken" and value and thing.state.fillLitres > 0.0:
            liquids.spill(self, thing)
        setattr(thing.state, name, value)
        target = self.room.links.get(object_id)
        if name == "isToggled" and target is not None and self.object(target).type.has("heat_source"):
            self.set_state(target, name, value)
        dynamics.look(self, thing)

    def _set_filling(self, thing: ObjectInstance, name: str, value: bool | float | str) -> None:
        """Fills or empties a vessel by hand; the books take it as given."""
        before, full = thing.state.fillLitres, liquids.capacity_l(thing.type)
        liquid = thing.state.fillLiquid or "water"
        if name == "fillLiquid":
            if value not in ("", *liquids.LIQUIDS):
                raise WorldError(f"unknown liquid {value!r}; allowed: {', '.join(liquids.LIQUIDS)}")
            level, liquid = (before or full) if value else 0.0, str(value)
        elif name == "fillLitres":
            level = float(value)
            if not 0.0 <= level <= full + 1e-9:
                raise WorldError(f"{thing.object_id} holds 0 to {full:g} litres, got {value!r}")
        else:
            level = full if value else 0.0
        liquids.set_level(self, thing, level, liquid)
        self.liquids.given += thing.state.fillLitres - before

    def refresh(self, thing: ObjectInstance) -> None:
        """Brings mass and look of an object in line with its state."""
        self._update_mass(thing)
        dynamics.look(self, thing)

    def show_level(self, thing: ObjectInstance, geom: int, part: Part) -> None:
        """Puts the visible liquid of a vessel at its level: higher in a hollow vessel, wider on a solid one."""
        full = liquids.capacity_l(thing.type)
        share = thing.state.fillLitres / full if full > 0.0 else 0.0
        position, size = self._base_geom_pos[geom], self._base_geom_size[geom]
        if any(other.wall_m > 0.0 for other in thing.type.parts):
            floor = max(other.wall_m for other in thing.type.parts) + part.size[2] / 2.0
            height = min(floor, position[2]) + share * (position[2] - min(floor, position[2]))
            if height != self.model.geom_pos[geom, 2]:
                self.move_geom(geom, np.array([position[0], position[1], height]))
        else:
            self.model.geom_size[geom, 0] = size[0] * float(np.sqrt(0.3 + 0.7 * share))

    def move_geom(self, geom: int, position: NDArray[np.float64]) -> None:
        """Moves a geom within its body; MuJoCo does not compute what is fixed to the world again, so that is done here."""
        body = int(self.model.geom_bodyid[geom])
        self.model.geom_pos[geom] = position
        self.data.geom_xpos[geom] = self.data.xpos[body] + self.data.xmat[body].reshape(3, 3) @ position

    def liquid_kg(self, object_id: str) -> float:
        """Kilograms of the liquid in a movable vessel; furniture does not weigh."""
        thing = self.object(object_id)
        return thing.state.fillLitres if thing.movable else 0.0

    def total_mass_kg(self, object_id: str) -> float:
        """Mass with liquid and contents."""
        inside = self.contents(object_id)
        return sum(self.object(name).mass_kg + self.liquid_kg(name) for name in (object_id, *inside))

    def needs_two_hands(self, object_id: str) -> bool:
        """Whether its type or its present weight asks for both hands."""
        thing = self.object(object_id)
        limit = min(arm.max_load_kg for arm in self._robot().arms.values())
        return thing.type.two_handed or self.total_mass_kg(object_id) > limit

    def _update_mass(self, thing: ObjectInstance) -> None:
        if not thing.movable:
            return
        body, lids = thing.body_id, list(thing.body_ids[1:])
        total, moving = thing.mass_kg + self.liquid_kg(thing.object_id), float(self._base_mass[lids].sum())
        # what it holds weighs on the object itself: its door or lid stays as heavy as it is, unless all is lighter than that
        share = min(1.0, 0.5 * total / moving) if moving > 0.0 else 1.0
        factor = (total - share * moving) / float(self._base_mass[body])
        for index, by in ((body, factor), *((lid, share) for lid in lids)):
            self.model.body_mass[index] = self._base_mass[index] * by
            self.model.body_inertia[index] = self._base_inertia[index] * by
        self.model.body_subtreemass[body] = total

    def metadata(self) -> dict[str, Any]:
        """AI2-THOR-style state of the scene, see `sim.world.metadata`."""
        return world_metadata(self)

    # ---- pictures -----------------------------------------------------------------------------------------------------------

    def render(
        self, camera: str = "head", height: int = 112, width: int = 112, *, depth: bool = False, segmentation: bool = False
    ) -> View:
        """Draws a camera of `sim.world.rendering.CAMERAS`; OpenGL contexts are shared by equal scenes."""
        return self._renderer(height, width).view(camera, depth=depth, segmentation=segmentation)

    def labels(self, camera: str = "head", height: int = 112, width: int = 112) -> NDArray[np.int32]:
        """(H, W) segmentation of a camera as in `View`, for less than half of what a picture with it costs."""
        return self._renderer(height, width).labels(camera)

    def _renderer(self, height: int, width: int) -> Renderer:
        renderer = self._renderers.get((height, width))
        if renderer is None:
            renderer = self._renderers[height, width] = Renderer(self, height, width)
        return renderer

    def visible_objects(
        self, segmentation: NDArray[np.int32] | None = None, *, min_pixels: int = 6, range_m: float = 8.0
    ) -> dict[str, int]:
        """Objects in the head camera's view and the number of pixels each covers.

        Args:
            segmentation: (H, W) labels of a `View`; None draws 112 x 112.
            min_pixels: fewest pixels that count, for an image of 112 x 112; scaled with the image's area.
            range_m: farthest horizontal distance from the base.
        """
        if segmentation is None:
            segmentation = self.labels()
        least = max(1.0, min_pixels * segmentation.size / 112**2)
        names = list(self.objects)
        labels, counts = np.unique(segmentation[segmentation >= 0], return_counts=True)
        found = {names[int(label)]: int(count) for label, count in zip(labels, counts, strict=True) if count >= least}
        return {name: count for name, count in found.items() if self.distance_to(name) <= range_m}

    @property
    def model_name(self) -> str:
        """Names the robot's file and the room: scenes of equal name have equal meshes and textures."""
        return f"{self._key.mjcf_path}|{self.room.name}"

    def close(self) -> None:
        """Drops the world's renderers; the shared OpenGL contexts stay with the process, and the world stays usable."""
        self._renderers.clear()

    # ---- snapshots ----------------------------------------------------------------------------------------------------------

    def save(self) -> WorldSnapshot:
        """Everything the future depends on."""
        physics, arrays = read_physics(self.model, self.data)
        objects = {
            name: {
                "state": copy_state(thing.state),
                "held_by": list(thing.held_by),
                "openness": thing.openness,
                "mass_kg": thing.mass_kg,
            }
            for name, thing in self.objects.items()
        }
        released = list(self.constraints.released) if self.constraints is not None else []
        counters = {
            "steps": self._steps,
            "speeds": dict(self._speeds),
            "released": released,
            "liquids": self.liquids.copy(),
        }
        frames = tuple(self.recorder.frames) if self.recorder is not None else ()
        return WorldSnapshot(
            repr(self._key),
            physics,
            arrays,
            objects,
            counters,
            frames,
            dict(self.rng.bit_generator.state),
        )

    def restore(self, snapshot: WorldSnapshot) -> None:
        """Returns to a saved moment.

        Raises:
            WorldError: when the snapshot is of another scene.
        """
        if snapshot.scene != repr(self._key):
            raise WorldError(f"the snapshot is of another scene: {snapshot.scene[:120]!r}")
        for name, values in snapshot.objects.items():
            thing = self.objects[name]
            thing.state = ObjectState(**values["state"])
            thing.held_by = list(values["held_by"])
            thing.openness, thing.mass_kg = values["openness"], values["mass_kg"]
        self._steps = snapshot.counters["steps"]
        self._speeds = dict(snapshot.counters["speeds"])
        self.liquids = snapshot.counters["liquids"].copy()
        if self.constraints is not None:
            self.constraints.released = list(snapshot.counters["released"])
        if self.recorder is not None:
            self.recorder.frames.clear()
            self.recorder.frames.extend(snapshot.history)
        self.rng.bit_generator.state = snapshot.rng
        write_physics(self.model, self.data, snapshot.physics, snapshot.model)


def _scene_key(robot: RobotSpec | None, room: str, ids: Sequence[str]) -> SceneKey:
    if robot is None:
        return SceneKey("", "", "", (), room, tuple(sorted(ids)))
    spec = mujoco.MjSpec.from_file(str(robot.mjcf_path)) if robot.mjcf_path not in _HANDS else None
    if spec is not None:
        _HANDS[robot.mjcf_path] = tuple(spec.site(robot.arms[side].grasp_site).parent.name for side in SIDES)
    hands = _HANDS[robot.mjcf_path]
    return SceneKey(robot.name, str(robot.mjcf_path), robot.root_body, hands, room, tuple(sorted(ids)))


@functools.lru_cache(maxsize=24)
def _indexed(
    key: SceneKey, names: tuple[str, ...], catalogue: Catalogue
) -> tuple[dict[str, ObjectInstance], dict[str, list[tuple[int, Part]]], NDArray[np.int64]]:
    """What belongs to which object of a compiled scene: objects to be copied, parts by geom, and the object of each geom."""
    model = compile_scene(key)
    objects = {name: index_object(model, name, catalogue) for name in names}
    owners = np.full(model.ngeom, -1, dtype=np.int64)
    for index, thing in enumerate(objects.values()):
        owners[thing.geom_ids] = index
    return objects, {name: _parts(model, thing) for name, thing in objects.items()}, owners


def _parts(model: mujoco.MjModel, thing: ObjectInstance) -> list[tuple[int, Part]]:
    """Visible geoms of an object with the catalogue part each was built from."""
    sources = {f"{thing.object_id}/{i}": part for i, part in enumerate(thing.type.parts)}
    for moving in thing.type.moving:
        sources |= {f"{thing.object_id}/{moving.name}/{i}": part for i, part in enumerate(moving.parts)}
    found: list[tuple[int, Part]] = []
    for geom in thing.geom_ids:
        name = str(model.geom(int(geom)).name)
        if name.endswith("/foot"):
            continue
        part = sources.get(name) or sources.get(name.rsplit("/", 1)[0])
        if part is not None:
            found.append((int(geom), part))
    return found


_HANDS: dict[Any, tuple[str, ...]] = {}
