"""What the project knows of a robot beyond its MJCF: its arms, legs and hands, where the key bodies are, its limits.

A robot is one YAML file (`specs/<name>.yaml`, or `robots/<name>.yaml` of one's own assets, see `configs.assets`) and one MJCF;
`load_robot` validates the file against the MJCF.
"""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Literal

import yaml

from configs.assets import asset_files
from configs.validate import ConfigError, build
from interface.bodies import KEY_BODIES, SIDES

_SPECS = Path(__file__).parent / "specs"


@dataclass(frozen=True, slots=True)
class ArmSpec:
    """One arm with its hand.

    Attributes:
        joints: arm joints from shoulder to wrist.
        grasp_site: MJCF site at the centre of the grasp, x along the fingers, y the closing direction.
        hand_joints: actuated hand joints.
        hand_open: their positions when open (rad or m).
        hand_closed: their positions when closed.
        finger_groups: two opposing groups of geom names; a grasp needs contact with both.
        max_load_kg: heaviest object one arm carries.
        carry: arm joint positions (rad) that hold an object in front of the body, out of the head camera's way.
        rest: arm joint positions (rad) at rest.
    """

    joints: tuple[str, ...]
    grasp_site: str
    hand_joints: tuple[str, ...]
    hand_open: tuple[float, ...]
    hand_closed: tuple[float, ...]
    finger_groups: tuple[tuple[str, ...], tuple[str, ...]]
    max_load_kg: float
    rest: tuple[float, ...]
    carry: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class FootSpec:
    """Rectangular sole around the sites `left_sole` and `right_sole`, half extents in metres."""

    half_length_m: float
    half_width_m: float


@dataclass(frozen=True, slots=True)
class HandSpec:
    """Size of an open hand around its grasp site (x along the fingers, y the closing direction), for planning grasps.

    Attributes:
        behind_m: free distance from the site to what closes from behind (site -y): the palm, or one finger.
        max_radius_m: half the width of the widest object that fits between the fingers.
        tip_m: how far the open fingers reach beyond the site.
        half_width_m: half the hand's width across (site z).
        slope: how the thumb limits the seat: free x per metre of radius, and at radius 0; (0, 0) for parallel fingers.
        pinch_m: distance along y at which half-closed fingertips and thumb meet a surface; None when the fingers are parallel.
        clearance_m: free distance between the object and what closes from behind, on arrival.
        press: the fingertip that presses a switch: x and y in the site's frame, and the opening of the hand for it.
    """

    behind_m: float
    max_radius_m: float
    tip_m: float
    half_width_m: float
    slope: tuple[float, float] = (0.0, 0.0)
    pinch_m: float | None = None
    clearance_m: float = 0.0
    press: tuple[float, float, float] = (0.036, 0.0, 0.0)

    def seat(self, radius_m: float) -> tuple[float, float]:
        """Where the middle of an object of that half width belongs: x and y in the site's frame."""
        forward = self.slope[0] * radius_m + self.slope[1]
        return (max(forward, 0.0), max(radius_m + self.clearance_m - self.behind_m, 0.0))


@dataclass(frozen=True, slots=True)
class BodyShape:
    """A capsule, or a box when `half_m` is given, that stands for a part of the robot when it avoids itself.

    Attributes:
        body: MJCF body, in whose frame the shape is.
        start, end: (3,) ends of the capsule's axis; `start` is the middle of a box. Metres.
        radius_m: of the capsule.
        half_m: (3,) half edges of the box along the body's axes.
    """

    body: str
    start: tuple[float, float, float]
    end: tuple[float, float, float] = (0.0, 0.0, 0.0)
    radius_m: float = 0.0
    half_m: tuple[float, float, float] | None = None

    def __post_init__(self) -> None:
        if min(self.half_m or (self.radius_m,)) <= 0.0:
            raise ValueError(f"shape of {self.body}: needs a radius_m, or half_m, above 0")


@dataclass(frozen=True, slots=True)
class RobotSpec:
    """A dual-arm humanoid.

    Attributes:
        name: robot name as used in commands.
        mjcf: path of the MJCF file, relative to the YAML file.
        mjcf_path: absolute path of the MJCF file.
        root_body: pelvis body, carrying the free joint.
        leg_joints, waist_joints: joint names.
        arms: `left` and `right`.
        key_bodies: MJCF body or site for each of `KEY_BODIES`.
        head_camera: MJCF camera name.
        standing_pelvis_height_m: pelvis above the floor when standing.
        pelvis_height_range_m: lowest and highest pelvis with flat soles and a balanced centre of mass.
        foot: sole size.
        hand: size of both hands.
        footprint_radius_m: radius of the disc that navigation keeps free.
        two_arm_max_load_kg: heaviest object both arms carry.
        max_joint_velocity: rad/s for trajectories and inverse kinematics.
        solver: inverse kinematics of waist and both arms together, or of each arm alone.
        self_shapes: what the arms must not run into and what they are themselves; none: from the MJCF's geoms.
        joints: every scalar joint of the MJCF in its order (read from the file).
    """

    name: str
    mjcf: str
    root_body: str
    leg_joints: tuple[str, ...]
    waist_joints: tuple[str, ...]
    arms: Mapping[str, ArmSpec]
    key_bodies: Mapping[str, str]
    head_camera: str
    standing_pelvis_height_m: float
    pelvis_height_range_m: tuple[float, float]
    foot: FootSpec
    hand: HandSpec
    footprint_radius_m: float
    two_arm_max_load_kg: float
    max_joint_velocity: float
    solver: Literal["whole_body", "per_arm"]
    self_shapes: tuple[BodyShape, ...] = ()
    mjcf_path: Path = field(default=Path())
    joints: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if tuple(sorted(self.arms)) != SIDES:
            raise ValueError(f"arms {sorted(self.arms)} must be left and right")
        missing = [name for name in KEY_BODIES if name not in self.key_bodies]
        if missing:
            raise ValueError(f"key bodies {missing} are missing; needed: {', '.join(KEY_BODIES)}")
        low, high = self.pelvis_height_range_m
        if not 0.0 < low < high:
            raise ValueError(f"pelvis height range {self.pelvis_height_range_m} is empty")

    def max_load_kg(self, arms: int) -> float:
        """Heaviest object that both arms carry, or one arm alone, whichever it is."""
        return self.two_arm_max_load_kg if arms == 2 else min(arm.max_load_kg for arm in self.arms.values())


def available_robots() -> tuple[str, ...]:
    """Names of the robots, the user's included."""
    return tuple(sorted(asset_files("robots", _SPECS)))


def load_robot(name: str, mjcf: str | None = None) -> RobotSpec:
    """Loads a robot.

    Args:
        name: name of a robot, or path of a YAML file of the same format.
        mjcf: path of an MJCF file that replaces the description's own, for example one with the vendor's meshes.

    Raises:
        ConfigError: on an unknown name, a bad file, or a joint that the MJCF does not have.
    """
    files = asset_files("robots", _SPECS)
    path = Path(name) if name.endswith((".yaml", ".yml")) else files.get(name, Path())
    if not path.is_file():
        raise ConfigError(f"robot {name!r}: no such robot; allowed: {', '.join(sorted(files))}, or a path to a YAML file")
    return _read(path, mjcf)


@lru_cache(maxsize=16)
def _read(path: Path, mjcf: str | None) -> RobotSpec:
    values = yaml.safe_load(path.read_text(encoding="utf-8"))
    if not isinstance(values, dict):
        raise ConfigError(f"{path}: expected a mapping")
    mjcf_path = Path(mjcf).resolve() if mjcf is not None else (path.parent / str(values.get("mjcf", ""))).resolve()
    if not mjcf_path.is_file():
        raise ConfigError(f"{path}: mjcf {mjcf if mjcf is not None else values.get('mjcf')!r} not found")
    joints = _scalar_joints(mjcf_path)
    spec = build(RobotSpec, {**values, "mjcf_path": mjcf_path, "joints": joints}, where=str(path.name))
    named = [*spec.leg_joints, *spec.waist_joints]
    for arm in spec.arms.values():
        named += [*arm.joints, *arm.hand_joints]
        sizes = (
            {len(arm.joints), len(arm.rest), len(arm.carry)},
            {len(arm.hand_joints), len(arm.hand_open), len(arm.hand_closed)},
        )
        if any(len(size) != 1 for size in sizes):
            raise ConfigError(f"{path}: rest, carry, hand_open and hand_closed need one value per joint of {arm.grasp_site}")
    unknown = [joint for joint in named if joint not in joints]
    if unknown:
        raise ConfigError(f"{path}: joints {unknown} are not in {mjcf_path.name}; it has: {', '.join(joints)}")
    return spec


def _scalar_joints(mjcf_path: Path) -> tuple[str, ...]:
    world = ElementTree.parse(mjcf_path).getroot().find("worldbody")
    if world is None:
        raise ConfigError(f"{mjcf_path}: no worldbody")
    return tuple(joint.get("name", "") for joint in world.iter("joint") if joint.get("type") not in ("free", "ball"))
