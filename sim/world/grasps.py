"""What the hands hold: objects, and doors, drawers and lids by their handles."""

from __future__ import annotations

from typing import Final

import mujoco
import numpy as np
from numpy.typing import NDArray

from interface.bodies import SIDES
from sim.scene.compiler import BASE_JOINTS
from sim.scene.objects import MovingPart, ObjectInstance
from sim.world.constraints import GraspConstraints
from sim.world.poses import ObjectPoses
from sim.world.scene_state import SceneState, WorldError
from sim.world.servos import Servos

#: Objects that are lighter than this are opened with gentle fingers.
_LIGHT_KG: Final = 1.5


class Grasps:
    """Grasps of both hands.

    Args:
        scene: the running scene, with a robot.
        servos: where the hands are.
        poses: where the objects are.

    Attributes:
        constraints: what ties bodies to hands in the physics.
    """

    def __init__(self, scene: SceneState, servos: Servos, poses: ObjectPoses) -> None:
        self._scene, self._servos, self._poses = scene, servos, poses
        arms = scene.the_robot().arms
        sites = {side: int(scene.model.site(arms[side].grasp_site).id) for side in SIDES}
        hands = {side: int(scene.model.site_bodyid[site]) for side, site in sites.items()}
        self.constraints = GraspConstraints(scene.model, scene.data, hands, sites)
        self._movable_body = {body: item.movable for item in scene.objects.values() for body in item.body_ids}

    def held(self, arm: str) -> str | None:
        """Id of what an arm holds, a door's furniture included."""
        return next((name for name, item in self._scene.objects.items() if arm in item.held_by), None)

    def attach(
        self,
        arm: str,
        object_id: str,
        part: MovingPart | None = None,
        point: NDArray[np.float64] | None = None,
        steady: bool = False,
    ) -> None:
        """Ties an object to a hand as it is now: free objects rigidly, doors, drawers and lids by a ball joint.

        Whether contact justifies it is the caller's decision.

        Args:
            arm: left or right.
            object_id: the object.
            part: its door, drawer or lid that is taken; None takes a free object as a whole, and the nearest door of furniture.
            point: (3,) where the ball joint is, world frame; the grasp site when None.
            steady: whether a free object is steadied where it is instead of being taken.

        Raises:
            WorldError: when the arm holds something, or the object is furniture without a door.
        """
        item = self._scene.object(object_id)
        if self.constraints.holds(arm):
            raise WorldError(f"the {arm} arm already holds {self.held(arm)}")
        if not item.movable and not item.moving:
            raise WorldError(f"{object_id} is furniture and cannot be held")
        if item.movable and part is None:
            self.constraints.attach(arm, item.body_id, rigid=True, lids=item.body_ids[1:], steady=steady)
            self._servos.hold_hand(arm)
        else:
            body = self._nearest_door(arm, item) if part is None else part.body_id
            gentle = item.movable and item.mass_kg < _LIGHT_KG
            self.constraints.attach(arm, body, rigid=False, point=point, gentle=gentle)
        item.held_by.append(arm)

    def give_way(self, object_id: str, part: MovingPart) -> None:
        """Disables contacts of the hands with a lid that one of them is about to grasp, and with a free object below it.

        Fingers around a tab would else press on the object, or hook into its rim and lift it.
        """
        item = self._scene.object(object_id)
        self.constraints.give_way(part.body_id, item.body_id if item.movable else None)

    def detach(self, arm: str) -> str | None:
        """Lets go of whatever the arm holds and returns its id."""
        name = self.held(arm)
        if name is None:
            return None
        item = self._scene.objects[name]
        item.held_by.remove(arm)
        body = self.constraints.held_body(arm)
        if body is not None:
            self.constraints.detach(arm, item.body_ids if item.movable else (body,), last=not item.held_by)
        return name

    def settle(self) -> None:
        """Ends grasps that were torn, and restores contacts of the hands with released objects once they are clear of them."""
        for arm in SIDES:
            if self.constraints.torn(arm):
                self.detach(arm)
        if self.constraints.released:
            self.constraints.settle_released(self._movable_body)

    def put_base(self, x_m: float, y_m: float, yaw_rad: float, pelvis_height_m: float | None = None) -> None:
        """Puts the robot somewhere at once, at rest, with what its hands hold; nothing else moves."""
        model, data, servos = self._scene.model, self._scene.data, self._servos
        mujoco.mj_forward(model, data)
        held = [item for item in self._scene.objects.values() if item.movable and item.held_by]
        before = {side: servos.grasp_pose(side) for side in SIDES}
        offsets = [np.linalg.inv(before[item.held_by[0]]) @ self._poses.pose(item.object_id) for item in held]
        servos.set_base_target(x=x_m, y=y_m, yaw=yaw_rad)
        if pelvis_height_m is not None:
            servos.command_height(pelvis_height_m)
            servos.jump(self._scene.the_robot().leg_joints, at_rest=False)
        servos.jump(BASE_JOINTS if pelvis_height_m is not None else ("base_x", "base_y", "base_yaw"), at_rest=True)
        mujoco.mj_kinematics(model, data)
        for item, offset in zip(held, offsets, strict=True):
            pose = servos.grasp_pose(item.held_by[0]) @ offset
            data.qpos[item.qpos_adr : item.qpos_adr + 3] = pose[:3, 3]
            mujoco.mju_mat2Quat(data.qpos[item.qpos_adr + 3 : item.qpos_adr + 7], pose[:3, :3].flatten())
            data.qvel[item.dof_adr : item.dof_adr + 6] = 0.0
        mujoco.mj_forward(model, data)

    def _nearest_door(self, arm: str, item: ObjectInstance) -> int:
        hand, sites = self._servos.grasp_pose(arm)[:3, 3], self._scene.data.site_xpos
        return min(item.moving, key=lambda part: float(np.linalg.norm(sites[part.handle_site] - hand))).body_id
