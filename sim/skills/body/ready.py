"""Postures between actions, solved once per robot and arm."""

from __future__ import annotations

from functools import cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

from interface.bodies import Arm
from robots.arm_ik import PerArmSolver
from robots.build_solver import RobotKit
from robots.solver import ReachTarget
from sim.skills.reach_map import HandPose, reach_maps

Array = NDArray[np.float64]

#: Height of the highest surfaces that a robot walks up to with a load, with some room below the load, metres.
_WORKTOP_M: Final = 0.97
#: How far the ready hand is below the shoulder, as a share of the arm's reach: usually, for robots whose hands would then be
#: lower than worktops, and with a load of such robots. Chosen by hand.
_READY_DROP, _LOW_READY_DROP, _LOW_CARRY_DROP = 0.17, -0.04, -0.16


@cache
def ready_posture(kit: RobotKit, arm: Arm, raised: bool = False) -> Array:
    """(A,) rest posture: hand in front of the shoulder, fingers level, above table height and outside the camera's view.

    Args:
        kit: the robot.
        arm: which one.
        raised: whether the hand is above the shoulder.
    """
    reach_map = reach_maps(kit)[arm.value]
    inward = np.array([0.0, -1.0 if arm is Arm.LEFT else 1.0, 0.0])
    ahead = min(0.3 * reach_map.reach_m, kit.spec.footprint_radius_m - 0.06)  # the disc that navigation keeps free
    drop = _LOW_CARRY_DROP if raised else _LOW_READY_DROP if _low_shoulders(kit) else _READY_DROP
    point = np.array([ahead, reach_map.shoulder[1], reach_map.shoulder[2] - drop * reach_map.reach_m])
    hand_target = HandPose(point, np.array([1.0, 0.0, 0.0]), inward)
    solver = PerArmSolver(kit.model, kit.crouches)
    columns = kit.model.indices(kit.spec.arms[arm.value].joints)
    site = (kit.spec.arms[arm.value].grasp_site,)
    root = np.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0])
    rotation = hand_target.rotation(hand_target.pointing, inward) if hand_target.pointing is not None else np.eye(3)
    height = kit.spec.standing_pelvis_height_m
    elbow = kit.spec.key_bodies[f"{arm.value}_elbow"]
    tip_m = kit.spec.hand.tip_m
    best: tuple[float, Array] | None = None
    for start in reach_map.starts(hand_target, 60, radius_m=0.15, near=np.array(kit.spec.arms[arm.value].carry)):
        q = kit.model.posture()
        q[columns] = start
        target = ReachTarget(point, rotation, 0.3, 0.2)
        result = solver.solve({arm.value: target}, q, pelvis_height_m=height, restarts=0)
        hand, joint = kit.model.frames(root, result.q, (*site, elbow))
        away = result.q[columns] - kit.spec.arms[arm.value].carry
        # what reaches ahead must be above worktops: the elbow, and the fingers unless they point up
        low = max(float(joint[0, 3]) - 0.02, float(hand[0, 3] + tip_m * hand[0, 0]) - 0.3 + float(hand[2, 0]) * 0.1)
        cost = (
            5.0 * result.position_error_m
            + 0.5 * (1.0 - float(hand[0, 0]))
            + (1.0 - float(hand[:3, 1] @ inward))
            + 0.04 * float(away @ away)
            + 6.0 * max(low, 0.0)
            + 50.0 * max(-result.self_clearance_m, 0.0)
        )
        if best is None or cost < best[0]:
            best = (cost, result.q[columns].copy())
    assert best is not None
    return best[1]


@cache
def carrying_posture(kit: RobotKit, arm: Arm) -> Array:
    """(A,) posture in which a hand carries something: the ready one, or higher and closer on robots with low shoulders.

    A load before a hand that is lower than a worktop would run into its front when the robot steps up to it.
    """
    return ready_posture(kit, arm, raised=_low_shoulders(kit))


def _low_shoulders(kit: RobotKit) -> bool:
    """Whether hands held as usual would be lower than worktops, and run into their fronts."""
    reach_map = reach_maps(kit)["left"]
    return kit.spec.standing_pelvis_height_m + float(reach_map.shoulder[2]) - _READY_DROP * reach_map.reach_m < _WORKTOP_M
