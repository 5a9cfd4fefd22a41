"""Present contacts: what the robot collides with and what objects rest on."""

from __future__ import annotations

from typing import Final

import mujoco
import numpy as np
from numpy.typing import NDArray

from interface.bodies import Arm
from robots.spec import RobotSpec
from sim.scene.objects import ObjectInstance
from sim.skills.body.joints import JointMap
from sim.world.world import World

Array = NDArray[np.float64]
_TOUCH_M: Final = 0.001


class Contacts:
    """Contacts of one robot and its world."""

    def __init__(self, world: World, joints: JointMap, spec: RobotSpec) -> None:
        self._world, self._joints = world, joints
        model = world.model
        self._hand_joints = np.array([int(model.joint(n).id) for arm in Arm for n in spec.arms[arm.value].hand_joints])
        sliding = model.jnt_type[self._hand_joints] == int(mujoco.mjtJoint.mjJNT_SLIDE)
        self._hand_scale = np.where(sliding, 0.2, 1.0)
        self._mine = np.isin(model.geom_bodyid, list(world.scene.robot_bodies))

    def pushed(self) -> Array:
        """(3,) how strongly obstacles push the robot.

        How deep it presses (m), how far the hands' joints are bent beyond their limits (rad, and m / 0.2 of sliding ones), and
        how far an arm's joint is from its target (rad), which is what yields first; 0 for the last one while nothing touches
        the robot or what one hand holds; a load in both hands brushes along what it is set on.
        """
        model, data = self._world.model, self._world.data
        depth_m, touches = self._pressed()
        values, scale = data.qpos[model.jnt_qposadr[self._hand_joints]], self._hand_scale
        low, high = model.jnt_range[self._hand_joints].T
        bent = float(np.max(np.maximum(low - values, values - high) / scale, initial=0.0))
        measured, told = self._joints.arm_positions, self._joints.arms
        off = max(float(np.max(np.abs(data.qpos[measured[arm]] - data.ctrl[told[arm]]))) for arm in Arm)
        return np.array([depth_m, bent, off if touches else 0.0])

    def rests(self, obj: ObjectInstance) -> bool:
        """Whether an object touches something that is not part of the robot, from above."""
        data, mine = self._world.data, set(map(int, obj.geom_ids))
        owner = self._world.scene.object_of_geom
        for contact in data.contact[: data.ncon]:
            a, b = int(contact.geom1), int(contact.geom2)
            other = b if a in mine else a if b in mine else -1
            if other >= 0 and (owner[other] >= 0 or other == 0) and abs(float(contact.frame[2])) > 0.6 and contact.dist < 0.0:
                return True
        return False

    def touches_robot(self, obj: ObjectInstance) -> bool:
        """Whether a part of the robot is within a millimetre of an object; asleep, it has no contacts that would tell."""
        model, data = self._world.model, self._world.data
        own = [geom for geom in obj.geom_ids if model.geom_contype[geom] > 0]
        for mine in np.flatnonzero(self._mine & (model.geom_contype > 0)):
            for geom in own:
                near = model.geom_rbound[mine] + model.geom_rbound[geom] + _TOUCH_M
                if np.linalg.norm(data.geom_xpos[mine] - data.geom_xpos[geom]) > near:
                    continue
                if mujoco.mj_geomDistance(model, data, int(mine), int(geom), _TOUCH_M, None) < _TOUCH_M:
                    return True
        return False

    def _pressed(self) -> tuple[float, bool]:
        """How deep the robot presses into what it does not hold, metres, and whether it, or what a hand holds, touches it."""
        data = self._world.data
        if data.ncon == 0:
            return 0.0, False
        owner = self._contact_owner()[data.contact.geom[: data.ncon]]  # (C, 2): 2 robot, 1 in one hand, 0 in both, -1 else
        touched, most = np.min(owner, axis=1) < 0, np.max(owner, axis=1)
        pressed, caught = touched & (most == 2), touched & (most >= 1)
        return float(-np.min(data.contact.dist[: data.ncon][pressed], initial=0.0)), bool(caught.any())

    def _contact_owner(self) -> NDArray[np.int64]:
        """(ngeom,) 2 for the robot's geoms, 1 for those of what one hand holds, 0 for what both hold, -1 for all others."""
        owner = np.where(self._mine, 2, -1)
        for obj in self._world.objects.values():
            if obj.held_by:
                owner[obj.geom_ids] = 2 - len(obj.held_by)
        return owner
