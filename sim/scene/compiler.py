"""Builds the MuJoCo model of a robot in a furnished room with a set of objects, from data only.

The scene grows out of the robot's MJCF, whose free joint is replaced by five position-servoed joints (`base_x`, `base_y`,
`base_z`, `base_yaw`, and `base_pitch`, the forward lean of a deep crouch), because the base moves along planned free paths.
Furniture is static, with joints for doors and drawers; movable objects have free joints. Each arm owns one weld and one ball
(connect) constraint that are inactive until a grasp points them at
a body (`World.attach`). Paper: the DualTHOR scenes; balance control and cloth-like or liquid bodies are left out.

Collision bits (`contype`/`conaffinity`), so that only pairs that matter are tested: static 1/0, movable 2/23, hands and
forearms 4/3 (set in the robot's MJCF; 36/3 the left ones, 68/3 the right ones), held object 8/155, held door or drawer 16/64 or
16/32, trunk, head, upper arms and legs 128/0. Static geometry, doors, trunk and legs never meet each other; a held object does
not meet hands and forearms, a held door does not meet the hand that holds it.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import mujoco
import numpy as np
from numpy.typing import NDArray

from sim.scene.catalogue import Catalogue, MovingSpec, ObjectType, Part, load_catalogue
from sim.scene.rooms import Room, load_room
from sim.scene.surfaces import add_surfaces

#: Geoms that show spilled liquid, see `sim.world.liquids`.
PUDDLES: Final = 6

TIMESTEP_S: Final = 0.005
#: Version of the physics, raised with each change after which the same plan may end otherwise (models, contacts, solver,
#: motions of skills). Certificates, runs and tables say with which one they were made. 1: sparse Jacobians where MuJoCo chooses
#: them; 2: dense ones; 3: grasps that hold, fingers at rest, loads that do not fly, set-downs that last; 4: feet that stand,
#: decisions of two ticks, what is held meets the robot's own body, goals read when things have come to rest;
#: 5: who is too low to step rises to walk, what is held ends a walk as a hand does.
PHYSICS: Final = 5
BASE_JOINTS: Final = ("base_x", "base_y", "base_z", "base_yaw", "base_pitch")
STATIC_BITS: Final = (1, 0)
MOVABLE_BITS: Final = (2, 23)
HELD_BITS: Final = (8, 155)
HELD_DOOR_BITS: Final = (16, 0)
#: Bit that forearm and hand of each arm have besides, so that a door in one hand meets the other arm.
ARM_BITS: Final = {"left": 32, "right": 64}
LIMB_BIT: Final = 4
#: Of trunk, head, upper arms and legs, which what is held alone meets.
OWN_BIT: Final = 128

#: Position gain and damping ratio of the base servos, 20 ms to 30 ms behind their targets. Arms that reach out add inertia to
#: the turns, so these are damped more.
_BASE_GAINS: Final = {"base_x": 2.0e5, "base_y": 2.0e5, "base_z": 3.0e5, "base_yaw": 2.5e4, "base_pitch": 2.5e4}
_BASE_DAMPING: Final = {"base_yaw": 1.4, "base_pitch": 1.4}
_ARENA_BYTES: Final = 8 << 20
_WALLS: Final = ("north", "east", "south", "west")
_CEILING: Final = (0.97, 0.97, 0.95)
_OBJECT_FRICTION: Final = (1.0, 0.01, 0.001)
#: Doors and drawers of which the catalogue says nothing else.
_MOVING_MASS_KG: Final = {"hinge": 2.5, "slide": 1.5}
_MOVING_DAMPING: Final = {"hinge": 0.6, "slide": 12.0}
_MOVING_FRICTION: Final = {"hinge": 0.3, "slide": 2.0}
#: Inertia added to a joint for the solver's sake; a light lid would move like a heavy one with that of a door.
_MOVING_ARMATURE: Final = 0.02
_LIGHT_ARMATURE: Final = 0.004
#: Friction of a lid's hinge, harder than usual, which creeps; much harder, and the solver does not converge and the lid sinks.
_LID_SOLIMP: Final = (0.97, 0.98, 0.001, 0.5, 2.0)


@dataclass(frozen=True, slots=True)
class SceneKey:
    """What a compiled model depends on; equal keys share one compilation.

    Attributes:
        robot: robot name, `""` for a room without a robot.
        mjcf_path: the robot's MJCF.
        root_body: its root body.
        hand_bodies: bodies that hold the grasp sites, per arm in the order left, right.
        room: room name.
        object_ids: ids of the movable objects, sorted.
    """

    robot: str
    mjcf_path: str
    root_body: str
    hand_bodies: tuple[str, ...]
    room: str
    object_ids: tuple[str, ...]


@functools.lru_cache(maxsize=24)
def compile_scene(key: SceneKey) -> mujoco.MjModel:
    """The compiled model of a scene, cached; copy it before changing anything in it."""
    model = build_spec(key).compile()
    for object_id in key.object_ids:
        _measure_whole(model, object_id)
    return model


def _measure_whole(model: mujoco.MjModel, object_id: str) -> None:
    """Gives the turning of an object the length of its whole shape: slices, not seen yet, would put it to sleep later."""
    kind = load_catalogue().get(object_id.rsplit("_", 1)[0])
    slices = {f"{object_id}/{index}" for index, part in enumerate(kind.parts) if "slice" in part.options}
    if not slices:
        return
    body = model.body(object_id)
    geoms = [g for g in np.flatnonzero(model.geom_bodyid == body.id) if str(model.geom(int(g)).name) not in slices]
    reach = np.linalg.norm(model.geom_pos[geoms] - model.body_ipos[body.id], axis=1) + model.geom_rbound[geoms]
    first = int(body.dofadr[0])
    model.dof_length[first + 3 : first + 6] = float(reach.max())


def build_spec(key: SceneKey) -> mujoco.MjSpec:
    """The scene as an editable MjSpec."""
    catalogue, room = load_catalogue(), load_room(key.room)
    spec = mujoco.MjSpec.from_file(key.mjcf_path) if key.robot else mujoco.MjSpec()
    spec.modelname = f"{key.robot or 'no_robot'}_{room.name}"
    spec.compiler.degree = False
    option: Any = spec.option
    option.timestep = TIMESTEP_S
    option.integrator = int(mujoco.mjtIntegrator.mjINT_IMPLICITFAST)
    option.cone = int(mujoco.mjtCone.mjCONE_PYRAMIDAL)
    # MuJoCo 4.0.0 builds a wrong Newton Hessian from sparse Jacobians (google-deepmind/mujoco #3767); dense costs the same here
    option.jacobian = int(mujoco.mjtJacobian.mjJAC_DENSE)
    option.iterations = 30
    option.ls_iterations = 10
    option.impratio = 3.0
    option.enableflags = int(mujoco.mjtEnableBit.mjENBL_SLEEP)
    spec.memory = _ARENA_BYTES  # small, because a snapshot copies it
    visual: Any = spec.visual
    visual.headlight.ambient = [0.42, 0.42, 0.42]
    visual.headlight.diffuse = [0.40, 0.40, 0.40]
    visual.headlight.specular = [0.0, 0.0, 0.0]
    visual.map.znear = 0.01
    visual.map.zfar = 20.0
    visual.global_.offwidth = 1280
    visual.global_.offheight = 1280
    visual.quality.offsamples = 0
    stat: Any = spec.stat
    stat.extent = 2.0  # znear and zfar are multiples of it
    stat.center = [0.0, 0.0, 1.0]
    _add_room(spec, room, catalogue)
    for item in room.furniture:
        kind = catalogue.get(item.type_name)
        yaw = np.radians(item.yaw_deg)
        body = spec.worldbody.add_body(
            name=item.id, pos=[*item.xy, item.z], quat=[np.cos(yaw / 2.0), 0.0, 0.0, np.sin(yaw / 2.0)]
        )
        _add_object(spec, body, item.id, kind, catalogue, movable=False)
    for index, object_id in enumerate(key.object_ids):
        kind = catalogue.get(object_id.rsplit("_", 1)[0])
        if not kind.movable:
            raise ValueError(f"{object_id} is a fixture and cannot be placed; allowed: pickupable and two_handed types")
        body = spec.worldbody.add_body(name=object_id, pos=[0.6 * index, 20.0, 0.0])
        _add_object(spec, body, object_id, kind, catalogue, movable=True)
        body.add_freejoint(name=f"{object_id}/free")
    if key.robot:
        _mount_robot(spec, key)
    return spec


def build_type_spec(type_name: str) -> mujoco.MjSpec:
    """A type alone on a floor, seen by the camera `view` from the front, above and a little to the right."""
    catalogue = load_catalogue()
    kind = catalogue.get(type_name)
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    visual: Any = spec.visual
    visual.headlight.ambient = [0.42, 0.42, 0.42]
    visual.headlight.diffuse = [0.45, 0.45, 0.45]
    visual.quality.offsamples = 0
    stat: Any = spec.stat
    stat.extent = 2.0
    visual.map.znear = 0.01
    body = spec.worldbody.add_body(name=f"{type_name}_1")
    _add_object(spec, body, f"{type_name}_1", kind, catalogue, movable=kind.movable)
    if kind.movable:
        body.add_freejoint(name=f"{type_name}_1/free")
    spec.worldbody.add_geom(
        name="floor", type=int(mujoco.mjtGeom.mjGEOM_PLANE), size=[8.0, 8.0, 0.1], rgba=[0.85, 0.85, 0.83, 1.0], contype=1
    )
    reach = 1.35 * float(np.linalg.norm(kind.size))
    view = spec.worldbody.add_camera(name="view", pos=[0.45 * reach, -0.9 * reach, kind.size[2] / 2 + 0.55 * reach], fovy=50.0)
    _look_at(view, [0.0, 0.0, kind.size[2] / 2])
    return spec


def _add_room(spec: mujoco.MjSpec, room: Room, catalogue: Catalogue) -> None:
    spec.add_texture(
        name="sky",
        type=int(mujoco.mjtTexture.mjTEXTURE_SKYBOX),
        builtin=int(mujoco.mjtBuiltin.mjBUILTIN_GRADIENT),
        rgb1=[0.80, 0.88, 0.95],
        rgb2=[0.94, 0.95, 0.96],
        width=64,
        height=384,
    )
    spec.add_texture(
        name="tiles",
        type=int(mujoco.mjtTexture.mjTEXTURE_2D),
        builtin=int(mujoco.mjtBuiltin.mjBUILTIN_CHECKER),
        rgb1=list(room.floor_colors[0]),
        rgb2=list(room.floor_colors[1]),
        width=128,
        height=128,
    )
    floor = spec.add_material(name="floor", texrepeat=[1.0, 1.0], texuniform=True, specular=0.0)
    floor.textures[int(mujoco.mjtTextureRole.mjTEXROLE_RGB)] = "tiles"
    add_surfaces(spec, room.floor_colors)
    x0, y0, x1, y1 = room.bounds
    cx, cy, hx, hy, h = (x0 + x1) / 2, (y0 + y1) / 2, (x1 - x0) / 2, (y1 - y0) / 2, room.wall_height
    world = spec.worldbody
    bits = {"contype": STATIC_BITS[0], "conaffinity": STATIC_BITS[1]}
    plane = int(mujoco.mjtGeom.mjGEOM_PLANE)
    world.add_geom(name="floor", type=plane, size=[hx, hy, 0.1], pos=[cx, cy, 0.0], material="floor", **bits)
    # Planes collide as half spaces and are seen from inside only, so outside cameras look through them.
    walls = {
        "north": ([cx, y1, h / 2], [1, 0, 0, 0, 0, 1], hx),
        "east": ([x1, cy, h / 2], [0, -1, 0, 0, 0, 1], hy),
        "south": ([cx, y0, h / 2], [-1, 0, 0, 0, 0, 1], hx),
        "west": ([x0, cy, h / 2], [0, 1, 0, 0, 0, 1], hy),
    }
    for name, color in zip(_WALLS, room.wall_colors, strict=True):
        pos, axes, half = walls[name]
        geom = world.add_geom(name=f"wall_{name}", type=plane, size=[half, h / 2, 0.1], pos=pos, rgba=[*color, 1.0], **bits)
        geom.quat = _quat(axes[:3], axes[3:])
    # A ceiling is several times cheaper to draw than the sky around the walls; nothing touches it.
    ceiling = world.add_geom(
        name="ceiling", type=plane, size=[hx, hy, 0.1], pos=[cx, cy, h], rgba=[*_CEILING, 1.0], contype=0, conaffinity=0
    )
    ceiling.quat = _quat([1, 0, 0], [0, -1, 0])
    for index, part in enumerate(room.decor):
        _add_part(spec, world, f"decor/{index}", part, (0.0, 0.0, 0.0), catalogue, STATIC_BITS, 0.0)
    for index in range(PUDDLES):  # spilled liquid is shown by them, see sim.world.liquids
        world.add_geom(
            name=f"puddle/{index}", type=int(mujoco.mjtGeom.mjGEOM_CYLINDER), size=[0.03, 0.001, 0.0],
            pos=[cx, cy, -1.0 - index], rgba=[0.0, 0.0, 0.0, 0.0], contype=0, conaffinity=0,
        )  # fmt: skip
    directional = int(mujoco.mjtLightType.mjLIGHT_DIRECTIONAL)
    for direction, strength in (([0.3, 0.4, -1.0], 0.35), ([-0.5, -0.6, -0.5], 0.18)):
        world.add_light(
            type=directional, dir=direction, pos=[cx, cy, 4.0], castshadow=False,
            diffuse=[strength] * 3, specular=[0.0, 0.0, 0.0],
        )  # fmt: skip
    overview = world.add_camera(name="overview", pos=[cx, y0 - 2.4, 5.2], fovy=52.0)
    _look_at(overview, [cx, cy + 0.1, 0.4])
    plan = world.add_camera(name="plan", pos=[cx, cy, 9.0], fovy=float(np.degrees(2 * np.arctan(max(hx, hy) * 1.05 / 9.0))))
    plan.quat = _quat([1, 0, 0], [0, 1, 0])


def _look_at(camera: mujoco.MjsCamera, target: Sequence[float]) -> None:
    """Turns a camera towards a point of its body's frame, image upright."""
    back = np.asarray(camera.pos, dtype=float) - np.asarray(target, dtype=float)
    back /= np.linalg.norm(back)
    right = np.cross([0.0, 0.0, 1.0], back)
    right /= np.linalg.norm(right)
    camera.quat = _quat(right, np.cross(back, right))


def _quat(x_axis: Any, y_axis: Any) -> NDArray[np.float64]:
    """Quaternion (w, x, y, z) of the frame with these unit axes."""
    quat, x, y = np.zeros(4), np.asarray(x_axis, dtype=float), np.asarray(y_axis, dtype=float)
    mujoco.mju_mat2Quat(quat, np.column_stack([x, y, np.cross(x, y)]).flatten())
    return quat


def _add_object(
    spec: mujoco.MjSpec, body: mujoco.MjsBody, object_id: str, kind: ObjectType, catalogue: Catalogue, *, movable: bool
) -> None:
    bits = MOVABLE_BITS if movable else STATIC_BITS
    moving_mass = sum(_moving_mass_kg(moving) for moving in kind.moving) if movable else 0.0
    _add_parts(spec, body, f"{object_id}/", kind.parts, (0.0, 0.0, 0.0), catalogue, bits, (kind.mass or 1.0) - moving_mass)
    for moving in kind.moving:
        _add_moving(spec, body, object_id, moving, catalogue, bits)


def _moving_mass_kg(moving: MovingSpec) -> float:
    return _MOVING_MASS_KG[moving.joint] if moving.mass_kg is None else moving.mass_kg


def _add_moving(
    spec: mujoco.MjSpec, parent: mujoco.MjsBody, object_id: str, moving: MovingSpec, catalogue: Catalogue, bits: tuple[int, int]
) -> None:
    name = f"{object_id}/{moving.name}"
    body = parent.add_body(name=name, pos=list(moving.at))
    hinge = moving.joint == "hinge"
    kind = mujoco.mjtJoint.mjJNT_HINGE if hinge else mujoco.mjtJoint.mjJNT_SLIDE
    joint = body.add_joint(name=name, type=int(kind), axis=list(moving.axis), range=list(moving.range), limited=True)
    joint.damping = [_MOVING_DAMPING[moving.joint] if moving.damping is None else moving.damping, 0.0, 0.0]
    joint.frictionloss = _MOVING_FRICTION[moving.joint] if moving.friction is None else moving.friction
    joint.armature = _MOVING_ARMATURE if moving.mass_kg is None else _LIGHT_ARMATURE
    if moving.is_lid:
        joint.solimp_friction = _LID_SOLIMP
    _add_parts(spec, body, f"{name}/", moving.parts, moving.at, catalogue, bits, _moving_mass_kg(moving))
    for part in moving.parts:
        if "handle" in part.options:
            body.add_site(name=f"{name}/handle", pos=list(np.subtract(part.center, moving.at)), size=[0.005] * 3, group=4)


def _add_parts(
    spec: mujoco.MjSpec,
    body: mujoco.MjsBody,
    prefix: str,
    parts: Sequence[Part],
    origin: Sequence[float],
    catalogue: Catalogue,
    bits: tuple[int, int],
    mass_kg: float,
) -> None:
    """Adds primitives to a body; the mass is shared among the solid ones in proportion to their boxes."""
    solid = [part for part in parts if "ghost" not in part.options]
    weights = {id(part): float(np.prod(part.size)) * (0.15 if part.wall_m else 1.0) for part in solid}
    total = sum(weights.values())
    for index, part in enumerate(parts):
        share = mass_kg * weights.get(id(part), 0.0) / total
        _add_part(spec, body, f"{prefix}{index}", part, origin, catalogue, bits, share)
        if "toggle" in part.options:
            front = np.add(np.subtract(part.center, origin), [0.0, -part.size[1] / 2.0, 0.0])
            body.add_site(name=f"{prefix}toggle", pos=list(front), size=[0.005] * 3, group=4)


def _add_part(
    spec: mujoco.MjSpec,
    body: mujoco.MjsBody,
    name: str,
    part: Part,
    origin: Sequence[float],
    catalogue: Catalogue,
    bits: tuple[int, int],
    mass_kg: float,
) -> None:
    rgba = list(catalogue.colors[part.color])
    common: dict[str, Any] = {"rgba": rgba, "friction": list(_OBJECT_FRICTION), "condim": 4, "solref": [0.015, 1.0]}
    if part.options & {"hidden", "liquid", "slice"}:
        common["rgba"] = [*rgba[:3], 0.0]
    if part.options & {"glow"}:
        spec.add_material(name=f"{name}/glow", rgba=[1.0, 1.0, 1.0, 1.0], specular=0.0, emission=0.0)
        common["material"] = f"{name}/glow"
    ghost = "ghost" in part.options
    common["contype"], common["conaffinity"] = (0, 0) if ghost else bits
    pieces = _pieces(part)
    volume = sum(float(np.prod(size)) for _, _, size, _ in pieces)
    for index, (shape, center, size, yaw) in enumerate(pieces):
        suffix = f"/{index}" if len(pieces) > 1 else ""
        mass = 0.0 if ghost else mass_kg * float(np.prod(size)) / volume
        pos = np.subtract(center, origin)
        turn = [np.cos(yaw / 2.0), 0.0, 0.0, np.sin(yaw / 2.0)]
        if "flat" in part.options and not ghost:
            # An ellipsoid that is seen, a slightly smaller cylinder that is touched: fruit stays where it is put.
            foot = [0.42 * (size[0] + size[1]) / 2.0, size[2] / 2.0, 0.0]
            hidden = {**common, "rgba": [0.0, 0.0, 0.0, 0.0]}
            body.add_geom(
                name=f"{name}/foot", type=int(mujoco.mjtGeom.mjGEOM_CYLINDER), size=foot, pos=pos, mass=mass, group=3, **hidden
            )
            ghostly = {**common, "contype": 0, "conaffinity": 0}
            _add_solid(body, name + suffix, shape, size, pos, turn, 0.0, ghostly)
        else:
            _add_solid(body, name + suffix, shape, size, pos, turn, mass, common)


def _add_solid(
    body: mujoco.MjsBody, name: str, shape: str, size: Sequence[float], pos: Any, turn: list[float], mass: float, common: Any
) -> None:
    sx, sy, sz = size
    base, _, axis = shape.partition("_")
    quat = {"": turn, "x": [np.sqrt(0.5), 0.0, np.sqrt(0.5), 0.0], "y": [np.sqrt(0.5), np.sqrt(0.5), 0.0, 0.0]}[axis]
    along, across = {"": (sz, max(sx, sy)), "x": (sx, max(sy, sz)), "y": (sy, max(sx, sz))}[axis]
    if base == "box":
        kind, half = mujoco.mjtGeom.mjGEOM_BOX, [sx / 2, sy / 2, sz / 2]
    elif base == "ellipsoid":
        kind, half = mujoco.mjtGeom.mjGEOM_ELLIPSOID, [sx / 2, sy / 2, sz / 2]
    elif base == "cylinder":
        kind, half = mujoco.mjtGeom.mjGEOM_CYLINDER, [across / 2, along / 2, 0.0]
    else:
        kind, half = mujoco.mjtGeom.mjGEOM_CAPSULE, [across / 2, max(along / 2 - across / 2, 1e-3), 0.0]
    body.add_geom(name=name, type=int(kind), size=half, pos=pos, quat=quat, mass=mass, group=0, **common)


def _pieces(part: Part) -> list[tuple[str, tuple[float, ...], tuple[float, ...], float]]:
    """The convex pieces of a part: (shape, centre, full extents, yaw), one for solids, walls and floor for hollow shapes."""
    (x, y, z), (sx, sy, sz), t = part.center, part.size, part.wall_m
    if part.shape == "tray":
        return [
            ("box", (x, y, z - sz / 2 + t / 2), (sx, sy, t), 0.0),
            ("box", (x - sx / 2 + t / 2, y, z), (t, sy, sz), 0.0),
            ("box", (x + sx / 2 - t / 2, y, z), (t, sy, sz), 0.0),
            ("box", (x, y - sy / 2 + t / 2, z), (sx, t, sz), 0.0),
            ("box", (x, y + sy / 2 - t / 2, z), (sx, t, sz), 0.0),
        ]
    if part.shape == "shell":
        return [
            ("box", (x, y + sy / 2 - t / 2, z), (sx, t, sz), 0.0),
            ("box", (x - sx / 2 + t / 2, y, z), (t, sy, sz), 0.0),
            ("box", (x + sx / 2 - t / 2, y, z), (t, sy, sz), 0.0),
            ("box", (x, y, z - sz / 2 + t / 2), (sx, sy, t), 0.0),
            ("box", (x, y, z + sz / 2 - t / 2), (sx, sy, t), 0.0),
        ]
    if part.shape == "cup":
        radius = min(sx, sy) / 2.0
        width = 2.0 * radius * np.tan(np.pi / 8.0)
        walls = []
        for k in range(8):
            a = k * np.pi / 4.0
            r = radius - t / 2.0
            walls.append(("box", (x + r * np.cos(a), y + r * np.sin(a), z), (t, width, sz), a))
        return [("cylinder", (x, y, z - sz / 2 + t / 2), (2 * radius - t, 2 * radius - t, t), 0.0), *walls]
    return [(part.shape, part.center, part.size, 0.0)]


def _mount_robot(spec: mujoco.MjSpec, key: SceneKey) -> None:
    root = spec.body(key.root_body)
    for joint in list(root.joints):
        spec.delete(joint)
    root.pos = [0.0, 0.0, 0.0]
    axes = {"base_x": [1, 0, 0], "base_y": [0, 1, 0], "base_z": [0, 0, 1], "base_yaw": [0, 0, 1], "base_pitch": [0, 1, 0]}
    for name, axis in axes.items():
        kind = mujoco.mjtJoint.mjJNT_HINGE if name in ("base_yaw", "base_pitch") else mujoco.mjtJoint.mjJNT_SLIDE
        joint = root.add_joint(name=name, type=int(kind), axis=axis)
        joint.damping = [0.0, 0.0, 0.0]
        joint.armature = 0.0
    for name, (pos, target) in {
        "front": ([2.3, 0.0, 0.9], [0.0, 0.0, -0.1]),
        "behind": ([-2.3, 0.0, 0.9], [0.0, 0.0, -0.1]),
        "left": ([0.0, 2.3, 0.9], [0.0, 0.0, -0.1]),
        "right": ([0.0, -2.3, 0.9], [0.0, 0.0, -0.1]),
    }.items():
        _look_at(root.add_camera(name=name, pos=pos, fovy=60.0), target)
    root.add_camera(name="top", pos=[0.0, 0.0, 3.2], fovy=60.0, quat=_quat([0, -1, 0], [1, 0, 0]))
    for name in BASE_JOINTS:
        servo = spec.add_actuator(name=name, target=name, trntype=int(mujoco.mjtTrn.mjTRN_JOINT))
        servo.set_to_position(kp=_BASE_GAINS[name], dampratio=_BASE_DAMPING.get(name, 1.0))
    for arm, body in zip(("left", "right"), key.hand_bodies, strict=True):
        for kind, eq in (("weld", mujoco.mjtEq.mjEQ_WELD), ("ball", mujoco.mjtEq.mjEQ_CONNECT)):
            # Both ends name real bodies; the second end and the relative pose are set by World.attach.
            spec.add_equality(
                name=f"{arm}_{kind}", type=int(eq), objtype=int(mujoco.mjtObj.mjOBJ_BODY), name1=body, name2="world",
                active=False, solref=[0.01, 1.0], data=np.zeros(12),
            )  # fmt: skip
