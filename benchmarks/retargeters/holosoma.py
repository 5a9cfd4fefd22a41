"""Holosoma's own retargeter (interaction mesh, SQP with CVXPY) on H1: `python holosoma.py JOB.npz RESULT.npz`.

It is called as its `examples/robot_retarget.py` calls it for `robot_only` clips of SMPL-X joints, with its default
settings. What it needs for H1, and the wheel does not bring:
* A MuJoCo model: made from the wheel's `h1_19dof.urdf`, with the same fixed links and collision meshes, a free joint and a
  ground plane. Its links meet the ground only; contacts among themselves, which it would find and then ignore, cost
  time only. Joint limits are those of the job's robot, because all methods are measured against them.
* The mapping from human joints to links: the same parts as in its mapping for G1.
* Which points of the feet stick: the four corners, as for G1.
A foot counts as planted below 0.3 m/s: its threshold is 0.01 m per frame at 30 frames per second. The ground is sampled
with its 15 x 15 points over 1 m to each side of the origin, or as far as the clip goes and half a metre more.
Shape letters: T frames. World frame, z up, metres.
"""

from __future__ import annotations

import sys
import tempfile
from importlib.metadata import version
from importlib.resources import files
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from exchange import Array, Clip, Job, Outcome, Results, timed
from holosoma_retargeting.config_types.data_type import MotionDataConfig
from holosoma_retargeting.config_types.retargeter import RetargeterConfig
from holosoma_retargeting.config_types.robot import RobotConfig
from holosoma_retargeting.config_types.task import TaskConfig
from holosoma_retargeting.examples import robot_retarget as example
from holosoma_retargeting.src import utils
from holosoma_retargeting.src.interaction_mesh_retargeter import InteractionMeshRetargeter

TASK, FORMAT, ROBOT = "robot_only", "smplx", "h1"
PLANTED_M_S = 0.3
#: Link of each human joint, left and right alike.
LINKS = {
    "Hip": "hip_pitch_link",
    "Knee": "knee_link",
    "Ankle": "ankle_intermediate_link",
    "Foot": "foot_sphere_5_link",
    "Shoulder": "shoulder_roll_link",
    "Elbow": "elbow_link",
    "Wrist": "hand_sphere_link",
}
MAPPING = {"Pelvis": "pelvis"} | {
    f"{letter}_{part}": f"{side}_{link}" for part, link in LINKS.items() for letter, side in (("L", "left"), ("R", "right"))
}
STICKING = [f"{side}_foot_sphere_{corner}_link" for corner in (1, 2, 3, 4) for side in ("left", "right")]
#: Where the links with targets are in the robot that all methods are measured on: role, human joint, body, place in it.
POINTS = [
    (f"{side}_{role}", f"{side}_{joint}", f"{side}_{body}", place)
    for side in ("left", "right")
    for role, joint, body, place in (
        ("hand", "wrist", "elbow_link", (0.25, 0.0, -0.02)),
        ("shoulder", "shoulder", "shoulder_roll_link", (0.0, 0.0, 0.0)),
        ("foot", "ankle", "ankle_link", (0.0, 0.0, 0.0)),
    )
]


def write_model(folder: Path, limits: dict[str, tuple[float, float]]) -> Path:
    """Writes H1 for MuJoCo beside a copy of its URDF, whose path is returned; `limits` are rad by joint."""
    source = Path(str(files("holosoma_retargeting"))) / "models" / "h1" / "h1_19dof.urdf"
    compiler = f'<mujoco><compiler meshdir="{source.parent / "meshes"}" discardvisual="true" fusestatic="false"/></mujoco>'
    text = source.read_text(encoding="utf-8").replace("</robot>", f"{compiler}</robot>")
    urdf = folder / source.name
    urdf.write_text(text, encoding="utf-8")
    spec = mujoco.MjSpec.from_file(str(urdf))
    for joint in spec.joints:
        joint.range = limits[joint.name.removesuffix("_joint")]
    spec.body("pelvis").add_freejoint()  # without a name: the retargeter takes every named joint for a motor
    for body in spec.bodies:
        for i, geom in enumerate(body.geoms):
            geom.name, geom.contype, geom.conaffinity = f"{body.name}_{i}", 1, 0  # meets the ground only
    plane = spec.worldbody.add_geom(name="ground", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[10.0, 10.0, 0.1])
    plane.contype, plane.conaffinity = 0, 1
    spec.compile()
    urdf.with_suffix(".xml").write_text(spec.to_xml(), encoding="utf-8")
    return urdf


def retarget(
    retargeter: InteractionMeshRetargeter, constants: Any, clip: Clip, fps: float, folder: Path
) -> tuple[Array, Array]:
    """Configurations (T, 26) and the scaled human joints (T, 22, 3) that they follow."""
    scale = constants.ROBOT_HEIGHT / clip.height_m
    joints = utils.preprocess_motion_data(clip.joints.copy(), retargeter, constants.TOE_NAMES, scale)
    reach = float(np.abs(joints[:, 0, :2]).max()) + 0.5
    ground = TaskConfig().ground_range if reach < 1.0 else (-reach, reach)
    points = example.create_ground_points(ground, ground, TaskConfig().ground_size)
    poses = np.tile(np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]), (len(joints), 1))
    start, nominal, moved, joints, poses = example.initialize_robot_pose(
        TASK, FORMAT, joints, poses, constants, retargeter, TaskConfig(), False, folder, clip.name
    )
    planted = utils.extract_foot_sticking_sequence_velocity(
        joints, retargeter.demo_joints, constants.TOE_NAMES, velocity_threshold=PLANTED_M_S / fps
    )
    path = retargeter.retarget_motion(
        human_joint_motions=joints,
        object_poses=poses,
        object_poses_augmented=moved,
        object_points_local_demo=points,
        object_points_local=points,
        foot_sticking_sequences=planted,
        q_a_init=start,
        q_nominal_list=nominal,
        original=True,
        dest_res_path=str(folder / "path.npz"),
    )[0]
    return path, joints


def main(job_path: Path, result_path: Path) -> None:
    job = Job.read(job_path)
    if job.robot["name"] != ROBOT:
        raise ValueError(f"robot {job.robot['name']!r}; holosoma is set up for {ROBOT}")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        urdf = write_model(folder, job.robot["limits"])
        known: Any = {ROBOT: {"robot_dof": 19, "robot_height": job.robot["height_m"], "object_name": "ground"}}
        robot = RobotConfig(ROBOT, robot_defaults=known, robot_urdf_file=str(urdf), foot_sticking_links=STICKING)
        motion = MotionDataConfig(FORMAT, ROBOT, robot_defaults=known, joints_mapping=MAPPING)
        constants = example.create_task_constants(robot, motion, TaskConfig(), TASK)
        settings = example.build_retargeter_kwargs_from_config(RetargeterConfig(), constants, None, TASK)
        retargeter = InteractionMeshRetargeter(**settings)
        outcomes = []
        for clip in job.clips:
            (path, joints), seconds = timed(
                lambda clip=clip: retarget(retargeter, constants, clip, job.fps, folder), job.repeats
            )
            targets = joints[:, [job.human_joints.index(joint) for _, joint, _, _ in POINTS]]
            outcomes.append(Outcome(path[:, :7], path[:, 7:26], seconds, targets))
        model = retargeter.robot_model
        names = [model.joint(i).name.removesuffix("_joint") for i in range(model.njnt) if model.joint(i).name]
    versions = {name: version(name) for name in ("holosoma-retargeting", "mujoco", "cvxpy", "clarabel", "numpy")}
    Results(names, versions, outcomes, [(role, body, place) for role, _, body, place in POINTS]).write(result_path)


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
