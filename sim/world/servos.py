"""The robot's joints: positions, servo commands and hand poses.

Base joints are x, y, pelvis height and yaw (m, rad), and the trunk's forward pitch, which follows from the height.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from interface.bodies import SIDES
from robots.build_solver import robot_kit
from sim.scene.compiler import BASE_JOINTS
from sim.world.recorder import Recorder
from sim.world.scene_state import SceneState, WorldError


class Servos:
    """Position servos of one robot.

    Args:
        scene: the running scene.
        recorder: knows which joints open a hand; None without a robot.
    """

    def __init__(self, scene: SceneState, recorder: Recorder | None) -> None:
        self._scene, self._recorder = scene, recorder
        self._actuator = {scene.model.actuator(i).name: i for i in range(scene.model.nu)}
        robot = () if scene.robot is None else (*BASE_JOINTS, *scene.robot.joints)
        self._position = {name: int(scene.model.joint(name).qposadr[0]) for name in robot}
        self._base = [self._position[name] for name in BASE_JOINTS[:4] if robot]

    @property
    def base_pose(self) -> NDArray[np.float64]:
        """(4,) x, y, pelvis height (m) and yaw (rad) of the base."""
        return self._scene.data.qpos[self._base]

    @property
    def base_target(self) -> NDArray[np.float64]:
        """(4,) commanded base pose."""
        return np.array([self._scene.data.ctrl[self._actuator[name]] for name in BASE_JOINTS[:4]])

    def set_base_target(self, *, x: float | None = None, y: float | None = None, yaw: float | None = None) -> None:
        """Commands the base; None keeps a target. Yaw is not wrapped: the servo follows the number as given."""
        for name, value in (("base_x", x), ("base_y", y), ("base_yaw", yaw)):
            if value is not None:
                self._scene.data.ctrl[self._actuator[name]] = value

    def command_height(self, pelvis_height_m: float) -> None:
        """Commands a pelvis height with the legs and the trunk's lean that belong to it, clipped to the robot's range."""
        robot = self._scene.the_robot()
        crouches = robot_kit(robot).crouches
        height = crouches.clamp(pelvis_height_m)
        self._scene.data.ctrl[self._actuator["base_z"]] = height
        self._scene.data.ctrl[self._actuator["base_pitch"]] = crouches.pitch(height)
        self.set_joint_targets(dict(zip(robot.leg_joints, map(float, crouches.legs(height)), strict=True)))

    def set_joint_targets(self, targets: Mapping[str, float]) -> None:
        """Commands named actuated joints (rad or m).

        Raises:
            WorldError: on a joint without actuator.
        """
        for name, value in targets.items():
            index = self._actuator.get(name)
            if index is None:
                raise WorldError(f"joint {name!r} has no actuator; allowed: {', '.join(self._actuator)}")
            self._scene.data.ctrl[index] = value

    def joint_targets(self) -> dict[str, float]:
        """Commanded positions of the actuated joints, the base left out."""
        ctrl = self._scene.data.ctrl
        return {name: float(ctrl[i]) for name, i in self._actuator.items() if name not in BASE_JOINTS}

    def joint_positions(self) -> dict[str, float]:
        """Positions of all joints of the robot, by name."""
        data = self._scene.data
        return {name: float(data.qpos[self._position[name]]) for name in self._scene.the_robot().joints}

    def set_hand(self, arm: str, opening: float) -> None:
        """Commands a hand, 0 closed to 1 open."""
        spec = self._scene.the_robot().arms[arm]
        share = float(np.clip(opening, 0.0, 1.0))
        values = np.asarray(spec.hand_closed) + share * (np.asarray(spec.hand_open) - np.asarray(spec.hand_closed))
        self.set_joint_targets(dict(zip(spec.hand_joints, map(float, values), strict=True)))

    def hold_hand(self, arm: str) -> None:
        """Commands a hand's joints to where they are: fingers at rest on something press on no further."""
        positions = self.joint_positions()
        self.set_joint_targets({name: positions[name] for name in self._scene.the_robot().arms[arm].hand_joints})

    def hand_opening(self, arm: str) -> float:
        """Measured opening of a hand, 0 closed to 1 open."""
        self._scene.the_robot()
        assert self._recorder is not None
        return float(self._recorder.hands(self._scene.data)[SIDES.index(arm)])

    def grasp_pose(self, arm: str) -> NDArray[np.float64]:
        """(4, 4) pose of an arm's grasp site, world frame."""
        site, pose = int(self._scene.model.site(self._scene.the_robot().arms[arm].grasp_site).id), np.eye(4)
        pose[:3, :3] = self._scene.data.site_xmat[site].reshape(3, 3)
        pose[:3, 3] = self._scene.data.site_xpos[site]
        return pose

    def distance_to(self, bounds: tuple[NDArray[np.float64], NDArray[np.float64]]) -> float:
        """Horizontal metres from the base to the nearest point of a bounding box (minimum, maximum), 0 without a robot."""
        if self._scene.robot is None:
            return 0.0
        (low, high), base = bounds, self.base_pose
        gap = np.maximum(np.maximum(low[:2] - base[:2], base[:2] - high[:2]), 0.0)
        return float(np.hypot(*gap))

    def jump(self, names: tuple[str, ...], at_rest: bool) -> None:
        """Sets joint positions to their commands at once."""
        model, data = self._scene.model, self._scene.data
        for name in names:
            joint = model.joint(name)
            data.qpos[joint.qposadr[0]] = data.ctrl[self._actuator[name]]
            if at_rest:
                data.qvel[joint.dofadr[0]] = 0.0

    def hold_still(self) -> None:
        """Commands every servo to where its joint is."""
        model, data = self._scene.model, self._scene.data
        for name, index in self._actuator.items():
            data.ctrl[index] = data.qpos[model.joint(name).qposadr[0]]
