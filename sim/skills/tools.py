"""Tool skills: Slice, Clean, and UseUp, where the hand is the tool.

The tool is brought down on the object by the same checked motion that puts things down, must touch it (within 15 mm), and is
drawn to and fro; only then the state changes. Every failure brings the arm back first. Paper: slicing, cleaning and using up
are states of DualTHOR without an action.

Constants were chosen by hand; with them the certificates of the 359 benchmark tasks were made on both robots.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import numpy as np
from numpy.typing import NDArray

from interface.bodies import Arm
from interface.failures import FailureCode
from interface.steps import Action
from sim.scene.objects import ObjectInstance
from sim.skills.articulate import plan_press
from sim.skills.body.body import Body
from sim.skills.failures import SkillFailure, require
from sim.skills.manipulate import GRASP_GAP_M, OutcomeDraw, plan_bring, shift_hand, stow
from sim.skills.plan_cache import cached_plan
from sim.skills.reach import Reach
from sim.skills.runner import Skill, wait

Array = NDArray[np.float64]

#: Length and number of the strokes to and fro.
_STROKE_M: Final = 0.04
_STROKES: Final = 2
#: How far a tool that does not touch yet is brought down, and how often.
_PRESS_M: Final = 0.012
_PRESS_STEPS: Final = 3


def _top(body: Body, obj: ObjectInstance) -> Array:
    """(3,) world point in the middle of an object's upper side."""
    low, high = body.world.poses.bounds(obj.object_id)
    return np.array([(low[0] + high[0]) / 2.0, (low[1] + high[1]) / 2.0, high[2]])


def _blade(tool: ObjectInstance) -> Array:
    """(3,) point of a tool that works, in its own frame: the middle of its first part."""
    return np.asarray(tool.type.parts[0].center)


@cached_plan
def assess_slice(body: Body, action: Action) -> Reach:
    """Plans Slice from the present state, without moving.

    Raises:
        SkillFailure: as the skill would before it moves.
    """
    assert action.arm is not None and action.object_id is not None
    require(body.world, action)
    obj, tool = body.obj(action.object_id), body.obj(body.hands.held[action.arm] or "")
    names = (tool.object_id, obj.object_id, *body.world.containment.parents(obj.object_id)[:1])
    return plan_bring(body, action.arm, tool, [_top(body, obj)], names, point=_blade(tool), above_m=0.002)[1]


@cached_plan
def assess_clean(body: Body, action: Action) -> Reach:
    """Plans Clean from the present state, without moving.

    Raises:
        SkillFailure: as the skill would before it moves.
    """
    assert action.arm is not None and action.object_id is not None
    require(body.world, action)
    obj, tool = body.obj(action.object_id), body.obj(body.hands.held[action.arm] or "")
    spots = [np.asarray(puddle.position) for puddle in body.world.liquids.puddles if puddle.surface == obj.object_id]
    if not spots:
        spots = [_top(body, obj)] if obj.movable else body.workspace.free_spots(tool, obj, action.arm)
    if not spots:
        raise SkillFailure(FailureCode.OBSTRUCTED)
    return plan_bring(body, action.arm, tool, spots, (tool.object_id, obj.object_id), above_m=0.002)[1]


@cached_plan
def assess_use_up(body: Body, action: Action) -> Reach:
    """Plans UseUp from the present state, without moving.

    Raises:
        SkillFailure: as the skill would before it moves.
    """
    assert action.arm is not None and action.object_id is not None
    require(body.world, action)
    obj = body.obj(action.object_id)
    return plan_press(body, action.arm, _top(body, obj) - (0.0, 0.0, 0.01), (obj.object_id,))


def slice_object(body: Body, action: Action, outcome_draw: OutcomeDraw) -> Skill:
    """Slice: draws the knife in the hand through an object.

    Raises:
        SkillFailure: what `assess_slice` refuses, ToolMissed, or a contingency.
    """
    reach = assess_slice(body, action)

    def effect(item: ObjectInstance) -> None:
        body.world.states.set_state(item.object_id, "isSliced", True)

    yield from _apply(body, action, reach, outcome_draw, effect)


def clean(body: Body, action: Action, outcome_draw: OutcomeDraw) -> Skill:
    """Clean: wipes an object, or what is spilled on it, with the sponge or towel in the hand.

    Raises:
        SkillFailure: what `assess_clean` refuses, ToolMissed, or a contingency.
    """
    reach = assess_clean(body, action)

    def effect(obj: ObjectInstance) -> None:
        body.world.liquids.wipe(obj.object_id)
        if obj.state.isDirty:
            body.world.states.set_state(obj.object_id, "isDirty", False)

    yield from _apply(body, action, reach, outcome_draw, effect)


def use_up(body: Body, action: Action, outcome_draw: OutcomeDraw) -> Skill:
    """UseUp: takes what is left of a roll, a box of tissues or a bottle of soap with the empty hand.

    Raises:
        SkillFailure: what `assess_use_up` refuses, ToolMissed, or a contingency.
    """
    reach = assess_use_up(body, action)
    assert action.arm is not None and action.object_id is not None
    arm, obj = action.arm, body.obj(action.object_id)
    yield from body.hands.move(arm, body.spec.hand.press[2], 0.2)
    yield from body.arms.move(arm, [*reach.way, reach.before])
    yield from body.arms.touch(arm, reach.at, body.objects.solid_geoms(obj), speed=0.7)
    yield from wait(0.1)
    gap = body.probe.hand_gap_m(arm, body.objects.solid_geoms(obj))
    outcome = outcome_draw(action)
    if gap <= GRASP_GAP_M and outcome == "success":
        body.world.states.set_state(obj.object_id, "isUsedUp", True)
    yield from body.arms.move(arm, [reach.before])
    yield from body.hands.move(arm, 1.0, 0.2)
    yield from stow(body, arm, (obj.object_id,))
    _judge(gap, outcome)


def _judge(gap_m: float, outcome: str) -> None:
    if gap_m > GRASP_GAP_M:
        raise SkillFailure(FailureCode.TOOL_MISSED, {"gap_m": gap_m})
    if outcome != "success":
        raise SkillFailure(FailureCode.NOTHING_HAPPENED, contingency=outcome)


def _apply(
    body: Body, action: Action, reach: Reach, outcome_draw: OutcomeDraw, effect: Callable[[ObjectInstance], None]
) -> Skill:
    """Brings the tool in the hand onto the object, presses until it touches, draws it to and fro, and has its effect.

    Raises:
        SkillFailure: ToolMissed or a contingency, with the arm at home again.
    """
    arm = action.arm
    assert arm is not None and action.object_id is not None
    obj, tool = body.obj(action.object_id), body.obj(body.hands.held[arm] or "")
    yield from body.arms.move(arm, [*reach.way, reach.before])
    yield from body.arms.move(arm, [reach.at], speed=0.6)
    mine, theirs = body.objects.solid_geoms(tool), body.objects.solid_geoms(obj)
    yield from wait(0.06)
    gap = body.probe.gap_m(mine, theirs)
    for _ in range(_PRESS_STEPS):
        if gap <= 0.5 * GRASP_GAP_M:
            break
        yield from shift_hand(body, arm, np.array([0.0, 0.0, -_PRESS_M]))
        gap = body.probe.gap_m(mine, theirs)
    outcome = outcome_draw(action)
    if gap <= GRASP_GAP_M and outcome == "success":
        along = body.posture.turn_to_world(np.array([1.0, 0.0, 0.0]))
        for _ in range(_STROKES):
            yield from shift_hand(body, arm, _STROKE_M * along)
            yield from shift_hand(body, arm, -_STROKE_M * along)
        effect(obj)
        yield from _leave(body, arm, reach, tool)
        return
    yield from _leave(body, arm, reach, tool)
    _judge(gap, outcome)


def _leave(body: Body, arm: Arm, reach: Reach, tool: ObjectInstance) -> Skill:
    yield from body.arms.move(arm, [reach.before])
    yield from stow(body, arm, (tool.object_id,))
