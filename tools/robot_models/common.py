"""What both robots' MJCF share: collision bits, servo gains, geometry given in world coordinates at the zero pose.

Collision bits of the whole simulator (`contype`/`conaffinity`): furniture and floor 1, movable objects 2, robot hands and
forearms 4. Hands touch furniture and objects; the robot does not touch itself, and legs and trunk touch nothing, because the
base moves on planned free paths. Geom groups: 2 is seen, 3 is collision only, sites are in group 4. Every body is gravity-
compensated, as a robot's own controller does, so that servos hold a posture without an offset.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import mujoco
import numpy as np
from numpy.typing import NDArray

ROBOT_BIT = 4
ROBOT_AFFINITY = 3
HAND_FRICTION = (1.5, 0.02, 0.001)
#: Share of the critical damping that keeps the overshoot of a step below 5 %, in postures with more inertia too.
DAMPING_RATIO = 0.9
#: Share of it that is friction of the joint; the rest is the servo's.
PASSIVE_SHARE = 0.15
#: Parts of the names of joints of hands.
_FINGERS = ("proximal", "finger")
NO_CONTACT = {"contype": 0, "conaffinity": 0}


def tune_joint(joint: mujoco.MjsJoint, armature: float, damping: float) -> None:
    """Sets reflected inertia (kg m²) and damping (N m s/rad)."""
    joint.armature = armature
    joint.damping = [damping, 0.0, 0.0]


def stiffen_limits(joint: mujoco.MjsJoint) -> None:
    """Makes the ends of a finger's range hard: a hand that is pressed against furniture must not be bent beyond them."""
    joint.solref_limit = [0.01, 1.0]
    joint.solimp_limit = [0.95, 0.99, 0.001, 0.5, 2.0]


def add_servo(spec: mujoco.MjSpec, joint: mujoco.MjsJoint, stiffness: float, force: float) -> None:
    """Adds a position servo named like its joint; `stiffness` in N m/rad (or N/m), `force` its limit in N m (or N)."""
    servo = spec.add_actuator(name=joint.name, target=joint.name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
    servo.set_to_position(kp=stiffness)
    servo.ctrlrange = joint.range
    servo.ctrllimited = True
    servo.forcerange = [-force, force]
    servo.forcelimited = True


def damp_servos(spec: mujoco.MjSpec) -> None:
    """Raises the damping to `DAMPING_RATIO` with what each servo moves at the zero pose, links and hand included.

    `tune_joint` alone knows the reflected inertia only; a waist that carries trunk and arms would swing. Most of the damping
    is the servo's own, so that it is within the servo's force limit: against a damped joint an elbow could not be moved faster
    than 2.3 rad/s. Fingers keep theirs in the joint, so that a hand closes slowly with all its force.
    """
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    inertia = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, inertia)
    for servo in spec.actuators:
        dof = int(model.joint(servo.target).dofadr[0])
        needed = 2.0 * DAMPING_RATIO * float(np.sqrt(servo.gainprm[0] * inertia[dof, dof]))
        joint = spec.joint(servo.target)
        total = max(float(joint.damping[0]), needed)
        passive = total if any(part in joint.name for part in _FINGERS) else PASSIVE_SHARE * total
        joint.damping = [round(passive, 4), 0.0, 0.0]
        if passive < total:
            bias = np.array(servo.biasprm)
            bias[2] = -round(total - passive, 4)
            servo.biasprm = bias


def zero_pose(spec: mujoco.MjSpec) -> dict[str, tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """World position and (3, 3) rotation of every body at the zero pose."""
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    return {model.body(i).name: (data.xpos[i].copy(), data.xmat[i].reshape(3, 3).copy()) for i in range(1, model.nbody)}


def shell(
    body: mujoco.MjsBody,
    pose: tuple[NDArray[np.float64], NDArray[np.float64]],
    start: Sequence[float],
    end: Sequence[float],
    radius: float,
    rgba: Sequence[float],
    *,
    name: str = "",
    collides: bool = False,
) -> None:
    """Adds a massless capsule between two points given in the world at the zero pose."""
    origin, rotation = pose
    a, b = rotation.T @ (np.asarray(start) - origin), rotation.T @ (np.asarray(end) - origin)
    bits = {"contype": ROBOT_BIT, "conaffinity": ROBOT_AFFINITY} if collides else NO_CONTACT
    body.add_geom(
        name=name,
        type=mujoco.mjtGeom.mjGEOM_CAPSULE,
        size=[radius, 0.0, 0.0],
        fromto=[*a, *b],
        rgba=list(rgba),
        mass=0.0,
        group=2,
        **bits,
    )


def shell_box(
    body: mujoco.MjsBody,
    pose: tuple[NDArray[np.float64], NDArray[np.float64]],
    centre: Sequence[float],
    half: Sequence[float],
    rgba: Sequence[float],
    *,
    name: str = "",
    collides: bool = False,
) -> None:
    """Adds a massless box aligned with the world at the zero pose."""
    origin, rotation = pose
    quat = np.zeros(4)
    mujoco.mju_mat2Quat(quat, rotation.T.flatten())
    bits = {"contype": ROBOT_BIT, "conaffinity": ROBOT_AFFINITY} if collides else NO_CONTACT
    body.add_geom(
        name=name,
        type=mujoco.mjtGeom.mjGEOM_BOX,
        size=list(half),
        pos=rotation.T @ (np.asarray(centre) - origin),
        quat=quat,
        rgba=list(rgba),
        mass=0.0,
        group=2,
        friction=list(HAND_FRICTION),
        **bits,
    )


def add_landmarks(
    body: mujoco.MjsBody,
    points: Mapping[str, Sequence[float]],
    pose: tuple[NDArray[np.float64], NDArray[np.float64]] | None = None,
) -> None:
    """Adds named sites; points are in the body frame, or in the world at the zero pose when `pose` is given.

    With `pose` the site's axes are the world's at the zero pose.
    """
    for name, point in points.items():
        quat = np.array([1.0, 0.0, 0.0, 0.0])
        position = np.asarray(point, dtype=float)
        if pose is not None:
            position = pose[1].T @ (position - pose[0])
            mujoco.mju_mat2Quat(quat, pose[1].T.flatten())
        body.add_site(name=name, pos=position, quat=quat, size=[0.004, 0.0, 0.0], group=4)
