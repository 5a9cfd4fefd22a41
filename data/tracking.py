"""Can a robot's motors follow a retargeted clip? The upper body in MuJoCo's dynamics, pelvis and legs driven as recorded.

Pelvis, legs and fingers move exactly as recorded (cubic splines through the frames). Waist and arms are free under gravity and
feel the pelvis's accelerations; the servos of the description pull them after the recording,
`tau = kp (q* - q) + kd (v* - v)`, cut at their force limits, without knowing gravity. With F the free and D the driven degrees
of freedom, `M_FF a_F = tau + passive - bias - M_FD a_D`, integrated semi-implicitly.

It measures whether the motors are strong and fast enough for the gestures of a clip, and how far arms and trunk lag and sag. It
does not measure balance, nor what legs and feet would have to do, because the pelvis cannot fall: a clip that passes may still
throw the robot over. There are no contacts, with itself, the floor or things, and no joint stops.

Paper: data preparation, "filtered with PHC". PHC calls a clip failed when the mean distance of the bodies to the reference
exceeds 0.5 m, under a learned policy with balance; the same limit is applied here to the eight key bodies above the hips.
Shape letters: T frames, J joints, N free joints, S substeps.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import mujoco
import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline

from interface.motion import Motion
from robots.kinematics import RobotModel

Array = NDArray[np.float64]
#: PHC's limit for the mean body error.
FAILED_M: Final = 0.5
_STEP_S: Final = 0.002
#: `KEY_BODIES` above the hips: torso, head, shoulders, elbows, hands.
_UPPER: Final = slice(0, 8)


@dataclass(frozen=True, slots=True)
class Tracked:
    """What the simulated robot did.

    Attributes:
        joints: (T, J) rad, in the robot's joint order; driven joints as recorded.
        torque_ratio: (T, N) largest torque that a servo wanted since the frame before, as a share of its limit.
        error_rad: (T, N) recording minus simulation.
    """

    joints: Array
    torque_ratio: Array
    error_rad: Array


@dataclass(frozen=True, slots=True)
class Tracking:
    """How well a clip was followed.

    Attributes:
        joint_deg: mean distance of waist and arm joints to the recording.
        saturated_pct: frames in which a servo wanted more than its limit.
        torque_ratio: largest torque that a servo wanted, as a share of its limit.
        body_cm: mean distance of the key bodies above the hips to the recording.
        failed_pct: 100 when their mean exceeds 0.5 m in a frame (PHC's criterion), else 0.
        frames: length of the clip.
    """

    joint_deg: float
    saturated_pct: float
    torque_ratio: float
    body_cm: float
    failed_pct: float
    frames: int

    @staticmethod
    def mean(of: Sequence[Tracking]) -> Tracking:
        """Mean over clips, weighted by their frames; of the torque ratio the largest, and every clip fails or passes as one.

        Raises:
            ValueError: on an empty list.
        """
        if not of:
            raise ValueError("no clips to average; at least one is needed")
        weights = [one.frames for one in of]
        return Tracking(
            joint_deg=float(np.average([one.joint_deg for one in of], weights=weights)),
            saturated_pct=float(np.average([one.saturated_pct for one in of], weights=weights)),
            torque_ratio=max(one.torque_ratio for one in of),
            body_cm=float(np.average([one.body_cm for one in of], weights=weights)),
            failed_pct=float(np.mean([one.failed_pct for one in of])),
            frames=sum(weights),
        )


class Tracker:
    """A robot's dynamics with its own servos.

    Args:
        robot: the robot.

    Attributes:
        free: (N,) positions of the free joints, waist then arms, in the robot's joint order.
        stiffness, damping: (N,) of the servos, N m/rad and N m s/rad.
        limit: (N,) N m.
    """

    def __init__(self, robot: RobotModel) -> None:
        description = mujoco.MjSpec.from_file(str(robot.spec.mjcf_path))
        for body in description.bodies:
            body.gravcomp = 0.0
        model = description.compile()
        model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
        spec, self._robot, self._model, self._data = robot.spec, robot, model, mujoco.MjData(model)
        free = (*spec.waist_joints, *(joint for arm in spec.arms.values() for joint in arm.joints))
        self.free = robot.indices(free)
        root = np.flatnonzero(model.jnt_type == int(mujoco.mjtJoint.mjJNT_FREE))[0]
        self._root_q, self._root_v = int(model.jnt_qposadr[root]), int(model.jnt_dofadr[root])
        joints = [model.joint(name) for name in robot.joint_names]
        self._q = np.array([int(joint.qposadr[0]) for joint in joints])
        self._v = np.array([int(joint.dofadr[0]) for joint in joints])
        servos = [model.actuator(name).id for name in free]
        self.stiffness = model.actuator_gainprm[servos, 0].copy()
        self.damping = -model.actuator_biasprm[servos, 2]
        self.limit = model.actuator_forcerange[servos, 1].copy()

    def run(self, motion: Motion) -> Tracked:
        """Simulates a clip, which starts as recorded.

        Args:
            motion: of this robot; its rate may be any, a faster one plays it faster.

        Raises:
            ValueError: when it is of another robot, has no joint positions or fewer than two frames.
        """
        if motion.robot != self._robot.spec.name:
            raise ValueError(f"{motion.name} is of robot {motion.robot!r}; this is {self._robot.spec.name}")
        if motion.root_pose is None or motion.joint_positions is None or len(motion.joint_positions) < 2:
            raise ValueError(f"{motion.name}: joint positions of at least two frames are needed")
        substeps = int(np.ceil(1.0 / (motion.fps * _STEP_S)))
        step = 1.0 / (motion.fps * substeps)
        places, turns, joints = _reference(motion.root_pose, motion.joint_positions, motion.fps, substeps)
        # Velocity and acceleration of the reference in each step: of the pelvis along the world's axes, then about its own.
        turned = (turns[:-1].inv() * turns[1:]).as_rotvec()
        rates = np.concatenate([np.diff(places, axis=0), turned, np.diff(joints, axis=0)], axis=1) / step
        rates = np.concatenate([rates, rates[-1:]])
        gains = np.diff(rates, axis=0, append=rates[-1:]) / step
        return self._simulate(places, turns, joints, rates, gains, substeps, step)

    def _simulate(
        self, places: Array, turns: Rotation, joints: Array, rates: Array, gains: Array, substeps: int, step: float
    ) -> Tracked:
        model, data, free = self._model, self._data, self.free
        quaternions = turns.as_quat()[:, [3, 0, 1, 2]]
        inertia = np.zeros((model.nv, model.nv))
        f, root = self._v[free], self._root_v
        driven = np.setdiff1d(np.arange(model.nv), f)
        q, v = joints[0, free].copy(), rates[0, 6:][free].copy()
        done, wanted, most = [joints[0].copy()], [np.zeros(len(free))], np.zeros(len(free))
        acceleration = np.zeros(model.nv)
        for s in range(len(joints) - 1):
            data.qpos[self._root_q : self._root_q + 7] = [*places[s], *quaternions[s]]
            data.qpos[self._q] = joints[s]
            data.qpos[self._q[free]] = q
            data.qvel[root : root + 6] = rates[s, :6]
            data.qvel[self._v] = rates[s, 6:]
            data.qvel[f] = v
            mujoco.mj_forward(model, data)
            mujoco.mj_fullM(model, data, inertia)
            torque = self.stiffness * (joints[s, free] - q) + self.damping * (rates[s, 6:][free] - v)
            most = np.maximum(most, np.abs(torque) / self.limit)
            strong = np.abs(torque) < self.limit
            acceleration[root : root + 6] = gains[s, :6]
            acceleration[self._v] = gains[s, 6:]
            force = np.clip(torque, -self.limit, self.limit) + data.qfrc_passive[f] - data.qfrc_bias[f]
            force -= inertia[np.ix_(f, driven)] @ acceleration[driven]
            mass = inertia[np.ix_(f, f)] + np.diag(step * self.damping * strong)
            v = v + step * np.linalg.solve(mass, force + step * self.damping * strong * gains[s, 6:][free])
            q = q + step * v
            if (s + 1) % substeps == 0:
                frame = joints[s + 1].copy()
                frame[free] = q
                done.append(frame)
                wanted.append(most)
                most = np.zeros(len(free))
        simulated = np.array(done)
        return Tracked(simulated, np.array(wanted), joints[::substeps][:, free] - simulated[:, free])

    def __call__(self, motion: Motion) -> Tracking:
        """How well a clip is followed; see `run` for what is refused."""
        tracked = self.run(motion)
        assert motion.root_pose is not None
        assert motion.joint_positions is not None
        bodies = [
            self._robot.key_body_positions(root, q)[_UPPER] - self._robot.key_body_positions(root, recorded)[_UPPER]
            for root, q, recorded in zip(motion.root_pose, tracked.joints, motion.joint_positions, strict=True)
        ]
        distance = np.linalg.norm(np.array(bodies), axis=-1).mean(axis=1)  # (T,)
        return Tracking(
            joint_deg=float(np.rad2deg(np.abs(tracked.error_rad).mean())),
            saturated_pct=float(100.0 * np.mean((tracked.torque_ratio > 1.0).any(axis=1))),
            torque_ratio=float(tracked.torque_ratio.max()),
            body_cm=float(100.0 * distance.mean()),
            failed_pct=100.0 * float(distance.max() > FAILED_M),
            frames=len(distance),
        )


def _reference(root: Array, joints: Array, fps: float, substeps: int) -> tuple[Array, Rotation, Array]:
    """Positions (S, 3), rotations (S) and joints (S, J) at every substep, on smooth curves through the frames."""
    times = np.arange(len(root)) / fps
    fine = np.arange((len(root) - 1) * substeps + 1) / (fps * substeps)
    fine[-1] = times[-1]
    places = CubicSpline(times, np.concatenate([root[:, :3], joints], axis=1))(fine)
    turns = RotationSpline(times, Rotation.from_quat(root[:, [4, 5, 6, 3]]))(fine)
    return places[:, :3], turns, places[:, 3:]
