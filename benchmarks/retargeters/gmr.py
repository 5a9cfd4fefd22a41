"""A plain mink solver with the targets and the loop of GMR (General Motion Retargeting): `python gmr.py JOB.npz RESULT.npz`.

As in GMR's published code: one `mink.FrameTask` per body with `lm_damping` 1; two tables of position and rotation weights,
first feet, pelvis and the limbs' directions, then everything; `mink.solve_ik` with daqp, damping 0.5 and a
`ConfigurationLimit`; each table is repeated until the error falls by less than 0.001, at most 10 times after the first
step; each frame starts where the last one ended. The weights are those of GMR's table from SMPL-X to G1.

What differs, and why:
* The human has no joint rotations here, only 22 places. The pelvis takes the direction of trunk and hips, the torso that of
  trunk and shoulders, a foot the heading from ankle to toe, and a limb's bone is turned about its axis by the plane in
  which knee or elbow bend. The wrist has a place only.
* GMR tunes by hand, for each robot, a table of scales around the root and offsets. Here both follow from the sizes of robot
  and human. `bones`: root and legs by the ratio of the legs, each joint of the arms by the ratio of the chains from the
  pelvis to it. `height`: everything by the ratio of the heights; its hand errors are larger. Offsets put the hips at the
  human's and the soles on the floor when the human stands.
* Targets of a whole clip are computed at once, which is faster than frame by frame.
* The first frame gets ten times the iterations, because the robot starts from a posture and not from the clip's.
* Joints of the fingers are fixed, so that the solver has no more unknowns than it needs.
Shape letters: T frames. World frame, z up, metres.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from importlib.metadata import version
from itertools import pairwise
from pathlib import Path
from typing import Any

import mink
import mujoco
import numpy as np
from exchange import Array, Clip, Job, Outcome, Results, timed

SIDES = ("left", "right")
#: Position and rotation weight of each part in the first and in the second table.
TABLES = {
    "pelvis": ((100.0, 10.0), (100.0, 5.0)),
    "torso": ((0.0, 10.0), (0.0, 10.0)),
    "hip": ((0.0, 0.0), (10.0, 0.0)),
    "thigh": ((0.0, 10.0), (0.0, 5.0)),
    "knee": ((0.0, 10.0), (10.0, 5.0)),
    "sole": ((100.0, 10.0), (100.0, 50.0)),
    "shoulder": ((0.0, 0.0), (10.0, 0.0)),
    "upper_arm": ((0.0, 10.0), (0.0, 5.0)),
    "elbow": ((0.0, 10.0), (10.0, 5.0)),
    "wrist": ((0.0, 0.0), (10.0, 0.0)),
}
#: Parts whose targets are reported, by role.
ROLES = {"hand": "wrist", "shoulder": "shoulder", "foot": "sole"}
DAMPING, LEAST_GAIN, MOST_REPEATS = 0.5, 0.001, 10
FIRST_FRAME = 10


@dataclass(frozen=True)
class Frame:
    """A robot frame that follows the human.

    Attributes:
        name: of the body or site.
        kind: body or site.
        place, turn: parts of the human that give place and rotation; empty without a weight.
        weights: of place and rotation, in each table.
        rotation: (3, 3) from the axes of `turn`, as `limb_axes` defines them, to the frame's.
    """

    name: str
    kind: str
    place: str
    turn: str
    weights: tuple[tuple[float, float], tuple[float, float]]
    rotation: Array


def plain(part: str) -> str:
    """The part without its side."""
    return part.removeprefix("left_").removeprefix("right_")


def standing(*places: Array) -> float:
    """Height (m) at which points (T, 3) of the feet rest on the floor."""
    heights = np.concatenate([place[:, 2] for place in places])
    return float(np.median(heights[heights < heights.min() + 0.03]))


def unit(vectors: Array) -> Array:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-9)


def axes(first: Array, second: Array) -> Array:
    """Rotations (..., 3, 3) whose columns are `first`, `second` made square to it, and what completes them."""
    x = unit(first)
    y = unit(second - x * np.sum(second * x, axis=-1, keepdims=True))
    return np.stack([x, y, np.cross(x, y)], axis=-1)


def limb_axes(points: dict[str, Array]) -> dict[str, Array]:
    """Rotations (T, 3, 3) of pelvis, torso, feet and limbs from places (T, 3); a limb's columns are bone, hinge, the rest."""
    up = unit(points["neck"] - points["pelvis"])
    left = points["left_hip"] - points["right_hip"]
    found = {"pelvis": axes(up, left), "torso": axes(up, points["left_shoulder"] - points["right_shoulder"])}
    left = found["pelvis"][..., 1]
    for side, sign in zip(SIDES, (1.0, -1.0), strict=True):
        hip, knee, ankle, toe, shoulder, elbow, wrist = (
            points[f"{side}_{name}"] for name in ("hip", "knee", "ankle", "foot", "shoulder", "elbow", "wrist")
        )
        ahead = (toe - ankle) * [1.0, 1.0, 0.0]
        found[f"{side}_sole"] = axes(ahead, np.cross([0.0, 0.0, 1.0], ahead))
        # A straight limb has no plane: the axis then leans on the pelvis (knee) or on how arms hang and spread (elbow).
        bend = np.cross(unit(knee - hip), unit(ankle - knee)) + 0.2 * left
        found[f"{side}_thigh"], found[f"{side}_knee"] = axes(knee - hip, bend), axes(ankle - knee, bend)
        bend = np.cross(unit(elbow - shoulder), unit(wrist - elbow)) - 0.1 * (left + sign * up)
        found[f"{side}_upper_arm"], found[f"{side}_elbow"] = axes(elbow - shoulder, bend), axes(wrist - elbow, bend)
    return found


class Robot:
    """The robot in MuJoCo, with its fingers fixed, and its sizes.

    Attributes:
        model: MuJoCo model.
        joints: names of the joints that move.
        columns: (J,) their places in `qpos`.
        start: (nq,) posture from which the first frame is searched.
        frames: what follows the human.
        points: body or site of each part; left and right parts have the side before their name.
        upright: (3, 3) from the root body's axes to those of `limb_axes` for the pelvis.
        height_m: how tall the robot is.
        at: (3,) places of the parts in the pelvis frame, in the posture `start`.
    """

    def __init__(self, about: dict[str, Any]) -> None:
        spec = mujoco.MjSpec.from_file(about["mjcf"])
        moving = {*about["leg_joints"], *about["waist_joints"], *(name for arm in about["arm_joints"] for name in arm)}
        for objs in (spec.equalities, spec.actuators, spec.sensors, spec.tendons, spec.excludes, spec.keys):
            for obj in list(objs):
                spec.delete(obj)
        for joint in list(spec.joints):
            if int(joint.type) != int(mujoco.mjtJoint.mjJNT_FREE) and joint.name not in moving:
                spec.delete(joint)
        self.height_m = about["height_m"]
        model = self.model = spec.compile()
        self.joints = [name for name in about["joint_names"] if name in moving]
        self.columns = np.array([int(model.joint(name).qposadr[0]) for name in self.joints])
        self.start = model.qpos0.copy()
        self.start[:7] = [0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0]
        self.start[self.columns] = [about["start"][name] for name in self.joints]

        def carried(joints: list[str]) -> str:
            return model.body(int(model.joint(joints[-1]).bodyid[0])).name

        def parent(body: str) -> str:
            return model.body(int(model.body(body).parentid[0])).name

        keys = about["key_bodies"]
        named = {"pelvis": about["root_body"], "torso": carried(about["waist_joints"])}
        for side, arm in zip(SIDES, about["arm_joints"], strict=True):
            named |= {f"{side}_{part}": keys[f"{side}_{part}"] for part in ("hip", "knee", "ankle", "shoulder", "elbow")}
            named |= {f"{side}_thigh": parent(keys[f"{side}_knee"]), f"{side}_upper_arm": parent(keys[f"{side}_elbow"])}
            named |= {f"{side}_wrist": carried(arm), f"{side}_sole": f"{side}_sole"}
        data = mujoco.MjData(model)
        data.qpos[:] = self.start
        mujoco.mj_kinematics(model, data)
        poses = {part: data.site(name) if part.endswith("sole") else data.body(name) for part, name in named.items()}
        self.at = {part: pose.xpos.copy() for part, pose in poses.items()}
        own = limb_axes(
            self.at
            | {"neck": np.array([0.0, 0.0, 1.0])}
            | {f"{side}_foot": self.at[f"{side}_ankle"] + [0.1, 0.0, 0.0] for side in SIDES}
        )
        self.upright = own["pelvis"].T
        self.points = {part: name for part, name in named.items() if plain(part) in TABLES}
        self.frames = []
        for name in dict.fromkeys(self.points.values()):  # a body that is two parts, as H1's hip and thigh, is one frame
            parts = [part for part, body in self.points.items() if body == name]
            place, turn = (next((p for p in parts if TABLES[plain(p)][1][kind]), "") for kind in (0, 1))
            first, second = (tuple(sum(TABLES[plain(p)][table][kind] for p in parts) for kind in (0, 1)) for table in (0, 1))
            rotation = own[turn].T @ poses[turn].xmat.reshape(3, 3) if turn else np.eye(3)
            self.frames.append(
                Frame(name, "site" if plain(parts[0]) == "sole" else "body", place, turn, (first, second), rotation)
            )

    def length(self, *parts: str) -> float:
        """Length (m) of a chain of parts."""
        return float(sum(np.linalg.norm(self.at[b] - self.at[a]) for a, b in pairwise(parts)))


def targets(human: dict[str, Array], height_m: float, robot: Robot, scale: str) -> tuple[dict[str, Array], dict[str, Array]]:
    """Places (T, 3) and axes (T, 3, 3) that the human gives the parts, in the robot's size."""

    def length(*parts: str) -> float:
        return float(sum(np.median(np.linalg.norm(human[b] - human[a], axis=1)) for a, b in pairwise(parts)))

    middle = 0.5 * (human["left_hip"] + human["right_hip"])
    hips = 0.5 * (robot.at["left_hip"] + robot.at["right_hip"])
    legs = robot.length("left_hip", "left_knee", "left_ankle") / length("left_hip", "left_knee", "left_ankle")
    if scale == "height":
        legs = robot.height_m / height_m
    turned = limb_axes(human)
    soles = {f"{side}_sole": 0.55 * human[f"{side}_ankle"] + 0.45 * human[f"{side}_foot"] for side in SIDES}
    floor = standing(*soles.values())
    ankle = float(robot.at["left_ankle"][2] - robot.at["left_sole"][2])
    rise = np.array([0.0, 0.0, ankle - legs * standing(human["left_ankle"], human["right_ankle"])])
    root = legs * human["pelvis"] + rise
    places = {"pelvis": legs * middle + rise - turned["pelvis"] @ robot.upright @ hips}
    for side in SIDES:
        places |= {f"{side}_{part}": legs * human[f"{side}_{part}"] + rise for part in ("hip", "knee")}
        places[f"{side}_sole"] = legs * (soles[f"{side}_sole"] - [0.0, 0.0, floor])
        # The human's pelvis joint lies above the hips; its like in the robot is where the arms' chains begin.
        above = legs * float(np.median(np.linalg.norm(human["pelvis"] - middle, axis=1)))
        first = float(np.linalg.norm(robot.at[f"{side}_shoulder"] - hips - [0.0, 0.0, above]))
        for i, part in enumerate(("shoulder", "elbow", "wrist")):
            chain = [f"{side}_{name}" for name in ("shoulder", "elbow", "wrist")[: i + 1]]
            ratio = (first + robot.length(*chain)) / length("pelvis", *chain) if scale == "bones" else legs
            places[f"{side}_{part}"] = root + ratio * (human[f"{side}_{part}"] - human["pelvis"])
    return places, turned


class Solver:
    """GMR's loop over its two tables."""

    def __init__(self, robot: Robot) -> None:
        self.robot = robot
        self.configuration = mink.Configuration(robot.model)
        self.limits = [mink.ConfigurationLimit(robot.model)]
        self.tables = [
            [
                (frame, mink.FrameTask(frame.name, frame.kind, *frame.weights[table], lm_damping=1.0))
                for frame in robot.frames
                if any(frame.weights[table])
            ]
            for table in (0, 1)
        ]

    def __call__(self, clip: Clip, names: tuple[str, ...], scale: str) -> tuple[Array, dict[str, Array]]:
        """Configurations (T, nq) and the places (T, 3) that they follow."""
        human = {name: clip.joints[:, i] for i, name in enumerate(names)}
        places, turned = targets(human, clip.height_m, self.robot, scale)
        still = np.tile(np.eye(3), (len(clip.joints), 1, 1))
        poses = {}
        for frame in self.robot.frames:
            rotations = turned[frame.turn] @ frame.rotation if frame.turn else still
            pairs = zip(places[frame.place or "pelvis"], rotations, strict=True)  # without a weight any place will do
            poses[frame.name] = [mink.SE3.from_rotation_and_translation(mink.SO3.from_matrix(R), p) for p, R in pairs]
        start = self.robot.start.copy()
        start[:7] = poses[self.robot.points["pelvis"]][0].wxyz_xyz[[4, 5, 6, 0, 1, 2, 3]]
        self.configuration.update(start)
        path = np.empty((len(clip.joints), len(start)))
        for t in range(len(path)):
            for table in self.tables:
                for frame, task in table:
                    task.set_target(poses[frame.name][t])
            for _ in range(FIRST_FRAME if t == 0 else 1):
                for table in self.tables:
                    self._repeat([task for _, task in table])
            path[t] = self.configuration.q
        return path, places

    def _repeat(self, tasks: list[mink.FrameTask]) -> None:
        before = self._error(tasks)
        for _ in range(MOST_REPEATS + 1):
            step_s = self.robot.model.opt.timestep
            velocity = mink.solve_ik(self.configuration, tasks, step_s, "daqp", DAMPING, limits=self.limits)
            self.configuration.integrate_inplace(velocity, step_s)
            after = self._error(tasks)
            if before - after <= LEAST_GAIN:
                return
            before = after

    def _error(self, tasks: list[mink.FrameTask]) -> float:
        return float(np.linalg.norm(np.concatenate([task.compute_error(self.configuration) for task in tasks])))


def main(job_path: Path, result_path: Path) -> None:
    job = Job.read(job_path)
    robot = Robot(job.robot)
    solver = Solver(robot)
    roles = {f"{side}_{role}": f"{side}_{part}" for side in SIDES for role, part in ROLES.items()}
    outcomes = []
    for clip in job.clips:
        (path, places), seconds = timed(lambda clip=clip: solver(clip, job.human_joints, job.robot["scale"]), job.repeats)
        wanted = np.stack([places[part] for part in roles.values()], axis=1)
        outcomes.append(Outcome(path[:, :7], path[:, robot.columns], seconds, wanted))
    points = [(role, robot.points[part], (0.0, 0.0, 0.0)) for role, part in roles.items()]
    versions = {name: version(name) for name in ("mink", "mujoco", "daqp", "numpy")}
    Results(robot.joints, versions, outcomes, points).write(result_path)


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
