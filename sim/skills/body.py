"""The robot as skills see it: commanded posture, inverse kinematics in the world, hands, and what they hold.

Skills own disjoint sets of joints: an arm skill its arm and hand, a body skill base and legs, a two-arm skill both arms and the
waist. `Body` has no state of its own: what is commanded is in the simulator's controls and what is held in the objects, so that
a world snapshot is a snapshot of everything. The waist stays straight while a single arm acts, so that parallel arm skills do
not disturb each other.

Paper: low-level control through inverse kinematics (each arm alone, or the whole body).
Frames: `world`; `pelvis` is the pelvis heading frame.
"""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from typing import Any, Final

import mujoco
import numpy as np
from numpy.typing import NDArray

from data.interface.bodies import Arm
from data.interface.steps import Action
from sim.robots.arm_ik import PerArmSolver
from sim.robots.build_solver import RobotKit, robot_kit
from sim.robots.self_collision import SELF_TOUCH_M
from sim.robots.solver import ReachTarget
from sim.scene.compiler import BASE_JOINTS
from sim.scene.objects import ObjectInstance
from sim.skills.clearance import ClearanceProbe
from sim.skills.footsteps import footsteps
from sim.skills.gait import leg_motion
from sim.skills.hypothesis import Hypothesis
from sim.skills.navigation import NavigationMap, Stance
from sim.skills.obstacles import navigation_map
from sim.skills.reach_map import WOUND_RAD, HandPose, ReachMap, reach_maps
from sim.skills.runner import CONTROL_DT_S, Skill
from sim.skills.trajectory import Trajectory, plan
from sim.world.placement import OVERHANG_SHARE
from sim.world.world import World

__all__ = ["ArmGoal", "Body", "BothGoal", "ready_posture", "wait"]

Array = NDArray[np.float64]

ARM_SPEED_RAD_S: Final = 3.8
ARM_ACCELERATION_RAD_S2: Final = 20.0
#: Height of the highest surfaces that a robot walks up to with a load, with some room below the load.
_WORKTOP_M: Final = 0.97
HAND_SECONDS: Final = 0.35
#: Position error of an arm posture that still counts as reaching.
REACH_TOLERANCE_M: Final = 0.012
#: How far the ready hand is below the shoulder, as a share of the arm's reach: usually, for robots whose hands would then be
#: lower than worktops, and with a load of such robots.
_READY_DROP, _LOW_READY_DROP, _LOW_CARRY_DROP = 0.17, -0.04, -0.16
#: Share of the shoulders' way forward in a lean by which the robot stands farther from things.
_LEANING: Final = 0.6
#: Steps of pelvis height tried when a target is out of reach, metres.
_HEIGHT_STEP_M: Final = 0.05


@dataclass(frozen=True, slots=True)
class ArmGoal:
    """A solved arm posture.

    Attributes:
        q: (A,) arm joints.
        error_m: distance of the grasp site from the wish.
        pointing_cos, closing_cos: how well the hand's axes agree with the wish, 1 where it left them open.
        pointing, closing: (3,) directions that the hand has then, world frame.
    """

    q: Array
    error_m: float
    pointing_cos: float
    closing_cos: float
    pointing: Array
    closing: Array


@dataclass(frozen=True, slots=True)
class BothGoal:
    """A solved posture of both arms and the waist.

    Attributes:
        arms: (A,) joints per arm.
        waist: waist joints.
        error_m: largest distance of a grasp site from its wish.
        tilt_rad: largest angle between a wished and a reached pointing direction.
    """

    arms: Mapping[Arm, Array]
    waist: Array
    error_m: float
    tilt_rad: float = 0.0


@dataclass(slots=True)
class Plans:
    """Plans of actions from one state, see `sim.skills.plan_cache`."""

    state: object = None
    made: dict[Action, Any] = field(default_factory=dict)


class Body:
    """One robot in a world."""

    def __init__(self, world: World) -> None:
        self.world = world
        if world.robot is None:
            raise ValueError("skills need a world with a robot, got one without")
        self.spec = world.robot
        kit = robot_kit(self.spec)
        self.kit = kit
        self.kinematics = kit.model
        self.crouches = kit.crouches
        self.whole_body = kit.solver
        self._per_arm = PerArmSolver(kit.model, kit.crouches)
        self.maps: Mapping[str, ReachMap] = reach_maps(kit)
        model = world.model
        self._actuators = {name: int(model.actuator(name).id) for name in self.spec.joints if _has_actuator(model, name)}
        self._base = [int(model.actuator(name).id) for name in BASE_JOINTS]  # x, y, z, yaw, pitch
        self._joint_adr = np.array([int(model.joint(name).qposadr[0]) for name in self.spec.joints])
        self._site = {arm: int(model.site(self.spec.arms[arm.value].grasp_site).id) for arm in Arm}
        self._arm_ids = {arm: np.array([self._actuators[name] for name in self.spec.arms[arm.value].joints]) for arm in Arm}
        self._hand_ids = {
            arm: np.array([self._actuators[name] for name in self.spec.arms[arm.value].hand_joints]) for arm in Arm
        }
        self._waist_ids = np.array([self._actuators[name] for name in self.spec.waist_joints])
        self._lag_s = _lags(model)
        self._arm_adr = {
            arm: np.array([int(model.joint(n).qposadr[0]) for n in self.spec.arms[arm.value].joints]) for arm in Arm
        }
        self._leg_ids = np.array([self._actuators[name] for name in self.spec.leg_joints])
        self._hand_joints = np.array([int(model.joint(n).id) for arm in Arm for n in self.spec.arms[arm.value].hand_joints])
        sliding = model.jnt_type[self._hand_joints] == int(mujoco.mjtJoint.mjJNT_SLIDE)
        self._hand_scale = np.where(sliding, 0.2, 1.0)
        self._mine = np.where(np.isin(model.geom_bodyid, list(world.scene.robot_bodies)), 1, -1)
        self._columns = {arm: kit.model.indices(self.spec.arms[arm.value].joints) for arm in Arm}
        self.hypothesis = Hypothesis()
        self._vias: dict[Arm, tuple[Array, ...]] = {}
        self.plans = Plans()
        self.probe = ClearanceProbe(world, self)

    def planning_state(self) -> tuple[object, ...]:
        """Everything that a plan depends on: positions, commands, states and holders of objects, what is being considered."""
        data = self.world.data
        things = tuple(
            (dataclasses.astuple(thing.state), tuple(thing.held_by), thing.openness, thing.mass_kg)
            for thing in self.world.objects.values()
        )
        numbers = (data.qpos.tobytes(), data.ctrl.tobytes(), data.xpos.tobytes())
        return *numbers, things, self.hypothesis

    def assuming(
        self, stance: Stance | None = None, pelvis_height_m: float | None = None, diagnose: bool | None = None
    ) -> Body:
        """This body under a hypothesis: what it answers holds for another stance or height, and nothing moves.

        Args:
            stance: assumed stance; None keeps what is assumed or commanded already.
            pelvis_height_m: assumed pelvis height, metres; None likewise.
            diagnose: whether refusals say what is wrong; None likewise.
        """
        now, there = self.hypothesis, copy.copy(self)
        there.hypothesis = Hypothesis(
            now.stance if stance is None else stance,
            now.pelvis_height_m if pelvis_height_m is None else pelvis_height_m,
            now.diagnose if diagnose is None else diagnose,
        )
        there.probe = self.probe.assuming(there)
        return there

    # ---- base and legs

    def base(self) -> Stance:
        """Where the base is."""
        x, y, _, yaw = self.world.servos.base_pose[:4]
        return Stance(float(x), float(y), float(yaw))

    def commanded_base(self) -> Stance:
        """Where the base is told to be, or is assumed to be."""
        if self.hypothesis.stance is not None:
            return self.hypothesis.stance
        x, y, _, yaw = self.world.data.ctrl[self._base[:4]]
        return Stance(float(x), float(y), float(yaw))

    @property
    def pelvis_height_m(self) -> float:
        """Commanded pelvis height, or the assumed one."""
        assumed = self.hypothesis.pelvis_height_m
        return float(self.world.data.ctrl[self._base[2]]) if assumed is None else assumed

    def base_error_m(self) -> float:
        """Distance between commanded and actual base, the heading weighed with 0.3 m per radian."""
        x, y, z, yaw = self.world.data.ctrl[self._base[:4]] - self.world.servos.base_pose[:4]
        return float(np.sqrt(x * x + y * y + z * z + (0.3 * yaw) ** 2))

    def command_base(self, x: float, y: float, yaw_rad: float) -> None:
        """Sets the base target, world frame."""
        self.world.data.ctrl[[self._base[0], self._base[1], self._base[3]]] = (x, y, yaw_rad)

    def command_height(self, pelvis_height_m: float) -> None:
        """Sets the pelvis height and the legs that go with it."""
        self.world.servos.command_height(pelvis_height_m)

    def command_legs(self, joints: Array) -> None:
        """Sets the leg joints' targets (L,)."""
        self.world.data.ctrl[self._leg_ids] = joints

    def walking_targets(self, way: Array) -> tuple[Array, Array]:
        """Servo targets that take base and feet along a way (T, 3) of x, y and yaw, ahead by what the servos lag behind.

        Returns:
            (T, 3) base targets and (T, L) leg joints; the last ones are at rest.
        """
        root = np.array([0.0, 0.0, 0.0, *_quaternion_about_y(self.crouches.pitch(self.pelvis_height_m))])
        soles = self.kinematics.frames(root, self.crouches.posture(self.pelvis_height_m), ("left_sole", "right_sole"))
        legs = leg_motion(footsteps(self.kit), self.pelvis_height_m, soles[:, :2, 3], way)
        base_ids = np.array([self._base[0], self._base[1], self._base[3]])
        return _ahead(way, self._lag_s[base_ids]), _ahead(legs, self._lag_s[self._leg_ids])

    def _pressed(self) -> tuple[float, bool]:
        """How deep the robot presses into anything that it does not hold, metres, and whether it touches anything."""
        data = self.world.data
        if data.ncon == 0:
            return 0.0, False
        owner = self._contact_owner()[data.contact.geom[: data.ncon]]  # (C, 2): 1 robot, 0 held, -1 else
        touching = np.prod(owner, axis=1) < 0
        return float(-np.min(data.contact.dist[: data.ncon][touching], initial=0.0)), bool(touching.any())

    def fits(self, stance: Stance) -> bool:
        """Whether arms and hands, as they are commanded, would touch nothing at a stance."""
        there = self.assuming(stance=stance)
        return all(there.probe.free(arm, [self.commanded_arm(arm)]) for arm in Arm)

    def pushed(self) -> Array:
        """(3,) how much the robot is pushed by what it runs into.

        How deep it presses (m), how far the hands' joints are bent beyond their limits (rad, and m / 0.2 of sliding ones), and
        how far an arm's joint is from its target (rad), which is what yields first; 0 for the last one while nothing touches.
        """
        model, data = self.world.model, self.world.data
        depth_m, touches = self._pressed()
        values, scale = data.qpos[model.jnt_qposadr[self._hand_joints]], self._hand_scale
        low, high = model.jnt_range[self._hand_joints].T
        bent = float(np.max(np.maximum(low - values, values - high) / scale, initial=0.0))
        off = max(float(np.max(np.abs(data.qpos[self._arm_adr[arm]] - data.ctrl[self._arm_ids[arm]]))) for arm in Arm)
        return np.array([depth_m, bent, off if touches else 0.0])

    def _contact_owner(self) -> NDArray[np.int64]:
        """(ngeom,) 1 for the robot's geoms, 0 for those of what it holds, -1 for all others."""
        owner = self._mine.copy()
        for thing in self.world.objects.values():
            if thing.held_by:
                owner[thing.geom_ids] = 0
        return owner

    def navigation(self) -> NavigationMap:
        """Free space for the base, as the room is now; a robot that leans forward keeps farther away."""
        return navigation_map(self.world, self.spec.footprint_radius_m + self._leaning_m())

    def comfortable_distance_m(self) -> tuple[float, float]:
        """Horizontal distances between pelvis and object at which the arms work best: 55 to 80 % of the stretched arm."""
        reach, leaning = self.maps["left"].reach_m, self._leaning_m()
        return 0.55 * reach + leaning, 0.8 * reach + leaning

    def _leaning_m(self) -> float:
        """By how much the trunk's lean brings the hands forward, the most of it, rounded so that maps are shared."""
        shoulder = self.maps["left"].shoulder
        ahead = float((self._lean(self.pelvis_height_m) @ shoulder)[0] - shoulder[0])
        return round(_LEANING * max(ahead, 0.0), 2)

    # ---- objects

    def thing(self, object_id: str) -> ObjectInstance:
        """An object of the scene by id."""
        return self.world.objects[object_id]

    def world_position(self, object_id: str) -> Array:
        """(3,) centre of an object's bounding box in the world."""
        thing = self.thing(object_id)
        rotation = self.world.data.xmat[thing.body_id].reshape(3, 3)
        return self.world.data.xpos[thing.body_id] + rotation @ (0.5 * (thing.local_min + thing.local_max))

    def subject(self, action: Action) -> str:
        """Id of the object whose luck decides an action: what is put down, else what the action names."""
        if action.name == "Place" and action.arm is not None:
            return self.held[action.arm] or action.object_id or ""
        if action.name == "PlaceBoth":
            return self.lifted or action.object_id or ""
        if action.name in ("Pour", "Fill") and action.arm is not None:
            return self.held[action.arm] or action.object_id or ""
        return action.object_id or ""

    def solid_geoms(self, thing: ObjectInstance) -> NDArray[np.int64]:
        """Geoms of an object that take part in contacts."""
        return thing.geom_ids[self.world.model.geom_contype[thing.geom_ids] > 0]

    def part_geoms(self, thing: ObjectInstance, option: str) -> NDArray[np.int64]:
        """Geoms of an object's parts with a catalogue option, such as `handle` or `toggle`."""
        return np.array(
            [geom for geom, part in self.world.scene.part_of_geom[thing.object_id] if option in part.options], dtype=np.int64
        )

    def interaction_point(self, object_id: str) -> Array:
        """(3,) world point that a robot who goes to an object wants before it: handle, inside, switch or centre."""
        thing = self.thing(object_id)
        if thing.movable and thing.type.lidded:  # to lift it as well as to open it
            return self.world_position(object_id)
        if thing.is_shut and thing.moving[0].handle_site >= 0:
            return self.world.data.site_xpos[thing.moving[0].handle_site].copy()
        if thing.type.encloses:
            surface = thing.surfaces[0]
            local = np.array([surface.spec.rect[0], surface.spec.rect[1], surface.spec.z]) - surface.origin
            return self.world.data.xpos[surface.body_id] + self.world.data.xmat[surface.body_id].reshape(3, 3) @ local
        if thing.toggle_site >= 0 and not thing.type.pickupable:
            return self.world.data.site_xpos[thing.toggle_site].copy()
        return self.world_position(object_id)

    def faces_rad(self, object_id: str) -> tuple[float, ...]:
        """World directions out of an object in which a robot stands well: square to what carries it, or to its own sides."""
        thing = self.thing(object_id)
        square = thing
        if thing.movable and not self.world.containment.needs_two_hands(object_id):
            carriers = self.world.containment.parents(object_id)
            if not carriers:
                return ()
            square = self.thing(carriers[-1])
        # a tap may stand beside its basin, which is used from the basin's front
        front = self.world.poses.front(self.world.room.links.get(square.object_id, square.object_id))
        angle = float(np.arctan2(front[1], front[0]))
        sides = square.movable or any(surface.spec.all_sides for surface in square.surfaces)
        return tuple(angle + k * np.pi / 2.0 for k in range(4)) if sides else (angle,)

    def rests(self, thing: ObjectInstance) -> bool:
        """Whether an object touches something that is not part of the robot, from above."""
        data, mine = self.world.data, set(map(int, thing.geom_ids))
        owner = self.world.scene.object_of_geom
        for contact in data.contact[: data.ncon]:
            a, b = int(contact.geom1), int(contact.geom2)
            other = b if a in mine else a if b in mine else -1
            if other >= 0 and (owner[other] >= 0 or other == 0) and abs(float(contact.frame[2])) > 0.6 and contact.dist < 0.0:
                return True
        return False

    def free_spots(self, thing: ObjectInstance, receptacle: ObjectInstance, arm: Arm | None, count: int = 4) -> list[Array]:
        """Free spots (3,) on a receptacle for an object, the ones the arm reaches most easily first."""
        easy = self.easy_point(arm)
        spots: list[Array] = []
        # What two hands carry is held with its long side across: its narrow side may stand a little over the edge.
        narrow = 0.5 * OVERHANG_SHARE * float(np.min(thing.local_max[:2] - thing.local_min[:2]))
        radius = thing.footprint_radius_m if arm is not None else narrow
        for gap in (0.04, 0.01):
            for dx, dy in (
                (0.0, 0.0),
                (0.0, 0.12),
                (0.0, -0.12),
                (0.1, 0.0),
                (-0.1, 0.0),
                (0.0, 0.25),
                (0.0, -0.25),
                (0.15, 0.0),
            ):
                near = easy[:2] + self.turn_to_world(np.array([dx, dy, 0.0]))[:2]
                spot = self.world.containment.free_spot(
                    receptacle.object_id, radius, height_m=thing.height_m, near=near, gap_m=gap,
                    ignore=(thing.object_id,), band_m=10.0,
                )  # fmt: skip
                if spot is not None and all(float(np.linalg.norm(spot - known)) > 0.03 for known in spots):
                    spots.append(spot)
                if len(spots) >= count:
                    return spots
            if spots:
                return spots
        return spots

    def easy_point(self, arm: Arm | None) -> Array:
        """World point before the shoulder that the arm reaches most easily; between the shoulders for both arms."""
        low, high = self.comfortable_distance_m()
        side = 0.0 if arm is None else 0.6 if arm is Arm.LEFT else -0.6
        base = self.commanded_base()
        local = np.array([0.5 * (low + high), side * abs(float(self.maps["left"].shoulder[1])), 0.0])
        return self.turn_to_world(local) + (base.x, base.y, self.pelvis_height_m)

    @property
    def held(self) -> dict[Arm, str | None]:
        """What each hand holds."""
        found: dict[Arm, str | None] = dict.fromkeys(Arm)
        for name, thing in self.world.objects.items():
            for arm in thing.held_by:
                found[Arm(arm)] = name
        return found

    def at_furniture(self, arm: Arm | None = None) -> bool:
        """Whether a hand, any or the given one, is at a door or drawer, which a body on the move would tear at."""
        held = self.held.values() if arm is None else (self.held[arm],)
        return any(name is not None and not self.thing(name).movable for name in held)

    @property
    def lifted(self) -> str | None:
        """The object that both hands hold together."""
        return next((name for name, thing in self.world.objects.items() if len(thing.held_by) == 2), None)

    # ---- frames

    def to_pelvis(self, point: Array, pelvis_height_m: float | None = None, base: Stance | None = None) -> Array:
        """A world point in the pelvis frame, for a base and a pelvis height (the commanded ones by default)."""
        base = self.commanded_base() if base is None else base
        height = self.pelvis_height_m if pelvis_height_m is None else pelvis_height_m
        return self.turn_to_pelvis(np.asarray(point, dtype=float) - (base.x, base.y, height), base)

    def _wish_in_pelvis(self, wish: HandPose, pelvis_height_m: float, base: Stance | None = None) -> HandPose:
        return HandPose(
            self.to_pelvis(wish.position, pelvis_height_m, base),
            None if wish.pointing is None else self.turn_to_pelvis(wish.pointing, base),
            None if wish.closing is None else self.turn_to_pelvis(wish.closing, base),
            wish.either_way,
        )

    def turn_to_pelvis(self, direction: Array, base: Stance | None = None) -> Array:
        """A world direction in the pelvis frame."""
        yaw = (self.commanded_base() if base is None else base).yaw_rad
        c, s = np.cos(yaw), np.sin(yaw)
        return np.array([c * direction[0] + s * direction[1], -s * direction[0] + c * direction[1], direction[2]])

    def turn_to_world(self, direction: Array) -> Array:
        """A direction of the pelvis frame in the world."""
        yaw = self.commanded_base().yaw_rad
        c, s = np.cos(yaw), np.sin(yaw)
        return np.array([c * direction[0] - s * direction[1], s * direction[0] + c * direction[1], direction[2]])

    def in_trunk(self, point: Array, pelvis_height_m: float | None = None, base: Stance | None = None) -> Array:
        """A world point in the frame of the reach maps: the pelvis frame, turned with the trunk's lean."""
        height = self.pelvis_height_m if pelvis_height_m is None else pelvis_height_m
        return self._lean(height).T @ self.to_pelvis(point, height, base)

    def shoulder(self, arm: Arm) -> Array:
        """World position of a shoulder, from the commanded base."""
        base = self.commanded_base()
        x, y, z = self._lean(self.pelvis_height_m) @ self.maps[arm.value].shoulder
        c, s = np.cos(base.yaw_rad), np.sin(base.yaw_rad)
        return np.array([base.x + c * x - s * y, base.y + s * x + c * y, self.pelvis_height_m + z])

    def _lean(self, pelvis_height_m: float) -> Array:
        """(3, 3) rotation of the trunk's lean at a pelvis height, pelvis frame."""
        pitch = self.crouches.pitch(pelvis_height_m)
        c, s = np.cos(pitch), np.sin(pitch)
        return np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])

    # ---- inverse kinematics

    def joints(self) -> Array:
        """(J,) commanded joints where there is an actuator, measured ones elsewhere."""
        q = self.world.data.qpos[self._joint_adr].copy()
        for column, name in enumerate(self.spec.joints):
            if name in self._actuators:
                q[column] = self.world.data.ctrl[self._actuators[name]]
        return q

    def hand_pose(self, arm: Arm) -> tuple[Array, Array]:
        """Measured world position (3,) and rotation (3, 3) of the grasp site."""
        site = self._site[arm]
        return self.world.data.site_xpos[site].copy(), self.world.data.site_xmat[site].reshape(3, 3).copy()

    def hand_at(self, arm: Arm, q: Array) -> Array:
        """(3,) world position of the grasp site with an arm posture, from the commanded base."""
        return self.hand_pose_at(arm, q)[0]

    def hand_pose_at(self, arm: Arm, q: Array, base: Stance | None = None) -> tuple[Array, Array]:
        """World position (3,) and rotation (3, 3) of the grasp site with an arm posture.

        The base is the commanded one, or another that is turned like it.
        """
        full = self.kinematics.posture()
        full[self._columns[arm]] = q
        root = np.array([0.0, 0.0, 0.0, *_quaternion_about_y(self.crouches.pitch(self.pelvis_height_m))])
        base = self.commanded_base() if base is None else base
        frame = self.kinematics.frames(root, full, (self.spec.arms[arm.value].grasp_site,))[0]
        position = self.turn_to_world(frame[:3, 3]) + (base.x, base.y, self.pelvis_height_m)
        return position, np.stack([self.turn_to_world(axis) for axis in frame[:3, :3].T], axis=1)

    def commanded_arm(self, arm: Arm) -> Array:
        """(A,) commanded arm joints."""
        return self.world.data.ctrl[self._arm_ids[arm]].copy()

    def ready(self, arm: Arm) -> Array:
        """(A,) posture between actions: hand before the shoulder, fingers level, above tables and beside the camera's view."""
        return ready_posture(self.kit, arm)

    def carrying(self, arm: Arm) -> Array:
        """(A,) posture in which a hand carries something: the ready one, or higher and closer on robots with low shoulders.

        A load before a hand that is lower than a worktop would run into its front when the robot steps up to it.
        """
        return ready_posture(self.kit, arm, raised=_low_shoulders(self.kit))

    def solve(
        self,
        arm: Arm,
        wish: HandPose,
        start: Array | None = None,
        pelvis_height_m: float | None = None,
        base: Stance | None = None,
        pointing_weight: float = 0.1,
        roll_weight: float = 0.1,
    ) -> ArmGoal:
        """Solves one arm for a hand pose given in the world, waist straight, the other arm where it is told to be.

        An arm that is wound up or inside the robot's own body counts as far from its wish.

        Args:
            arm: which one.
            wish: the hand pose, position and directions in the world frame.
            start: (A,) joints to start from; the best postures of the reach map when None.
            pelvis_height_m: pelvis height to solve for, the commanded one by default.
            base: base pose to solve for, the commanded one by default.
            pointing_weight: weight of the fingers' direction against the position.
            roll_weight: weight of the closing direction.
        """
        height = self.pelvis_height_m if pelvis_height_m is None else pelvis_height_m
        lean = self._lean(height)
        local = self._wish_in_pelvis(wish, height, base)
        reach_map = self.maps[arm.value]
        starts: Sequence[Array]
        if start is None:
            upright = HandPose(
                lean.T @ local.position,
                None if local.pointing is None else lean.T @ local.pointing,
                None if local.closing is None else lean.T @ local.closing,
                local.either_way,
            )
            starts = list(reach_map.starts(upright, 2, near=self.ready(arm)))
        else:
            starts = [start]
        best: tuple[float, ArmGoal] | None = None
        q = self.kinematics.posture()
        for other in Arm:
            q[self._columns[other]] = self.commanded_arm(other)
        root = np.array([0.0, 0.0, 0.0, *_quaternion_about_y(self.crouches.pitch(height))])
        site = (self.spec.arms[arm.value].grasp_site,)
        for candidate in starts:
            q[self._columns[arm]] = candidate
            rotation = None
            if local.pointing is not None or local.closing is not None:
                hand = self.kinematics.frames(root, q, site)[0, :3, :3]
                rotation = local.rotation(hand[:, 0], hand[:, 1])
            target = ReachTarget(
                local.position,
                rotation,
                pointing_weight if local.pointing is not None else 0.0,
                roll_weight if local.closing is not None else 0.0,
            )
            result = self._per_arm.solve(
                {arm.value: target}, q, pelvis_height_m=height, restarts=0, tolerance_m=REACH_TOLERANCE_M
            )
            reached = self.kinematics.frames(root, result.q, site)[0, :3, :3]
            pointing = 1.0 if local.pointing is None else float(reached[:, 0] @ local.pointing)
            along = 1.0 if local.closing is None else float(reached[:, 1] @ local.closing)
            q_arm = result.q[self._columns[arm]].copy()
            wound = float(np.max(np.abs(q_arm - np.asarray(self.spec.arms[arm.value].carry))[:-1]))
            sound = wound < WOUND_RAD + 0.3 and result.self_clearance_m >= -SELF_TOUCH_M
            goal = ArmGoal(
                q_arm,
                result.position_error_m if sound else 1.0,
                pointing,
                abs(along) if local.either_way else along,
                self.turn_to_world(reached[:, 0]),
                self.turn_to_world(reached[:, 1]),
            )
            cost = 20.0 * max(goal.error_m - 0.5 * REACH_TOLERANCE_M, 0.0) + 2.0 - goal.pointing_cos - goal.closing_cos
            if best is None or cost < best[0]:
                best = (cost, goal)
            if goal.error_m <= REACH_TOLERANCE_M and goal.pointing_cos > 0.9 and goal.closing_cos > 0.9:
                break
        assert best is not None
        return best[1]

    def solve_both(self, wishes: Mapping[Arm, HandPose], start: Mapping[Arm, Array] | None = None) -> BothGoal:
        """Solves both arms as one problem with the robot's own solver.

        Args:
            wishes: world hand poses; pointing and closing must be given.
            start: (A,) joints per arm to start from; the best postures of the reach maps when None.
        """
        height = self.pelvis_height_m
        lean = self._lean(height)
        q = self.joints()
        targets: dict[str, ReachTarget] = {}
        for arm, wish in wishes.items():
            local = self._wish_in_pelvis(wish, height)
            if local.pointing is None or local.closing is None:
                raise ValueError(f"both directions of the {arm} hand must be given, got {wish}")
            rotation = local.rotation(local.pointing, local.closing)
            targets[arm.value] = ReachTarget(local.position, rotation, 0.15, 0.08)
            upright = HandPose(lean.T @ local.position, lean.T @ local.pointing, lean.T @ local.closing)
            q[self._columns[arm]] = (
                self.maps[arm.value].starts(upright, 1, near=self.ready(arm))[0] if start is None else start[arm]
            )
        result = self.whole_body.solve(targets, q, pelvis_height_m=height, restarts=1, tolerance_m=REACH_TOLERANCE_M)
        waist = self.kinematics.indices(self.spec.waist_joints)
        arms = {arm: result.q[self._columns[arm]].copy() for arm in Arm}
        error = result.position_error_m if result.self_clearance_m >= -SELF_TOUCH_M else 1.0
        return BothGoal(arms, result.q[waist].copy(), error, result.rotation_error_rad)

    def heights(self) -> list[float]:
        """A grid over the robot's pelvis heights, metres."""
        low, high = self.spec.pelvis_height_range_m
        return [float(h) for h in np.linspace(low, high, max(2, int(np.ceil((high - low) / _HEIGHT_STEP_M)) + 1))]

    def within(self, arm: Arm, point: Array, pelvis_height_m: float, base: Stance | None = None) -> bool:
        """Whether a world point is within the arm's envelope at a pelvis height, from this stance or another one."""
        return self.maps[arm.value].contains(self.in_trunk(point, pelvis_height_m, base))

    def vias(self, arm: Arm) -> tuple[Array, ...]:
        """(A,) postures that lead around furniture edges: ready, hand forward at shoulder height, hand above the shoulder."""
        if arm not in self._vias:
            reach_map = self.maps[arm.value]
            high = reach_map.shoulder + reach_map.reach_m * np.array([0.6, 0.0, -0.05])
            forward = reach_map.starts(HandPose(high, np.array([1.0, 0.0, 0.0])), 1, near=self.ready(arm))[0]
            self._vias[arm] = (self.ready(arm), forward, ready_posture(self.kit, arm, raised=True))
        return self._vias[arm]

    # ---- motions

    def move_arm(self, arm: Arm, waypoints: Sequence[Array], speed: float = 1.0) -> Skill:
        """Moves the arm from its commanded posture straight to one (A,) waypoint after the other; `speed` scales the bounds."""
        ids = self._arm_ids[arm]
        for goal in waypoints:
            ends = np.stack([self.world.data.ctrl[ids].copy(), goal])
            way = plan(ends, ARM_SPEED_RAD_S * speed, ARM_ACCELERATION_RAD_S2 * speed * speed)
            yield from self._follow(way, ids)

    def _follow(self, way: Trajectory, ids: NDArray[np.int64]) -> Skill:
        """Sends servos along a trajectory, ahead of it by what they lag behind, so that the joints are where it says."""
        time_s = 0.0
        while time_s < way.duration_s:
            time_s += CONTROL_DT_S
            rate = (way.at(time_s + 0.5 * CONTROL_DT_S) - way.at(time_s - 0.5 * CONTROL_DT_S)) / CONTROL_DT_S
            self.world.data.ctrl[ids] = way.at(time_s) + (self._lag_s[ids] * rate if time_s < way.duration_s else 0.0)
            yield

    def touch(self, arm: Arm, goal: Array, geoms: NDArray[np.int64], speed: float = 1.0) -> Skill:
        """Moves the arm straight to (A,) joints, and stops where the hand touches one of some geoms."""
        ids = self._arm_ids[arm]
        way = plan(
            np.stack([self.world.data.ctrl[ids].copy(), goal]), ARM_SPEED_RAD_S * speed, ARM_ACCELERATION_RAD_S2 * speed * speed
        )
        time_s = 0.0
        while time_s < way.duration_s and self.probe.hand_gap_m(arm, geoms) > 0.0:
            time_s += CONTROL_DT_S
            self.world.data.ctrl[ids] = way.at(time_s)
            yield

    def command_arm(self, arm: Arm, q: Array) -> None:
        """Sets the arm joints' targets."""
        self.world.data.ctrl[self._arm_ids[arm]] = q

    def commanded_both(self) -> dict[Arm, Array]:
        """Commanded joints of both arms."""
        return {arm: self.commanded_arm(arm) for arm in Arm}

    def commanded_waist(self) -> Array:
        """Commanded waist joints."""
        return self.world.data.ctrl[self._waist_ids].copy()

    def move_both(self, goals: Sequence[BothGoal], speed: float = 1.0) -> Skill:
        """Moves both arms and the waist together straight to one goal after the other."""
        ids = np.concatenate([self._arm_ids[Arm.LEFT], self._arm_ids[Arm.RIGHT], self._waist_ids])
        for goal in goals:
            row = np.concatenate([goal.arms[Arm.LEFT], goal.arms[Arm.RIGHT], goal.waist])
            ends = np.stack([self.world.data.ctrl[ids].copy(), row])
            way = plan(ends, ARM_SPEED_RAD_S * speed, ARM_ACCELERATION_RAD_S2 * speed**2)
            yield from self._follow(way, ids)

    def hand_height(self, goal: BothGoal) -> float:
        """Mean height of both grasp sites in a posture, metres."""
        return float(np.mean([self.hand_at(arm, q)[2] for arm, q in goal.arms.items()]))

    def stow_both(self) -> Skill:
        """Both arms to their ready postures, waist straight."""
        ready = BothGoal({arm: self.ready(arm) for arm in Arm}, np.zeros(len(self._waist_ids)), 0.0)
        yield from self.move_both([ready])

    def palm_m(self) -> float:
        """Distance between the grasp site and the part of the hand that presses on a side."""
        return self.spec.hand.behind_m

    def hand_target(self, arm: Arm) -> Array:
        """Commanded hand joints."""
        return self.world.data.ctrl[self._hand_ids[arm]].copy()

    def command_hand(self, arm: Arm, opening: float) -> None:
        """Sets the hand between closed (0) and open (1)."""
        spec = self.spec.arms[arm.value]
        closed, opened = np.asarray(spec.hand_closed), np.asarray(spec.hand_open)
        self.world.data.ctrl[self._hand_ids[arm]] = closed + opening * (opened - closed)

    def hand_opening(self, arm: Arm) -> float:
        """Commanded opening, 0 closed to 1 open."""
        spec = self.spec.arms[arm.value]
        closed, opened = np.asarray(spec.hand_closed), np.asarray(spec.hand_open)
        span = opened - closed
        used = np.abs(span) > 1e-6
        return float(np.mean((self.hand_target(arm) - closed)[used] / span[used]))

    def move_hand(self, arm: Arm, opening: float, seconds: float = HAND_SECONDS) -> Skill:
        """Opens or closes the hand at a constant rate."""
        start = self.hand_opening(arm)
        if abs(start - opening) < 0.02:
            return
        steps = max(1, round(seconds / CONTROL_DT_S))
        for k in range(1, steps + 1):
            self.command_hand(arm, start + (opening - start) * k / steps)
            yield


@cache
def ready_posture(kit: RobotKit, arm: Arm, raised: bool = False) -> Array:
    """See `Body.ready` and `Body.carrying`; solved once per robot and arm."""
    reach_map = reach_maps(kit)[arm.value]
    inward = np.array([0.0, -1.0 if arm is Arm.LEFT else 1.0, 0.0])
    ahead = min(0.3 * reach_map.reach_m, kit.spec.footprint_radius_m - 0.06)  # the disc that navigation keeps free
    drop = _LOW_CARRY_DROP if raised else _LOW_READY_DROP if _low_shoulders(kit) else _READY_DROP
    point = np.array([ahead, reach_map.shoulder[1], reach_map.shoulder[2] - drop * reach_map.reach_m])
    wish = HandPose(point, np.array([1.0, 0.0, 0.0]), inward)
    solver = PerArmSolver(kit.model, kit.crouches)
    columns = kit.model.indices(kit.spec.arms[arm.value].joints)
    site = (kit.spec.arms[arm.value].grasp_site,)
    root = np.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0])
    rotation = wish.rotation(wish.pointing, inward) if wish.pointing is not None else np.eye(3)
    height = kit.spec.standing_pelvis_height_m
    elbow = kit.spec.key_bodies[f"{arm.value}_elbow"]
    tip_m = kit.spec.hand.tip_m
    best: tuple[float, Array] | None = None
    for start in reach_map.starts(wish, 60, radius_m=0.15, near=np.array(kit.spec.arms[arm.value].carry)):
        q = kit.model.posture()
        q[columns] = start
        target = ReachTarget(point, rotation, 0.3, 0.2)
        result = solver.solve({arm.value: target}, q, pelvis_height_m=height, restarts=0)
        hand, joint = kit.model.frames(root, result.q, (*site, elbow))
        away = result.q[columns] - kit.spec.arms[arm.value].carry
        # what reaches ahead must be above worktops: the elbow, and the fingers unless they point up
        low = max(float(joint[0, 3]) - 0.02, float(hand[0, 3] + tip_m * hand[0, 0]) - 0.3 + float(hand[2, 0]) * 0.1)
        cost = (
            5.0 * result.position_error_m
            + 0.5 * (1.0 - float(hand[0, 0]))
            + (1.0 - float(hand[:3, 1] @ inward))
            + 0.04 * float(away @ away)
            + 6.0 * max(low, 0.0)
            + 50.0 * max(-result.self_clearance_m, 0.0)
        )
        if best is None or cost < best[0]:
            best = (cost, result.q[columns].copy())
    assert best is not None
    return best[1]


def _low_shoulders(kit: RobotKit) -> bool:
    """Whether hands held as usual would be lower than worktops, and run into their fronts."""
    reach_map = reach_maps(kit)["left"]
    return kit.spec.standing_pelvis_height_m + float(reach_map.shoulder[2]) - _READY_DROP * reach_map.reach_m < _WORKTOP_M


def wait(seconds: float) -> Skill:
    """Lets physics run."""
    for _ in range(round(seconds / CONTROL_DT_S)):
        yield


def _ahead(targets: Array, lag_s: Array) -> Array:
    """Targets (T, N) of a motion that ends at rest, moved ahead by the servos' lags (N,)."""
    if len(targets) < 2:
        return targets
    rates = np.gradient(targets, CONTROL_DT_S, axis=0)
    rates[-1] = 0.0
    return targets + lag_s * rates


def _lags(model: mujoco.MjModel) -> Array:
    """(nu,) seconds that each position servo lags behind a steadily moving target: its damping over its stiffness."""
    stiffness = np.maximum(model.actuator_gainprm[:, 0], 1e-9)
    joints = model.actuator_trnid[:, 0]
    damping = model.dof_damping[model.jnt_dofadr[joints]].reshape(-1) - model.actuator_biasprm[:, 2]
    return damping / stiffness


def _has_actuator(model: mujoco.MjModel, name: str) -> bool:
    return mujoco.mj_name2id(model, int(mujoco.mjtObj.mjOBJ_ACTUATOR), name) >= 0


def _quaternion_about_y(angle_rad: float) -> Array:
    return np.array([np.cos(angle_rad / 2), 0.0, np.sin(angle_rad / 2), 0.0])
