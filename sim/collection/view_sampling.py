"""Views of posed robots: kinematics and a camera, no physics. The material of dense pretraining and of the point-map encoder.

A world is furnished at random, then the robot is put into many poses: places, headings, pelvis heights with the matching legs,
arms and hands. Two thirds of them are where GoTo would bring it, since from there a planner has to say what is in reach; from
elsewhere hardly anything is. Each view comes with depth, segmentation by type, what is visible where, and a motion window that
leads into the pose, so that a view has proprioception like any observation. Paper: the visual pretraining that a large model
brings along.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Final

import mujoco
import numpy as np
from numpy.typing import NDArray

from configs.schema.collect import CollectConfig
from data.motion import encode_frames, world_to_heading
from data.shards import encode_png
from interface.bodies import SIDES, Arm
from robots.build_solver import robot_kit
from sim.scene.catalogue import load_catalogue
from sim.scene.compiler import BASE_JOINTS
from sim.skills.body.body import Body
from sim.skills.body.ready import ready_posture
from sim.skills.locomotion import best_stance
from sim.skills.navigation import Stance
from sim.tasks.drafts import NoDraft
from sim.tasks.families import FAMILIES, draw
from sim.tasks.sample import UNSEEN_TYPES, rng_for, scene_of
from sim.tasks.task import Placement
from sim.world.recorder import HISTORY_FRAMES
from sim.world.rendering import Renderer, View
from sim.world.world import World, WorldError

Array = NDArray[np.float64]

_KEY_INSTANTS: Final = 7
_FACING_SHARE: Final = 0.7
_FACING_DISTANCE_M: Final = (0.3, 2.3)
#: Share of poses before something, as after GoTo, with these bearings of it (degrees), and what they are off by (m, rad).
_BEFORE_SHARE: Final = 0.65
_BEARINGS_DEG: Final = (0.0, 0.0, -20.0, 20.0, -40.0, 40.0)
_OFF: Final = (0.03, 0.08)
#: Share of poses that are about things to take, and how many of them a room has beyond those of a task, fewer where so many do
#: not fit: a planner asks for a mug where it would take it, and of what a picture shows most is furniture.
_MOVABLE_SHARE: Final = 0.75
_MORE: Final = ((8, 16), (6, 12), (4, 9), (1, 4))
_ATTEMPTS: Final = 25


@dataclass(frozen=True, slots=True)
class Pose:
    """A robot's posture in the world.

    Attributes:
        x_m, y_m, yaw_rad: base.
        height_m: pelvis.
        joints: arm and hand joints by name.
    """

    x_m: float
    y_m: float
    yaw_rad: float
    height_m: float
    joints: Mapping[str, float]

    def towards(self, other: Pose, share: float) -> Pose:
        """The pose at `share` (0..1) of the way to another."""

        def mix(a: float, b: float) -> float:
            return a + share * (b - a)

        turn = (other.yaw_rad - self.yaw_rad + np.pi) % (2.0 * np.pi) - np.pi
        joints = {name: mix(value, other.joints[name]) for name, value in self.joints.items()}
        return Pose(
            mix(self.x_m, other.x_m), mix(self.y_m, other.y_m), self.yaw_rad + share * float(turn),
            mix(self.height_m, other.height_m), joints,
        )  # fmt: skip


def type_names() -> tuple[str, ...]:
    """Names of the object types in the order of the segmentation's indices."""
    return tuple(load_catalogue().types)


def set_pose(world: World, pose: Pose) -> None:
    """Puts the robot into a pose: base, legs that fit the pelvis height, arms and hands; kinematics only."""
    assert world.robot is not None
    crouches = robot_kit(world.robot).crouches
    base = dict(zip(BASE_JOINTS, (pose.x_m, pose.y_m, pose.height_m, pose.yaw_rad, crouches.pitch(pose.height_m)), strict=True))
    legs = dict(zip(world.robot.leg_joints, map(float, crouches.legs(pose.height_m)), strict=True))
    for name, value in (base | legs | dict(pose.joints)).items():
        world.data.qpos[world.model.joint(name).qposadr[0]] = value
    mujoco.mj_kinematics(world.model, world.data)


def _place(body: Body, free: Array, rng: np.random.Generator) -> Stance:
    """A free place: anywhere, mostly facing something, or before a thing where GoTo would bring the robot."""
    world = body.world
    x, y = map(float, free[int(rng.integers(len(free)))])
    anywhere = Stance(x, y, float(rng.uniform(-np.pi, np.pi)))
    names = list(world.objects)
    movable = [name for name in names if world.objects[name].movable]
    pool = movable if movable and rng.random() < _MOVABLE_SHARE else names
    name = pool[int(rng.integers(len(pool)))]
    if rng.random() < _BEFORE_SHARE:
        found = best_stance(
            body.workspace.navigation(),
            anywhere,
            body.objects.interaction_point(name)[:2],
            body.workspace.comfortable_distance_m(),
            None,
            float(np.deg2rad(rng.choice(_BEARINGS_DEG))),
            body.objects.faces_rad(name),
        )
        if found is not None:
            x, y = map(float, found[0].position + rng.normal(0.0, _OFF[0], 2))
            return Stance(x, y, found[0].yaw_rad + float(rng.normal(0.0, _OFF[1])))
    if rng.random() < _FACING_SHARE:
        target = world.poses.center(name)[:2]
        gaps = np.linalg.norm(free - target, axis=1)
        near = free[(gaps > _FACING_DISTANCE_M[0]) & (gaps < _FACING_DISTANCE_M[1])]
        if len(near):
            x, y = map(float, near[int(rng.integers(len(near)))])
            return Stance(x, y, float(np.arctan2(target[1] - y, target[0] - x) + rng.normal(0.0, 0.3)))
    return anywhere


def draw_pose(body: Body, free: Array, rng: np.random.Generator) -> Pose:
    """A place, any pelvis height, arms ready, as between actions, raised or anywhere."""
    world, robot = body.world, body.spec
    stance = _place(body, free, rng)
    low, high = robot.pelvis_height_range_m
    height = high if rng.random() < 0.3 else float(rng.uniform(low, high))
    joints: dict[str, float] = {}
    for side in SIDES:
        arm = robot.arms[side]
        rest, carry = np.asarray(arm.rest), np.asarray(arm.carry)
        kind = rng.random()
        ready = ready_posture(robot_kit(robot), Arm(side))
        posture = ready if kind < 0.55 else rest + rng.random() * (carry - rest)
        if kind > 0.75:
            limits = np.array([world.model.joint(name).range for name in arm.joints])
            posture = rest + rng.uniform(0.0, 0.6) * (rng.uniform(limits[:, 0], limits[:, 1]) - rest)
        opening = 1.0 if rng.random() < 0.6 else float(rng.random())
        closed, opened = np.asarray(arm.hand_closed), np.asarray(arm.hand_open)
        joints |= dict(zip(arm.joints, map(float, posture), strict=True))
        joints |= dict(zip(arm.hand_joints, map(float, closed + opening * (opened - closed)), strict=True))
    return Pose(stance.x, stance.y, stance.yaw_rad, height, joints)


def lead_in(world: World, before: Pose, pose: Pose, rng: np.random.Generator) -> NDArray[np.float32]:
    """(T, F) motion features of a smooth way from `before` to `pose` and a rest there; leaves the robot in `pose`.

    Kinematics are evaluated at a few instants and interpolated between them.
    """
    recorder = world.recorder
    assert recorder is not None
    frames: list[tuple[Array, ...]] = []
    for share in np.linspace(0.0, 1.0, _KEY_INSTANTS):
        set_pose(world, before.towards(pose, float(share)))
        frames.append((recorder.root_pose(world.data), recorder.hands(world.data), recorder.key_bodies(world.data)))
    moving = int(rng.integers(8, 40))
    wait = int(rng.integers(0, 12))
    time = np.clip((np.arange(HISTORY_FRAMES) - (HISTORY_FRAMES - 1 - wait - moving)) / moving, 0.0, 1.0)
    at = (_KEY_INSTANTS - 1) * time * time * (3.0 - 2.0 * time)
    low = np.minimum(at.astype(int), _KEY_INSTANTS - 2)
    weight = at - low

    def blend(index: int) -> Array:
        values = np.stack([frame[index] for frame in frames])
        w = weight.reshape(-1, *([1] * (values.ndim - 1)))
        return values[low] * (1.0 - w) + values[low + 1] * w

    root, hands, keys = blend(0), blend(1), blend(2)
    root[:, 3:] /= np.linalg.norm(root[:, 3:], axis=1, keepdims=True)
    return encode_frames(root, keys, hands)


def camera_in_pelvis(world: World, view: View) -> Array:
    """(4, 4) pose of a view's camera in the pelvis heading frame."""
    x, y, z, yaw = world.servos.base_pose[:4]
    c, s = np.cos(yaw), np.sin(yaw)
    pelvis = np.array([[c, -s, 0.0, x], [s, c, 0.0, y], [0.0, 0.0, 1.0, z], [0.0, 0.0, 0.0, 1.0]])
    return np.linalg.inv(pelvis) @ view.camera_in_world


def center_in_pelvis(world: World, object_id: str) -> Array:
    """(3,) centre of an object in the pelvis heading frame, metres."""
    x, y, z, yaw = world.servos.base_pose[:4]
    root = np.array([x, y, z, np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)])
    return world_to_heading(world.poses.center(object_id)[None], root)[0]


def visible_json(world: World, segmentation: NDArray[np.int32]) -> str:
    """What a view shows: id, type, centre in the pelvis heading frame (m), pixels and bounding box (x0, y0, x1, y1)."""
    ids = list(world.objects)
    found: list[dict[str, Any]] = []
    for index in np.unique(segmentation[segmentation >= 0]):
        rows, columns = np.nonzero(segmentation == index)
        center = center_in_pelvis(world, ids[index])
        found.append({
            "id": ids[index],
            "type": world.objects[ids[index]].type.name,
            "center_in_pelvis": [round(float(value), 4) for value in center],
            "pixels": len(rows),
            "bbox": [int(columns.min()), int(rows.min()), int(columns.max()) + 1, int(rows.max()) + 1],
        })  # fmt: skip
    return json.dumps(found)


def view_row(world: World, view: View, motion: NDArray[np.float32], seed: int) -> dict[str, Any]:
    """One row of a `views` shard."""
    assert view.depth is not None
    assert view.segmentation is not None
    assert world.robot is not None
    names = {name: index for index, name in enumerate(type_names())}
    lookup = np.array([names[obj.type.name] for obj in world.objects.values()] + [-1, -1], dtype=np.int16)
    height, width = view.depth.shape
    return {
        "image": encode_png(view.rgb),
        "depth": np.clip(view.depth, 0.0, 60000.0).astype("<f2").tobytes(),
        "segmentation": lookup[view.segmentation].astype("<i2").tobytes(),
        "height": height,
        "width": width,
        "intrinsics": view.intrinsics.ravel().tolist(),
        "camera_in_pelvis": camera_in_pelvis(world, view).ravel().tolist(),
        "robot": world.robot.name,
        "room": world.room.name,
        "seed": seed,
        "motion": motion.ravel(),
        "objects": visible_json(world, view.segmentation),
    }


def _random_world(config: CollectConfig, index: int, rng: np.random.Generator) -> World:
    """A room with the objects of two or three drafts, doors and switches in any state."""
    robot = robot_kit(config.robots[index % len(config.robots)]).spec
    room = config.rooms[(index // len(config.robots)) % len(config.rooms)]
    scene = scene_of(room)
    for attempt in range(_ATTEMPTS * len(_MORE)):
        try:
            more = _MORE[attempt // _ATTEMPTS]
            draft = draw(str(rng.choice(list(FAMILIES))), scene, rng, distractors=more, without=UNSEEN_TYPES)
            placements = [
                Placement(name, name.rsplit("_", 1)[0], carrier, yaw_deg=float(rng.uniform(0.0, 360.0)))
                for name, carrier in draft.objects.items()
            ]
            states: dict[str, dict[str, bool | float | str]] = {}
            for name in scene.containers:
                if rng.random() < 0.35:
                    states.setdefault(name, {})["openness"] = float(rng.uniform(0.3, 1.0))
            for name in scene.switches:
                states.setdefault(name, {})["isToggled"] = bool(rng.random() < 0.5)
            return World(robot, room, placements, states=states, seed=int(rng.integers(2**31)), settle_s=0.05)
        except (NoDraft, WorldError):
            continue
    raise WorldError(f"no arrangement of objects fits into {room}")


def views_of_part(config: CollectConfig, part: int) -> Iterator[dict[str, Any]]:
    """Rows of one part of a `views` folder; the same for the same configuration, whoever computes it."""
    numbers = config.indices(part)
    for start in numbers[:: config.views_per_world]:
        index = start // config.views_per_world + part
        rng = rng_for("views", config.seed, start)
        world = _random_world(config, index, rng)
        body = Body(world)
        free = body.workspace.navigation().free_positions()
        renderer = Renderer(world.scene, config.image_size, config.image_size)
        before = draw_pose(body, free, rng)
        for number in range(start, min(start + config.views_per_world, numbers.stop)):
            pose = draw_pose(body, free, rng)
            motion = lead_in(world, _nearby(before, pose, rng), pose, rng)
            view = renderer.view("head", depth=True, segmentation=True)
            yield view_row(world, view, motion, number)
            before = pose


def _nearby(before: Pose, pose: Pose, rng: np.random.Generator) -> Pose:
    """Where the robot came from: the earlier posture, but at most a metre away and differing in some respects only."""
    step = np.array([before.x_m - pose.x_m, before.y_m - pose.y_m])
    step *= min(1.0, float(rng.uniform(0.0, 1.0)) / max(float(np.linalg.norm(step)), 1e-6))
    walks, turns, bends, reaches = rng.random(4) < (0.5, 0.4, 0.5, 0.5)
    return Pose(
        pose.x_m + (float(step[0]) if walks else 0.0),
        pose.y_m + (float(step[1]) if walks else 0.0),
        pose.yaw_rad + (float(rng.uniform(-1.5, 1.5)) if turns else 0.0),
        before.height_m if bends else pose.height_m,
        before.joints if reaches else pose.joints,
    )
