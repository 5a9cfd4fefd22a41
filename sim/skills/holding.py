"""Hold and Release: a hand grasps something in place, and releases what it holds.

Hold is Pick without the lift: the object stays where it is and so does the hand, to steady it for the other one; a door or
drawer is held by its handle. While furniture is held the robot does not walk. Release opens the hand wherever it is; what it
held falls, and a door with a spring shuts. Paper: holding and releasing of the dual-arm action space.
"""

from __future__ import annotations

from interface.failures import FailureCode
from interface.steps import Action
from sim.skills.articulate import plan_handle
from sim.skills.body.body import Body
from sim.skills.failures import SkillFailure, require
from sim.skills.grasps import Grasp
from sim.skills.manipulate import GRASP_GAP_M, OutcomeDraw, grip, plan_pick, retreat, stow
from sim.skills.plan_cache import cached_plan
from sim.skills.reach import Reach
from sim.skills.reach_map import HandPose
from sim.skills.runner import CONTROL_DT_S, Skill, wait


@cached_plan
def assess_hold(body: Body, action: Action) -> tuple[Grasp | None, Reach]:
    """Plans Hold from the present state, without moving; no grasp for a handle.

    Raises:
        SkillFailure: as the skill would before it moves.
    """
    assert action.arm is not None and action.object_id is not None
    require(body.world, action)
    obj = body.obj(action.object_id)
    return plan_pick(body, action.arm, obj) if obj.movable else (None, plan_handle(body, action.arm, obj))


def hold(body: Body, action: Action, outcome_draw: OutcomeDraw) -> Skill:
    """Hold: takes hold of an object or a handle and stays there.

    Raises:
        SkillFailure: what `assess_hold` refuses, GraspMissed, AlreadyHeld, or a contingency.
    """
    grasp, reach = assess_hold(body, action)
    arm = action.arm
    assert arm is not None and action.object_id is not None
    obj = body.obj(action.object_id)
    name = (obj.object_id,)
    if grasp is not None:
        yield from grip(body, arm, grasp, reach, body.objects.solid_geoms(obj))
        gap = max(body.probe.finger_gaps_m(arm, body.objects.solid_geoms(obj)))
    else:
        yield from body.hands.move(arm, 1.0, 0.2)
        yield from body.arms.move(arm, [*reach.way, reach.before])
        yield from body.arms.move(arm, [reach.at], speed=0.8)
        yield from body.hands.move(arm, 0.35, 0.3)
        gap = body.probe.hand_gap_m(arm, body.objects.part_geoms(obj, "handle"))
    outcome = outcome_draw(action)
    if gap > GRASP_GAP_M or obj.held_by or outcome != "success":
        taken = bool(obj.held_by)
        yield from retreat(body, arm, reach, name)
        if gap > GRASP_GAP_M:
            raise SkillFailure(FailureCode.GRASP_MISSED, {"gap_m": gap})
        if taken:
            raise SkillFailure(FailureCode.ALREADY_HELD)
        raise SkillFailure(FailureCode.NOTHING_HAPPENED, contingency=outcome)
    body.world.grasps.attach(arm.value, obj.object_id, steady=True)


def release(body: Body, action: Action, outcome_draw: OutcomeDraw) -> Skill:
    """Release: opens the hand and draws the arm back; what it held stays or falls.

    Raises:
        SkillFailure: HandEmpty.
    """
    del outcome_draw
    arm = action.arm
    assert arm is not None
    require(body.world, action)
    obj = body.obj(body.hands.lifted or body.hands.held[arm] or "")
    name = obj.object_id
    body.world.grasps.detach(arm.value)
    yield from body.hands.move(arm, 1.0)
    position, hand = body.arms.hand_pose(arm)
    back = body.ik.solve(arm, HandPose(position - 0.08 * hand[:, 0], hand[:, 0], hand[:, 1]), start=body.arms.commanded(arm))
    if back.error_m < 0.03:
        yield from body.arms.move(arm, [back.q])
    yield from stow(body, arm, (name,))
    yield from wait(0.1)
    for _ in range(int((3.0 if obj.self_closing else 1.0) / CONTROL_DT_S)):
        if body.world.poses.speed_m_s(obj.object_id) < 0.02 and not (obj.self_closing and obj.openness > 0.02):
            break
        yield
