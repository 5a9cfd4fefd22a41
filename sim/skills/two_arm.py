"""Lift: both hands press on opposite sides of an object and raise it; `sim.skills.set_down` puts it down.

Both arms (and the waist, where the robot's solver owns it) are one inverse-kinematics problem here. The lift holds only when
both hands touch the object. Paper: dual-arm essential tasks.

Constants were chosen by hand; with them the certificates of the 359 benchmark tasks were made on both robots.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from interface.bodies import Arm
from interface.failures import FailureCode
from interface.steps import Action
from sim.scene.objects import ObjectInstance
from sim.skills.body.body import Body
from sim.skills.body.ik import BothGoal
from sim.skills.failures import SkillFailure, require
from sim.skills.grasps import solid_box
from sim.skills.manipulate import GRASP_GAP_M, OFF_BODY_M, OutcomeDraw
from sim.skills.plan_cache import cached_plan
from sim.skills.reach import diagnose, route
from sim.skills.reach_map import HandPose
from sim.skills.runner import CONTROL_DT_S, Skill, wait

Array = NDArray[np.float64]
_UP: Final = np.array([0.0, 0.0, 1.0])
#: Distance of the hands from the load's sides before they close on it, and how far they may be from where they are meant to be.
_APART_M: Final = 0.125
BOTH_TOLERANCE_M: Final = 0.02
#: How far an object has to come up to be lifted, and how far the first, straight part of the lift goes.
_RISE_M: Final = 0.08
_FIRST_M: Final = 0.05
#: Ways to hold what was lifted: metres up and towards the body.
_HOLDS: Final = ((0.3, 0.2), (0.3, 0.12), (0.3, 0.05), (0.25, 0.2), (0.25, 0.1), (0.2, 0.06), (0.2, 0.0),
                 (0.15, 0.05), (0.15, 0.0), (0.12, 0.0), (0.08, 0.0))  # fmt: skip
#: Sagging of what is held that is made up for.
_SAG_M: Final = 0.015
_MOST_SAG_M: Final = 0.06
#: Radians of tilt that a metre of height is worth when one of them is chosen.
_HEIGHT_WEIGHT: Final = 2.4


@dataclass(frozen=True, slots=True)
class BothReach:
    """A motion of both hands: around the object, before it, and pressing on it."""

    way: BothGoal
    before: BothGoal
    at: BothGoal


def _sides(body: Body, obj: ObjectInstance) -> dict[Arm, tuple[Array, Array]]:
    """Per arm the point that its palm presses on and the outward normal there, world frame."""
    pose = body.world.poses.pose(obj.object_id)
    rotation = pose[:3, :3]
    low, high = solid_box(obj)
    center = pose[:3, 3] + rotation @ (0.5 * (low + high))
    half = 0.5 * (high - low)
    left = body.posture.turn_to_world(np.array([0.0, 1.0, 0.0]))
    axis = int(np.argmax([abs(float(rotation[:, 0] @ left)), abs(float(rotation[:, 1] @ left))]))
    lateral = rotation[:, axis] * np.sign(rotation[:, axis] @ left)
    points: dict[Arm, tuple[Array, Array]] = {}
    grips = body.world.poses.grips(obj.object_id, "double") if obj.type.grips.get("double") and axis == 0 else None
    for arm, sign in ((Arm.LEFT, 1.0), (Arm.RIGHT, -1.0)):
        normal = sign * lateral
        point = center + normal * half[axis]
        if grips is not None:
            point = max(grips, key=lambda grip: float(grip @ normal))
        else:
            point = point + _UP * min(0.15 * half[2], 0.05)
        points[arm] = (point, normal)
    return points


def _goal(body: Body, sides: Mapping[Arm, tuple[Array, Array]], apart_m: float, start: Mapping[Arm, Array] | None) -> BothGoal:
    """Both hands beside the object, `apart_m` from its surfaces, fingers ahead and palms inward."""
    ahead = body.posture.turn_to_world(np.array([0.94, 0.0, -0.34]))
    hand_targets = {}
    for arm, (point, normal) in sides.items():
        inward = -normal
        hand_targets[arm] = HandPose(point + (apart_m - body.spec.hand.behind_m) * normal, ahead, inward)
    return body.ik.solve_both(hand_targets, start)


@cached_plan
def assess_lift(body: Body, action: Action) -> BothReach:
    """Plans Lift from the present state, without moving.

    Raises:
        SkillFailure: as Lift would before it moves.
    """
    assert action.object_id is not None
    require(body.world, action)
    obj = body.obj(action.object_id)
    sides = _sides(body, obj)
    name = (obj.object_id,)

    def search(body: Body) -> BothReach:
        before = _goal(body, sides, _APART_M, None)
        at = _goal(body, sides, 0.004, before.arms)
        if before.error_m > BOTH_TOLERANCE_M or at.error_m > BOTH_TOLERANCE_M:
            raise SkillFailure(FailureCode.OBSTRUCTED)
        risen = {arm: (point + _RISE_M * _UP, normal) for arm, (point, normal) in sides.items()}
        if _goal(body, risen, 0.004, at.arms).error_m > BOTH_TOLERANCE_M:  # taken, but not got off what carries it
            raise SkillFailure(FailureCode.OBSTRUCTED)
        for arm in Arm:
            if not (body.probe.free(arm, [before.arms[arm]], opening=1.0) and body.probe.free(arm, [at.arms[arm]], name, 1.0)):
                raise SkillFailure(FailureCode.OBSTRUCTED)
        return BothReach(way_round(body, before), before, at)

    try:
        return search(body)
    except SkillFailure:
        raise diagnose(body, {arm: point for arm, (point, _) in sides.items()}, search) from None


def way_round(body: Body, goal: BothGoal) -> BothGoal:
    """A posture of both arms half way to a goal, by a detour where the straight way meets something."""
    middle: dict[Arm, Array] = {}
    for arm in Arm:
        start = body.arms.commanded(arm)
        found = route(body, arm, start, goal.arms[arm], (), 1.0)
        if found is None:
            found = (body.ik.vias(arm)[1],)
        middle[arm] = found[0] if found else 0.5 * (start + goal.arms[arm])
    return BothGoal(middle, 0.5 * (body.arms.commanded_waist() + goal.waist), 0.0)


def lift(body: Body, action: Action, outcome_draw: OutcomeDraw) -> Skill:
    """Lift: takes an object between both hands and raises it.

    Raises:
        SkillFailure: what `assess_lift` refuses, GraspMissed, Dropped, or a contingency.
    """
    reach = assess_lift(body, action)
    assert action.object_id is not None
    obj = body.obj(action.object_id)
    for arm in Arm:
        body.hands.command(arm, 1.0)
    yield from body.arms.move_both([reach.way, reach.before])
    yield from _press(body, reach, obj)
    gaps = {arm: body.probe.hand_gap_m(arm, body.objects.solid_geoms(obj)) for arm in Arm}
    if max(gaps.values()) > GRASP_GAP_M:
        yield from body.arms.move_both([reach.before])
        yield from body.arms.stow_both()
        raise SkillFailure(FailureCode.GRASP_MISSED, {"gap_m": max(gaps.values())})
    outcome = outcome_draw(action)
    for arm in Arm:
        body.world.grasps.attach(arm.value, obj.object_id)
    first = _shifted(body, _FIRST_M, 0.0)
    yield from body.arms.move_both([first], speed=0.5)
    if outcome != "success":
        for arm in Arm:
            body.world.grasps.detach(arm.value)
        if outcome == "spilled":
            body.world.liquids.spill(obj)
        yield from body.arms.move_both([reach.before])
        yield from body.arms.stow_both()
        code = FailureCode.SPILLED if outcome == "spilled" else FailureCode.SLIPPED
        raise SkillFailure(code, contingency=outcome)
    options = [(up, _shifted(body, up, back)) for up, back in _HOLDS]
    options = [(up, goal) for up, goal in options if goal.error_m <= BOTH_TOLERANCE_M]
    if options:
        before_m = hands_m(body)
        clear = [(up, goal) for up, goal in options if body.probe.own_depth_m(obj, goal.arms, goal.waist) <= OFF_BODY_M]
        options = clear or options
        up, hold = min(options, key=lambda option: option[1].tilt_rad - _HEIGHT_WEIGHT * option[0])
        yield from body.arms.move_both([hold], speed=0.5)
        yield from wait(0.1)
        higher = against_sag(body, before_m + up - hands_m(body))
        if higher is not None:
            yield from body.arms.move_both([higher], speed=0.5)
    yield from wait(0.1)
    if body.hands.lifted != obj.object_id or obj.object_id in body.world.containment.all_parents():
        for arm in Arm:
            if obj.object_id == body.hands.held[arm] or arm.value in obj.held_by:
                body.world.grasps.detach(arm.value)
        yield from body.arms.move_both([reach.before])
        yield from body.arms.stow_both()
        raise SkillFailure(FailureCode.DROPPED)


def hands_m(body: Body) -> float:
    """Mean height of both hands as they are, metres."""
    return float(np.mean([body.arms.hand_pose(arm)[0][2] for arm in Arm]))


def against_sag(body: Body, sag_m: float) -> BothGoal | None:
    """Posture that compensates the sag of the servos under a load, None where the sag is small or the posture out of reach."""
    if sag_m <= _SAG_M:
        return None
    higher = _shifted(body, 2.0 * min(sag_m, _MOST_SAG_M), 0.0)
    return higher if higher.error_m <= BOTH_TOLERANCE_M else None


def _press(body: Body, reach: BothReach, obj: ObjectInstance) -> Skill:
    """Moves both hands inwards; each one stops when it touches."""
    geoms = body.objects.solid_geoms(obj)
    start = body.arms.commanded_both()
    steps = round(0.5 / CONTROL_DT_S)
    share = dict.fromkeys(Arm, 0.0)
    for k in range(1, round(1.3 * steps) + 1):
        for arm in Arm:
            if k % 2 == 0 and body.probe.hand_gap_m(arm, geoms) < 0.001:
                continue
            share[arm] = min(k / steps, 1.3)
            body.arms.command(arm, start[arm] + share[arm] * (reach.at.arms[arm] - start[arm]))
        yield


def _shifted(body: Body, up_m: float, back_m: float) -> BothGoal:
    """Both hands moved by the same displacement, their orientation kept."""
    move = up_m * _UP - back_m * body.posture.turn_to_world(np.array([1.0, 0.0, 0.0]))
    hand_targets = {}
    for arm in Arm:
        position, hand = body.arms.hand_pose(arm)
        hand_targets[arm] = HandPose(position + move, hand[:, 0], hand[:, 1])
    return body.ik.solve_both(hand_targets, body.arms.commanded_both())
