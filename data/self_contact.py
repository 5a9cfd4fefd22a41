"""How deep a robot's posture presses it into itself, by MuJoCo's collision test on the primitive shapes of its own description.

It measures what `data.retarget` avoids with other shapes (`robots.self_collision`), so that the measure is not the
method's own. Neighbours do not count: bodies with at most two joints between them, a thigh and the pelvis, parts of one hand,
and pairs that overlap in the standing posture.

Paper: none; the definition is common practice for retargeted motion (non-adjacent contact deeper than a centimetre).
"""

from __future__ import annotations

from typing import Final

import mujoco
import numpy as np
from numpy.typing import NDArray

from robots.kinematics import RobotModel
from robots.leg_ik import crouch

Array = NDArray[np.float64]
#: Depth from which a contact counts as self-collision.
DEEP_M: Final = 0.01
_NEIGHBOURS: Final = 2
_HIP_JOINTS: Final = 3


class SelfContact:
    """A robot's primitive shapes in MuJoCo.

    Args:
        robot: the robot.
    """

    def __init__(self, robot: RobotModel) -> None:
        spec = robot.spec
        description = mujoco.MjSpec.from_file(str(spec.mjcf_path))
        for geom in description.geoms:  # before compiling, which derives the bodies' own bits from them
            solid = int(geom.type) != int(mujoco.mjtGeom.mjGEOM_MESH)
            geom.contype = geom.conaffinity = int(solid)
            geom.margin = 0.0
        model = description.compile()
        self._model, self._data = model, mujoco.MjData(model)
        self._free = int(model.jnt_qposadr[np.flatnonzero(model.jnt_type == int(mujoco.mjtJoint.mjJNT_FREE))[0]])
        self._joints = np.array([int(model.joint(name).qposadr[0]) for name in robot.joint_names])
        self._near = self._adjacent()
        root = model.body(spec.root_body).id
        for joint in spec.leg_joints:
            body = int(model.joint(joint).bodyid[0])
            if len(self._joints_above(body) ^ self._joints_above(root)) <= _HIP_JOINTS:
                self._near[root, body] = self._near[body, root] = True
        for arm in spec.arms.values():  # a closed hand touches itself
            fingers = {int(model.joint(name).bodyid[0]) for name in arm.hand_joints}
            hand = [body for body in range(model.nbody) if fingers & self._joints_above(body)]
            self._near[np.ix_(hand, hand)] = True
        low, high = spec.pelvis_height_range_m
        standing = robot.arm_posture(crouch(robot, high - 0.06 * (high - low) - 0.01).q, "rest")
        for a, b, _ in self._contacts(np.array([0.0, 0.0, 2.0, 1.0, 0.0, 0.0, 0.0]), standing):
            self._near[a, b] = self._near[b, a] = True

    def _joints_above(self, body: int) -> set[int]:
        """Bodies with a joint of their own on the way from a body to the world."""
        above = set()
        while body > 0:
            if self._model.body_jntnum[body]:
                above.add(body)
            body = int(self._model.body_parentid[body])
        return above

    def _adjacent(self) -> NDArray[np.bool_]:
        """(bodies, bodies) whether the way from one body to the other has at most two joints."""
        above = [self._joints_above(body) for body in range(self._model.nbody)]
        return np.array([[len(one ^ two) <= _NEIGHBOURS for two in above] for one in above])

    def _contacts(self, root_pose: Array, q: Array) -> list[tuple[int, int, float]]:
        data = self._data
        data.qpos[self._free : self._free + 7] = root_pose
        data.qpos[self._joints] = q
        mujoco.mj_kinematics(self._model, data)
        mujoco.mj_collision(self._model, data)
        if not data.ncon:
            return []
        bodies = self._model.geom_bodyid[data.contact.geom[: data.ncon]]
        found = zip(bodies[:, 0], bodies[:, 1], data.contact.dist[: data.ncon], strict=True)
        return [(int(a), int(b), float(distance)) for a, b, distance in found if not self._near[a, b]]

    def depth_m(self, root_pose: Array, q: Array) -> float:
        """Depth of the deepest contact between parts that are no neighbours, 0 without one.

        Args:
            root_pose: (7,) position (m) and quaternion (w, x, y, z) of the pelvis.
            q: (J,) joints.
        """
        return max((-distance for _, _, distance in self._contacts(root_pose, q)), default=0.0)

    def deepest(self, root_pose: Array, q: Array) -> tuple[str, str, float]:
        """The two bodies of the deepest such contact and its depth; empty names without one."""
        found = min(self._contacts(root_pose, q), key=lambda contact: contact[2], default=None)
        if found is None:
            return "", "", 0.0
        return self._model.body(found[0]).name, self._model.body(found[1]).name, -found[2]
