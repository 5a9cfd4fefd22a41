"""Open, Close, ToggleOn, ToggleOff: hands on handles and switches.

The hand goes to the handle until it touches it, then leads it along the door's arc or the drawer's slide; a ball joint at the
grasp stands for the fingers around the bar. Where the arm cannot follow all the way, the robot steps back with it. A door or
drawer is shut by pushing its outside (`sim.skills.push_door`), by its handle only where that does not work. What counts is the
joint's position afterwards. A switch flips when a finger touches it.

Paper: Open and Toggle of the DualTHOR action space; Close is ours.

Constants were chosen by hand; with them the certificates of the 359 benchmark tasks were made on both robots, and
`benchmarks/doors.py` shows what they give on every door, drawer and lid of the ten rooms.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from interface.bodies import Arm
from interface.failures import FailureCode
from interface.steps import Action
from sim.scene.objects import MovingPart, ObjectInstance
from sim.skills.body.body import Body
from sim.skills.failures import SkillFailure, require
from sim.skills.lids import closed_on, led_on, plan_lead, plan_tab
from sim.skills.locomotion import sweep
from sim.skills.manipulate import GRASP_GAP_M, OutcomeDraw, stow
from sim.skills.navigation import Stance
from sim.skills.plan_cache import cached_plan
from sim.skills.push_door import Push, plan_push, push_shut
from sim.skills.reach import Reach, diagnosed, fulfils, plan_reach, route
from sim.skills.reach_map import HandPose
from sim.skills.runner import Skill, wait

Array = NDArray[np.float64]
_UP: Final = np.array([0.0, 0.0, 1.0])
#: The fingertips reach this far past the bar of a handle.
_PAST_BAR_M: Final = 0.025
#: Peak speed of a handle on its way, and of a lid: a hand that lags behind would tip a light box by its lid.
_HANDLE_SPEED_M_S: Final = 0.45
_LID_SPEED_M_S: Final = 0.3
#: Share of the joint's range that Open leads the door to, and least share that counts as done.
_OPEN_TO: Final = 0.95
_OPEN_MIN: Final = 0.35
#: Share below which Open takes the handle a second time.
_OPEN_WELL: Final = 0.6
#: Share below which Close is done.
_CLOSED_MAX: Final = 0.12
#: Postures along the way of a handle.
_WAYPOINTS: Final = 9
#: Waypoints of a lid's way that Close leads it at least before it takes it again, where no pelvis height serves for all of it.
_PART_WAY: Final = 4


@dataclass(frozen=True, slots=True)
class Pull:
    """How the hand leads a handle.

    Attributes:
        reach: the motion to the handle.
        part: the door or drawer.
        positions: (N,) joint positions along the way.
        postures: (N, A) arm joints that go with them.
        back_m: how far the base steps back on the way.
        opening, closed: opening of the hand on arrival, and around the handle.
    """

    reach: Reach
    part: MovingPart
    positions: Array
    postures: Array
    back_m: float
    opening: float
    closed: float


def carried_point(body: Body, part: MovingPart, now: Array, position: float) -> Array:
    """(3,) world position, at another joint position, of a point fixed to a door or drawer that is at `now` at present."""
    model, data = body.world.model, body.world.data
    axis, change = data.xaxis[part.joint_id], position - float(data.qpos[part.qpos_adr])
    if int(model.jnt_type[part.joint_id]) == 2:  # slide
        return now + change * axis
    arm = now - data.xanchor[part.joint_id]
    c, s = np.cos(change), np.sin(change)
    turned = c * arm + s * np.cross(axis, arm) + (1.0 - c) * float(axis @ arm) * axis
    return data.xanchor[part.joint_id] + turned


def _pointings(body: Body, arm: Arm, point: Array) -> Iterator[Array]:
    sight = point - body.posture.shoulder(arm)
    azimuth = float(np.arctan2(sight[1], sight[0]))
    for elevation in (-10.0, -35.0, 15.0, -60.0):
        for offset in (0.0, 30.0, -30.0, 60.0, -60.0):
            a, e = azimuth + np.deg2rad(offset), np.deg2rad(elevation)
            yield np.array([np.cos(a) * np.cos(e), np.sin(a) * np.cos(e), np.sin(e)])


def _grips(body: Body, arm: Arm, obj: ObjectInstance, handle: Array) -> Iterator[HandPose]:
    """Hand poses around a bar: two parallel fingers rather close on it from both sides, five hook it anyhow."""
    grip_m = body.spec.hand.tip_m - _PAST_BAR_M
    if body.spec.hand.pinch_m is None:
        along = _bar_axis(body, obj)
        for pointing in _pointings(body, arm, handle):
            across = np.cross(along, pointing)
            across /= max(float(np.linalg.norm(across)), 1e-9)
            yield HandPose(handle - grip_m * pointing, pointing, across, either_way=True)
    for pointing in _pointings(body, arm, handle):
        yield HandPose(handle - grip_m * pointing, pointing)


def _bar_axis(body: Body, obj: ObjectInstance) -> Array:
    """(3,) direction along the bar of a handle."""
    model, data = body.world.model, body.world.data
    bar = max(map(int, body.objects.part_geoms(obj, "handle")), key=lambda geom: float(np.max(model.geom_aabb[geom, 3:])))
    return data.geom_xmat[bar].reshape(3, 3)[:, int(np.argmax(model.geom_aabb[bar, 3:]))].copy()


def _to_bar(body: Body, arm: Arm, hand_target: HandPose, bar: Sequence[int]) -> Reach | None:
    """Approach of the open hand to a bar, along its fingers."""
    assert hand_target.pointing is not None
    return plan_reach(body, arm, hand_target, -hand_target.pointing, 0.08, bar, pointing=0.7, closing=0.7)


@cached_plan
def assess_open_close(body: Body, action: Action) -> Pull | Push:
    """Plans Open or Close from the present state, without moving.

    Raises:
        SkillFailure: as the skill would before it moves.
    """
    assert action.arm is not None and action.object_id is not None
    arm, obj, opening = action.arm, body.obj(action.object_id), action.name == "Open"
    require(body.world, action)
    part = obj.moving[0]
    handle = body.world.data.site_xpos[part.handle_site].copy()
    low, high = part.range
    goal = low + (_OPEN_TO if opening else -0.04) * (high - low)  # shut means pushed against the stop
    bar = tuple(map(int, body.objects.part_geoms(obj, "handle")))

    def lid(body: Body, enough: int) -> Pull:
        positions = np.linspace(float(body.world.data.qpos[part.qpos_adr]), goal, _WAYPOINTS)
        lead = plan_lead(
            body, arm, lambda q: carried_point(body, part, handle, q), positions, _pointings(body, arm, handle), bar, enough
        )
        if lead is None:
            raise SkillFailure(FailureCode.OBSTRUCTED)
        return Pull(lead.reach, part, positions[: len(lead.postures)], lead.postures, lead.back_m, lead.opening, lead.closed)

    def whole_lid(body: Body) -> Pull:
        shares = (np.linspace(float(body.world.data.qpos[part.qpos_adr]), goal, _WAYPOINTS) - low) / (high - low)
        return lid(body, 1 + int(np.argmax(shares > _OPEN_MIN + 0.05 if opening else shares < 0.02)))

    def search(body: Body) -> Pull | Push:
        if not opening:
            push = plan_push(body, arm, obj, part)
            if push is not None:
                return push
        best: Pull | None = None
        tried = 0
        for hand_target in _grips(body, arm, obj, handle):
            reach = _to_bar(body, arm, hand_target, bar)
            if reach is None:
                continue
            tried += 1
            pull = _plan_pull(body, arm, part, reach, hand_target.position, goal, opening)
            if pull is not None and (best is None or len(pull.positions) > len(best.positions)):
                best = pull
            if tried > 8 or (best is not None and len(best.positions) == _WAYPOINTS):
                break
        if best is None:
            raise SkillFailure(FailureCode.OBSTRUCTED)
        return best

    if not part.spec.is_lid:
        return diagnosed(body, {arm: handle}, search)
    try:
        return diagnosed(body, {arm: handle}, whole_lid)
    except SkillFailure as failure:
        other_height = failure.code in (FailureCode.BODY_TOO_HIGH, FailureCode.BODY_TOO_LOW)
        if opening or obj.movable or other_height or not body.hypothesis.diagnose:
            raise
        try:
            return lid(body, _PART_WAY)  # the lid of a fixture stays where it is left, and is taken again from there
        except SkillFailure:
            raise failure from None


def plan_handle(body: Body, arm: Arm, obj: ObjectInstance) -> Reach:
    """Approach of the open hand to the handle of a door or drawer.

    Raises:
        SkillFailure: TooFar, BodyTooHigh, BodyTooLow or Obstructed.
    """
    handle = body.world.poses.handle(obj.object_id)
    bar = tuple(map(int, body.objects.part_geoms(obj, "handle")))

    def search(body: Body) -> Reach:
        if obj.moving[0].spec.is_lid:
            reach = plan_tab(body, arm, handle, _pointings(body, arm, handle), bar)
            if reach is not None:
                return reach
            raise SkillFailure(FailureCode.OBSTRUCTED)
        for hand_target in _grips(body, arm, obj, handle):
            reach = _to_bar(body, arm, hand_target, bar)
            if reach is not None:
                return reach
        raise SkillFailure(FailureCode.OBSTRUCTED)

    return diagnosed(body, {arm: handle}, search)


def _plan_pull(body: Body, arm: Arm, part: MovingPart, reach: Reach, hand: Array, goal: float, opening: bool) -> Pull | None:
    start = float(body.world.data.qpos[part.qpos_adr])
    positions = np.linspace(start, goal, _WAYPOINTS)
    base = body.posture.stance()
    ahead = np.array([np.cos(base.yaw_rad), np.sin(base.yaw_rad)])
    free_m = body.workspace.navigation().free_travel(base.position, base.position - 0.5 * ahead)
    span = abs(part.range[1] - part.range[0])
    best: Pull | None = None
    for back in (0.0, 0.12, 0.24, 0.36, 0.48):
        if back > free_m:
            break
        postures = [reach.at]
        for share, position in zip(np.linspace(0.0, 1.0, _WAYPOINTS)[1:], positions[1:], strict=True):
            x, y = base.position - back * share * ahead
            target = HandPose(carried_point(body, part, hand, float(position)))
            solved = body.ik.solve(arm, target, start=postures[-1], base=Stance(float(x), float(y), base.yaw_rad))
            if solved.error_m > 0.02 or float(np.max(np.abs(solved.q - postures[-1]))) > 0.9:
                break
            postures.append(solved.q)
        count = len(postures)
        share = back * (count - 1) / (_WAYPOINTS - 1)
        pull = Pull(reach, part, positions[:count], np.stack(postures), share, 1.0, closed_on(body))
        if best is None or count > len(best.positions):
            best = pull
        if count == _WAYPOINTS:
            break
    if best is None or len(best.positions) < 2:
        return None
    reached = (float(best.positions[-1]) - part.range[0]) / span
    done = reached > _OPEN_MIN + 0.05 if opening else reached < 0.02
    return best if done else None


def open_close(body: Body, action: Action, outcome_draw: OutcomeDraw) -> Skill:
    """Open and Close: moves a door or drawer by its handle; a handle that slips is grasped once more.

    Raises:
        SkillFailure: what `assess_open_close` refuses, GraspMissed, HandleSlipped, or a contingency.
    """
    assert action.object_id is not None
    obj, opening = body.obj(action.object_id), action.name == "Open"
    outcome = ""
    for attempt in range(3 if not opening else 2):
        try:
            pull = assess_open_close(body, action)
            if not outcome:
                outcome = outcome_draw(action)
            if isinstance(pull, Push):
                yield from push_shut(body, action, pull, outcome)
            else:
                yield from _pull(body, action, pull, outcome)
        except SkillFailure:
            if attempt == 0:
                raise
            break  # what the first time has done counts
        if obj.held_by or _share(body, pull.part) >= _OPEN_WELL if opening else _share(body, pull.part) <= _CLOSED_MAX:
            return
    if opening and _share(body, obj.moving[0]) >= _OPEN_MIN:
        return
    raise SkillFailure(FailureCode.HANDLE_SLIPPED, {"gap_m": _share(body, obj.moving[0])})


def _share(body: Body, part: MovingPart) -> float:
    """How far a door or drawer is open, 0 to 1."""
    return (float(body.world.data.qpos[part.qpos_adr]) - part.range[0]) / (part.range[1] - part.range[0])


def _pull(body: Body, action: Action, pull: Pull, outcome: str) -> Skill:
    """Grasps the handle, moves the door, releases and retracts; a self-closing door stays in the hand.

    Raises:
        SkillFailure: GraspMissed, or a contingency.
    """
    arm = action.arm
    assert arm is not None and action.object_id is not None
    obj, part = body.obj(action.object_id), pull.part
    name = (obj.object_id,)
    yield from body.hands.move(arm, pull.opening, 0.2)
    yield from body.arms.move(arm, [*pull.reach.way, pull.reach.before])
    yield from body.arms.move(arm, [pull.reach.at], speed=0.8)
    yield from body.hands.move(arm, pull.closed, 0.3)
    touched = body.objects.part_geoms(obj, "handle")
    if action.name == "Close":  # a door or drawer can also be pushed shut at its front
        touched = np.flatnonzero(body.world.model.geom_bodyid == part.body_id)
    gap = body.probe.hand_gap_m(arm, touched)
    if gap > GRASP_GAP_M:
        yield from _leave(body, arm, pull.reach, name)
        raise SkillFailure(FailureCode.GRASP_MISSED, {"gap_m": gap})
    if outcome != "success":
        yield from wait(0.2)
        yield from _leave(body, arm, pull.reach, name)
        code = FailureCode.LOCKED if outcome == "locked" else FailureCode.NOTHING_HAPPENED
        raise SkillFailure(code, contingency=outcome)
    if part.spec.is_lid:  # a lid hangs at its tab, a door at the hand around its bar
        body.world.grasps.give_way(obj.object_id, part)
        yield from wait(0.2)
        tab = body.world.poses.handle(obj.object_id)
        body.world.grasps.attach(arm.value, obj.object_id, part, tab)
        pull = _aligned(body, arm, pull, tab)
    else:
        body.world.grasps.attach(arm.value, obj.object_id, part)
    yield from _lead(body, arm, pull)
    if obj.self_closing and action.name == "Open" and _share(body, part) >= _OPEN_MIN:
        return
    body.world.grasps.detach(arm.value)
    yield from body.hands.move(arm, 1.0, 0.2)
    position, hand = body.arms.hand_pose(arm)
    ways = _off_lid(body, part, body.world.poses.handle(obj.object_id)) if part.spec.is_lid else (-0.08 * hand[:, 0],)
    for way in ways:
        away = body.ik.solve(arm, HandPose(position + way, hand[:, 0]), start=body.arms.commanded(arm))
        if away.error_m < 0.03:
            yield from body.arms.move(arm, [away.q])
            break
    if part.spec.is_lid:  # home over the lid: an arm that sags on its way would push a light object
        raised = body.ik.vias(arm)[-1]
        yield from wait(0.1)  # clear of the lid, the hand can touch it again
        way = route(body, arm, body.arms.commanded(arm), raised)
        if way is not None or body.probe.free(arm, [raised]):
            yield from body.arms.move(arm, [*(way or ()), raised], speed=0.7)
    yield from stow(body, arm)


def _off_lid(body: Body, part: MovingPart, tab: Array) -> tuple[Array, ...]:
    """(3,) ways by which a hand leaves a lid, the longest first: up, and outwards over its edge when it is open."""
    anchor, axis = body.world.data.xanchor[part.joint_id], body.world.data.xaxis[part.joint_id]
    out = tab - anchor - float(axis @ (tab - anchor)) * axis
    out /= float(np.linalg.norm(out))
    way = max(float(out[2]), 0.0) * out + 1.2 * _UP  # a thumb behind the rim of a closed box would draw it along: straight up
    return tuple(length * way / float(np.linalg.norm(way)) for length in (0.18, 0.12, 0.07))


def _aligned(body: Body, arm: Arm, pull: Pull, tab: Array) -> Pull:
    """The way of a tab from where it is now between the fingers; the planned one where the arm gets less far from there."""
    postures = led_on(body, arm, lambda q: carried_point(body, pull.part, tab, q), pull.positions, pull.back_m)
    return replace(pull, postures=postures) if len(postures) == len(pull.positions) else pull


def _lead(body: Body, arm: Arm, pull: Pull) -> Skill:
    """Moves hand and, where planned, base along the planned way."""
    base = body.posture.stance()
    ahead = np.array([np.cos(base.yaw_rad), np.sin(base.yaw_rad)])
    length = pull.part.travel_m(float(pull.positions[-1] - pull.positions[0]))
    duration = 1.875 * max(length, 0.1) / (_LID_SPEED_M_S if pull.part.spec.is_lid else _HANDLE_SPEED_M_S)
    back = np.linspace(0.0, pull.back_m, len(pull.positions))[:, None] * ahead
    stances = np.column_stack([base.position - back, np.full(len(back), base.yaw_rad)])
    yield from sweep(body, arm, pull.postures, stances, duration)
    yield from wait(0.1)


def _leave(body: Body, arm: Arm, reach: Reach, ignore: tuple[str, ...]) -> Skill:
    yield from body.hands.move(arm, 1.0, 0.2)
    yield from body.arms.move(arm, [reach.before])
    yield from stow(body, arm, ignore)


@cached_plan
def assess_toggle(body: Body, action: Action) -> Reach:
    """Plans ToggleOn or ToggleOff from the present state, without moving.

    Raises:
        SkillFailure: as the skill would before it moves.
    """
    assert action.arm is not None and action.object_id is not None
    arm, obj = action.arm, body.obj(action.object_id)
    require(body.world, action)
    return plan_press(body, arm, body.world.poses.toggle_point(obj.object_id), (obj.object_id,))


def plan_press(body: Body, arm: Arm, point: Array, ignore: tuple[str, ...]) -> Reach:
    """Approach of a fingertip of the empty hand to a point (3,) in the world.

    Raises:
        SkillFailure: TooFar, BodyTooHigh, BodyTooLow or Obstructed.
    """
    ahead, aside, opening = body.spec.hand.press

    def search(body: Body) -> Reach:
        for pointing in _pointings(body, arm, point):
            first = body.ik.solve(arm, HandPose(point - ahead * pointing, pointing))
            if not fulfils(first, pointing=0.8):
                continue
            # the fingertip, as the hand will really be turned, belongs on the switch
            site = point - ahead * first.pointing - aside * first.closing
            hand_target = HandPose(site, first.pointing, first.closing)
            reach = plan_reach(body, arm, hand_target, -first.pointing, 0.07, ignore, 0.95, 0.9, opening=opening, start=first.q)
            if reach is not None:
                return reach
        raise SkillFailure(FailureCode.OBSTRUCTED)

    return diagnosed(body, {arm: point}, search)


def toggle(body: Body, action: Action, outcome_draw: OutcomeDraw) -> Skill:
    """ToggleOn and ToggleOff: presses a switch or knob with the fingers.

    Raises:
        SkillFailure: what `assess_toggle` refuses, GraspMissed when no finger comes to the switch, or a contingency.
    """
    reach = assess_toggle(body, action)
    arm = action.arm
    assert arm is not None and action.object_id is not None
    obj = body.obj(action.object_id)
    yield from body.hands.move(arm, body.spec.hand.press[2], 0.2)
    yield from body.arms.move(arm, [*reach.way, reach.before])
    yield from body.arms.touch(arm, reach.at, body.objects.part_geoms(obj, "toggle"), speed=0.7)
    yield from wait(0.1)
    gap = body.probe.hand_gap_m(arm, body.objects.part_geoms(obj, "toggle"))
    outcome = outcome_draw(action)
    if gap <= GRASP_GAP_M and outcome == "success":
        body.world.states.set_state(obj.object_id, "isToggled", action.name == "ToggleOn")
    yield from body.arms.move(arm, [reach.before])
    yield from body.hands.move(arm, 1.0, 0.2)
    yield from stow(body, arm)
    if gap > GRASP_GAP_M:
        raise SkillFailure(FailureCode.GRASP_MISSED, {"gap_m": gap})
    if outcome != "success":
        raise SkillFailure(FailureCode.NOTHING_HAPPENED, contingency=outcome)
