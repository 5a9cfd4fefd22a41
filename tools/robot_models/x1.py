"""AgiBot X1's MJCF: kinematics, masses and limits from `assets/x1_kinematics.csv`, primitive geometry, two parallel grippers.

The vendor's meshes are not redistributed; shells are capsules and boxes between the joints. The grippers are ours: two fingers
on slides with 0.06 m of travel each, a palm, and pads.
"""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np

from tools.robot_models.common import (
    HAND_FRICTION,
    ROBOT_AFFINITY,
    ROBOT_BIT,
    add_landmarks,
    add_servo,
    damp_servos,
    shell,
    shell_box,
    stiffen_limits,
    tune_joint,
    zero_pose,
)
from tools.robot_models.csv_tree import add_link, read_rows, set_inertia

WHITE = (0.86, 0.87, 0.9, 1.0)
GREY = (0.35, 0.37, 0.42, 1.0)
ORANGE = (0.9, 0.45, 0.1, 1.0)
#: Servo stiffness (N m/rad) by part of the joint's name; force limits are the table's.
STIFFNESS = {"lumbar": 1800.0, "hip": 800.0, "knee": 400.0, "ankle": 200.0, "shoulder": 250.0, "elbow": 200.0, "wrist": 60.0}
FORCE = {"ankle": 18.0, "hip_roll": 50.0, "hip_yaw": 50.0}
FORCE_DEFAULT = 150.0
FINGER_TRAVEL_M = 0.06
FINGER_SERVO = (400.0, 30.0)


def _add_gripper(wrist: mujoco.MjsBody, pose: tuple[np.ndarray, np.ndarray], side: str) -> None:
    """Adds palm, two sliding fingers and the grasp site below the wrist; given in the world at the zero pose (arm hanging)."""
    rotation = pose[1]
    down, lateral = np.array([0.0, 0.0, -1.0]), np.array([0.0, 1.0, 0.0])
    local_down, local_lateral = rotation.T @ down, rotation.T @ lateral
    contact = {"contype": ROBOT_BIT, "conaffinity": ROBOT_AFFINITY, "friction": list(HAND_FRICTION)}
    frame = np.stack([local_down, local_lateral, np.cross(local_down, local_lateral)], axis=1)
    quat = np.zeros(4)
    mujoco.mju_mat2Quat(quat, frame.flatten())
    # gripper frame: x along the fingers, y the closing direction
    base = wrist.add_body(name=f"{side}_gripper_base", pos=0.045 * local_down, quat=quat)
    base.mass, base.ipos = 0.25, np.array([0.02, 0.0, 0.0])
    base.fullinertia, base.explicitinertial = np.array([3e-4, 3e-4, 3e-4, 0.0, 0.0, 0.0]), True
    box = mujoco.mjtGeom.mjGEOM_BOX
    base.add_geom(
        name=f"{side}_palm",
        type=box,
        size=[0.02, 0.07, 0.025],
        pos=[0.0, 0.0, 0.0],
        rgba=list(GREY),
        mass=0.0,
        group=2,
        **contact,
    )
    for finger, sign in (("a", 1.0), ("b", -1.0)):
        body = base.add_body(name=f"{side}_finger_{finger}", pos=[0.02, 0.0, 0.0])
        body.mass, body.ipos = 0.05, np.array([0.04, sign * 0.006, 0.0])
        body.fullinertia, body.explicitinertial = np.array([2e-5, 4e-5, 4e-5, 0.0, 0.0, 0.0]), True
        body.add_joint(
            name=f"{side}_finger_{finger}_joint",
            type=mujoco.mjtJoint.mjJNT_SLIDE,
            axis=[0.0, sign, 0.0],
            range=[0.0, FINGER_TRAVEL_M],
            limited=True,
        )
        body.add_geom(
            name=f"{side}_pad_{finger}",
            type=box,
            size=[0.045, 0.006, 0.014],
            pos=[0.045, sign * 0.006, 0.0],
            rgba=list(ORANGE),
            mass=0.0,
            group=2,
            **contact,
        )
    base.add_site(name=f"{side}_grasp", pos=[0.07, 0.0, 0.0], size=[0.004, 0.0, 0.0], group=4)


def build_x1(table: Path, target: Path) -> None:
    """Writes `x1.xml` to `target` from the kinematics table."""
    spec = mujoco.MjSpec()
    spec.modelname = "x1"
    spec.compiler.degree = False
    spec.compiler.autolimits = True
    bodies: dict[str, mujoco.MjsBody] = {}
    for row in read_rows(table, "x1"):
        if row.kind == "free":
            root = spec.worldbody.add_body(name=row.link, pos=[0.0, 0.0, 0.626])
            set_inertia(root, row)
            root.add_freejoint(name="root")
            bodies[row.link] = root
        else:
            bodies[row.link] = add_link(bodies[row.parent], row)
    pose = zero_pose(spec)
    at = {name: pose[name][0] for name in pose}

    def limb(link: str, start: np.ndarray, end: np.ndarray, radius: float, rgba: tuple[float, ...], **kwargs: object) -> None:
        shell(bodies[link], pose[link], start, end, radius, rgba, **kwargs)  # type: ignore[arg-type]

    trunk = "link_lumbar_pitch"
    shell_box(bodies["x1-body"], pose["x1-body"], [0.0, 0.0, 0.65], [0.075, 0.11, 0.07], GREY)
    shell_box(bodies[trunk], pose[trunk], [0.0, 0.0, 0.94], [0.085, 0.125, 0.13], WHITE)
    shell_box(bodies[trunk], pose[trunk], [0.087, 0.0, 0.97], [0.002, 0.07, 0.04], ORANGE)
    limb(trunk, np.array([0.0, 0.0, 0.78]), np.array([0.0, 0.0, 0.84]), 0.07, GREY)
    limb(trunk, np.array([0.0, 0.0, 1.07]), np.array([0.0, 0.0, 1.12]), 0.035, GREY)
    limb(trunk, np.array([0.01, -0.015, 1.185]), np.array([0.01, 0.015, 1.185]), 0.085, WHITE)
    shell_box(bodies[trunk], pose[trunk], [0.085, 0.0, 1.19], [0.015, 0.06, 0.03], (0.05, 0.05, 0.06, 1.0))
    for side in ("left", "right"):
        shoulder, elbow = at[f"link_{side}_shoulder_pitch"], at[f"link_{side}_elbow_yaw"]
        upper = np.array([0.002, at[f"link_{side}_elbow_yaw"][1], 1.038])
        bend, wrist = np.array([0.002, elbow[1], 0.876]), at[f"link_{side}_wrist_roll"]
        limb(f"link_{side}_shoulder_pitch", shoulder, upper, 0.045, GREY)
        limb(f"link_{side}_shoulder_roll", upper, (upper + bend) / 2, 0.04, WHITE)
        limb(f"link_{side}_shoulder_yaw", (upper + bend) / 2, bend, 0.038, WHITE)
        limb(f"link_{side}_elbow_pitch", bend, elbow, 0.038, GREY)
        limb(f"link_{side}_elbow_yaw", elbow, wrist, 0.033, WHITE, name=f"{side}_forearm", collides=True)
        limb(f"link_{side}_wrist_roll", wrist, wrist - np.array([0.0, 0.0, 0.03]), 0.028, GREY)
        hip, ankle = at[f"link_{side}_hip_roll"], at[f"link_{side}_ankle_roll"]
        knee_link = "link_lleft_knee_pitch" if side == "left" else "link_right_knee_pitch"
        knee = np.array([0.002, ankle[1], 0.346])
        limb(f"link_{side}_hip_pitch", at[f"link_{side}_hip_pitch"], np.array([0.002, ankle[1], 0.6]), 0.05, GREY)
        limb(f"link_{side}_hip_roll", np.array([0.002, hip[1], hip[2]]), np.array([0.002, ankle[1], 0.5]), 0.05, GREY)
        limb(f"link_{side}_hip_yaw", np.array([0.002, ankle[1], 0.5]), knee, 0.05, WHITE)
        limb(knee_link, knee, ankle + np.array([0.0, 0.0, 0.03]), 0.04, WHITE)
        foot = [0.035, float(ankle[1]), 0.0205]
        shell_box(bodies[f"link_{side}_ankle_roll"], pose[f"link_{side}_ankle_roll"], foot, [0.1, 0.04, 0.0205], GREY)
        _add_gripper(bodies[f"link_{side}_wrist_roll"], pose[f"link_{side}_wrist_roll"], side)
    for joint in spec.joints:
        if int(joint.type) == int(mujoco.mjtJoint.mjJNT_FREE):
            continue
        if int(joint.type) == int(mujoco.mjtJoint.mjJNT_SLIDE):
            tune_joint(joint, armature=0.05, damping=10.0)
            stiffen_limits(joint)
            add_servo(spec, joint, *FINGER_SERVO)
            continue
        stiffness = next(value for part, value in STIFFNESS.items() if part in joint.name)
        armature = 0.02 if "wrist" in joint.name else 0.08
        tune_joint(joint, armature, damping=2.0 * float(np.sqrt(stiffness * armature)))
        add_servo(spec, joint, stiffness, next((v for part, v in FORCE.items() if part in joint.name), FORCE_DEFAULT))
    damp_servos(spec)
    for body in spec.bodies[1:]:
        body.gravcomp = 1.0
    origin, rotation = pose[trunk]
    pitch = np.radians(35.0)
    right, up = np.array([0.0, -1.0, 0.0]), np.array([np.sin(pitch), 0.0, np.cos(pitch)])
    bodies[trunk].add_camera(
        name="head",
        pos=rotation.T @ (np.array([0.105, 0.0, 1.19]) - origin),
        xyaxes=[*(rotation.T @ right), *(rotation.T @ up)],
        fovy=72.0,
    )
    add_landmarks(bodies[trunk], {"chest": [0.0, 0.0, 0.98], "head": [0.03, 0.0, 1.185]}, pose[trunk])
    for side in ("left", "right"):
        link = f"link_{side}_ankle_roll"
        add_landmarks(bodies[link], {f"{side}_sole": [0.035, float(at[link][1]), 0.0]}, pose[link])
    spec.compile()
    target.mkdir(parents=True, exist_ok=True)
    (target / "x1.xml").write_text(spec.to_xml(), encoding="utf-8")
