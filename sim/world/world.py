"""A running scene: one robot, one room, its objects; servo targets in, physics forward, states out.

`World` builds a scene and advances it. What there is to know or to change in it belongs to one owner each: `poses`,
`containment`, `doors`, `states`, `liquids`, `thermal`, `impacts`, `appearance`, `servos`, `grasps`, `cameras`. Skills write
servo targets, call `advance`, and decide when a grasp is justified. Everything a later step depends on is in `save()`.
Paper: the DualTHOR simulator. Left out: balance in physics (the base is servoed), fluid dynamics, cloth.

Frames: world, z up, metres, radians; the base pose is (x, y, pelvis height, yaw); the trunk's forward lean follows
from the height.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final

import mujoco
import numpy as np
from numpy.typing import NDArray

from interface.bodies import SIDES
from robots.build_solver import robot_kit
from robots.spec import RobotSpec
from sim.scene.catalogue import load_catalogue
from sim.scene.compiler import BASE_JOINTS, TIMESTEP_S
from sim.scene.objects import ObjectInstance, ObjectPlacement, Placement
from sim.scene.rooms import Room, load_room
from sim.world.appearance import Appearance
from sim.world.containment import Containment
from sim.world.doors import Doors
from sim.world.grasps import Grasps
from sim.world.impacts import Impacts
from sim.world.liquids import LiquidLedger
from sim.world.masses import Masses
from sim.world.placement import OVERHANG_SHARE, REACH_BAND_M
from sim.world.poses import ObjectPoses
from sim.world.recorder import FRAME_DT_S, MotionWindow, Recorder
from sim.world.rendering import Cameras
from sim.world.scene_state import WorldError, build_scene
from sim.world.servos import Servos
from sim.world.snapshot import WorldSnapshot, read_physics, write_physics
from sim.world.states import ObjectStates
from sim.world.thermal import Thermal

#: How often liquids flow from taps, and temperatures change, seconds of simulated time.
TICK_S: Final = 1.0
_STEPS_PER_FRAME: Final = round(FRAME_DT_S / TIMESTEP_S)
_FRAMES_PER_TICK: Final = round(TICK_S / FRAME_DT_S)
#: Free distance between objects that the world places by itself: a hand fits between.
_HAND_GAP_M: Final = 0.09
#: A free body further than this from the room's centre has not been placed yet.
_PARKED_M: Final = 15.0


def own_placements(room: Room) -> list[ObjectPlacement]:
    """A room's own objects, where they stand when nothing else is said."""
    return [ObjectPlacement(item.id, item.receptacle, yaw_deg=item.yaw_deg) for item in room.objects]


class World:
    """One robot in one furnished room.

    Args:
        robot: description from `robots.spec.load_robot`, None for a room alone.
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
        scene: the running scene, which all owners share; `model`, `data` and `objects` are its own.
        rng: the world's random stream, part of snapshots.
        recorder: 20 Hz motion recorder, None without a robot.
        poses: where objects are.
        containment: what stands on or in what.
        doors: how far doors, drawers and lids stand open.
        states: what is on, broken, filled, dirty, cooked, sliced, used up.
        liquids: what vessels and puddles hold, and where it came from.
        thermal: temperatures and cooking.
        impacts: breakage.
        appearance: how states look.
        servos: the robot's joints and their targets.
        grasps: what its hands hold.
        cameras: pictures.

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
            placements = own_placements(self.room)
        ids = [placement.object_id for placement in placements]
        fixed = [item.id for item in self.room.furniture]
        repeated = sorted({name for name in ids if ids.count(name) > 1} | (set(ids) & set(fixed)))
        if repeated:
            raise WorldError(f"object {repeated[0]!r} exists twice in {self.room.name}")
        self.scene = scene = build_scene(robot, self.room, self.catalogue, fixed, ids)
        self.model, self.data, self.objects = scene.model, scene.data, scene.objects
        self.recorder = None if robot is None else Recorder(self.model, robot)
        self.poses, self.containment, self.doors = ObjectPoses(scene), Containment(scene), Doors(scene)
        self.servos = Servos(scene, self.recorder)
        masses, self.appearance = Masses(scene), Appearance(scene)
        self.liquids = LiquidLedger(scene, self.poses, masses, self.appearance)
        self.states = ObjectStates(scene, self.liquids, masses, self.appearance)
        self.thermal, self.impacts = Thermal(scene, self.containment, self.states), Impacts(scene, self.poses, self.states)
        self.cameras = Cameras(scene, self.poses, self.servos)
        self._steps = 0
        if robot is not None:
            self._reset_robot(robot, start, pelvis_height_m, joint_positions or {})
        for item in self.objects.values():
            if item.type.starts_open > 0.0:
                self._start_state(item, {"openness": item.type.starts_open})
        for name, values in (states or {}).items():
            self._start_state(self.object(name), values)
        for placement in placements:
            self._place(placement)
        self._grasps = None if robot is None else Grasps(scene, self.servos, self.poses)
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
        self.servos.hold_still()
        mujoco.mj_forward(self.model, self.data)

    def _follow_couplings(self) -> None:
        """Sets coupled finger joints from their leading joints."""
        model, data = self.model, self.data
        for eq in range(model.neq):
            if int(model.eq_type[eq]) != int(mujoco.mjtEq.mjEQ_JOINT) or model.eq_obj2id[eq] < 0:
                continue
            follower, leader = (int(model.jnt_qposadr[j]) for j in (model.eq_obj1id[eq], model.eq_obj2id[eq]))
            data.qpos[follower] = np.polyval(model.eq_data[eq, 4::-1], data.qpos[leader])

    def _place(self, placement: Placement) -> None:
        item, carrier = self.object(placement.object_id), self.object(placement.receptacle)
        mujoco.mj_kinematics(self.model, self.data)
        pending = [
            name for name, other in self.objects.items() if other.movable and self.data.xpos[other.body_id, 1] > _PARKED_M
        ]
        if carrier.object_id in pending:
            raise WorldError(f"{placement.object_id} is placed on {carrier.object_id} before that has its own place")
        target = None if placement.xy is None else np.asarray(placement.xy, dtype=float)
        spot: NDArray[np.float64] | None = None
        # An explicit place only has to carry the object: it may stand a little over the edge.
        narrow = OVERHANG_SHARE * float(np.min(item.local_max[:2] - item.local_min[:2])) / 2.0
        for gap in (0.0,) if target is not None else (_HAND_GAP_M, 0.04, 0.01):
            spot = self.containment.free_spot(
                carrier.object_id,
                item.footprint_radius_m if target is None else narrow,
                height_m=item.height_m,
                near=target,
                rng=self.rng,
                gap_m=gap,
                ignore=(item.object_id, *pending),
                band_m=10.0 if target is not None else REACH_BAND_M,
                through_doors=True,
            )
            if spot is not None:
                break
        if spot is None:
            raise WorldError(f"no room for {placement.object_id} on {placement.receptacle} in {self.room.name}")
        if target is not None:
            if np.linalg.norm(spot[:2] - target) > 0.03:
                raise WorldError(
                    f"{placement.object_id} does not fit at {placement.xy} on {placement.receptacle}; nearest is {spot[:2]}"
                )
            spot[:2] = target
        half = np.radians(placement.yaw_deg) / 2.0
        adr = item.qpos_adr
        self.data.qpos[adr : adr + 3] = spot + np.array([0.0, 0.0, 0.002 - item.local_min[2]])
        self.data.qpos[adr + 3 : adr + 7] = (np.cos(half), 0.0, 0.0, np.sin(half))
        self._start_state(item, placement.state)
        mujoco.mj_kinematics(self.model, self.data)

    def _start_state(self, item: ObjectInstance, values: Mapping[str, bool | float | str]) -> None:
        for name, value in values.items():
            if name in ("isOpen", "openness"):
                self.doors.put(item, float(value))
            elif name == "selfClosing":
                self.doors.set_self_closing(item, bool(value))
            elif name == "mass":
                self.states.set_mass(item.object_id, float(value))
            else:
                self.states.set_state(item.object_id, name, value)

    def _settle(self, seconds: float) -> None:
        for _ in range(round(seconds / TIMESTEP_S)):
            mujoco.mj_step(self.model, self.data)
        self.data.qvel[:] = 0.0
        self.data.qacc_warmstart[:] = 0.0
        self.data.time = 0.0
        mujoco.mj_forward(self.model, self.data)
        self.doors.update()
        if self.recorder is not None:
            self.recorder.fill(self.data)
        self.thermal.settle()
        for item in self.objects.values():
            self.appearance.update(item)

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
        self.doors.update()

    def _frame(self) -> None:
        if not np.isfinite(self.data.qpos).all() or int(self.data.warning[int(mujoco.mjtWarning.mjWARN_BADQACC)].number):
            raise WorldError(f"physics diverged at {self.time_s:.3f} s in {self.room.name}")
        mujoco.mj_kinematics(self.model, self.data)
        if self.recorder is not None:
            self.recorder.record(self.data)
        if self._grasps is not None:
            self._grasps.settle()
        self.liquids.run_out(FRAME_DT_S)
        self.impacts.step()
        if (self._steps // _STEPS_PER_FRAME) % _FRAMES_PER_TICK == 0:
            self.liquids.flow(TICK_S)
            self.thermal.step(TICK_S)

    # ---- owners that not every world has ------------------------------------------------------------------------------------

    @property
    def grasps(self) -> Grasps:
        """What the robot's hands hold.

        Raises:
            WorldError: when the room is without a robot.
        """
        self.scene.the_robot()
        assert self._grasps is not None
        return self._grasps

    def motion(self, frames: int = 64) -> MotionWindow:
        """The last frames of the robot's motion at 20 Hz.

        Raises:
            WorldError: when the room is without a robot.
        """
        self.scene.the_robot()
        assert self.recorder is not None
        return self.recorder.window(frames)

    def object(self, object_id: str) -> ObjectInstance:
        """The object of that id.

        Raises:
            WorldError: on an unknown id; the message lists the known ones.
        """
        return self.scene.object(object_id)

    # ---- snapshots ----------------------------------------------------------------------------------------------------------

    def save(self) -> WorldSnapshot:
        """A snapshot of everything that the future depends on."""
        physics, arrays = read_physics(self.model, self.data)
        counters = {
            "steps": self._steps,
            "speeds": dict(self.impacts.speeds_m_s),
            "released": [] if self._grasps is None else list(self._grasps.constraints.released),
            "liquids": self.liquids.save(),
        }
        frames = tuple(self.recorder.frames) if self.recorder is not None else ()
        rng = dict(self.rng.bit_generator.state)
        return WorldSnapshot(self.scene.key, physics, arrays, self.states.save(), counters, frames, rng)

    def restore(self, snapshot: WorldSnapshot) -> None:
        """Returns to a saved moment.

        Raises:
            WorldError: when the snapshot is of another scene.
        """
        if snapshot.scene != self.scene.key:
            raise WorldError(f"the snapshot is of another scene: {snapshot.scene[:120]!r}")
        self.states.restore(snapshot.objects)
        self._steps = snapshot.counters["steps"]
        self.impacts.speeds_m_s = dict(snapshot.counters["speeds"])
        self.liquids.restore(snapshot.counters["liquids"])
        if self._grasps is not None:
            self._grasps.constraints.released = list(snapshot.counters["released"])
        if self.recorder is not None:
            self.recorder.frames.clear()
            self.recorder.frames.extend(snapshot.history)
        self.rng.bit_generator.state = snapshot.rng
        write_physics(self.model, self.data, snapshot.physics, snapshot.model)
