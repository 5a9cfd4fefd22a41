"""One-arm skills on movable objects: Pick, Place, ResetArm.

A grasp holds only when both opposing finger groups touch the object, or are within 15 mm of it, after the hand has closed
around it in physics; only then is the object tied to the hand. Place lowers the object until it touches, opens, and looks
whether it has come to rest where it should. Every failure brings the arm back to a safe posture first.

Paper: Pick and Place of the DualTHOR action space, there without contact.

Constants were chosen by hand; with them the certificates of the 359 benchmark tasks were made on both robots.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from interface.bodies import Arm
from interface.failures import FailureCode
from interface.steps import Action
from sim.scene.objects import ObjectInstance
from sim.skills.body.body import Body
from sim.skills.body.ready import carrying_posture, ready_posture
from sim.skills.failures import SkillFailure, require
from sim.skills.grasps import Grasp, grasp_candidates
from sim.skills.plan_cache import cached_plan
from sim.skills.reach import Reach, diagnose, diagnosed, fulfils, plan_reach, route
from sim.skills.reach_map import HandPose
from sim.skills.runner import CONTROL_DT_S, Skill, TwoTicks, wait

Array = NDArray[np.float64]

#: Draws the contingency of an action on an object.
OutcomeDraw = Callable[[Action], str]

#: Gap between finger and object up to which they count as touching.
GRASP_GAP_M: Final = 0.015
#: Length of the straight way to an object, and by how much it is raised when it has been taken.
_APPROACH_M: Final = 0.09
_LIFT_M: Final = 0.06
#: Length of the straight way down onto a surface, and how far above the rim of a box or drawer it starts.
_APPROACH_PLACE_M: Final = 0.08
_OVER_RIM_M: Final = 0.02
#: Grasps that are planned at most.
_MAX_PLANS: Final = 60
#: Share of the usual speed at which liquids are carried.
_CARE: Final = 0.6
#: A vessel with a liquid counts as upright below this tilt.
_LEVEL_RAD: Final = float(np.radians(25.0))
#: How deep what is carried may be in the robot's own body.
OFF_BODY_M: Final = 0.003
_UP: Final = np.array([0.0, 0.0, 1.0])
#: An arm that is farther than this from where it was sent met something on the way.
_STUCK_RAD: Final = 0.15
#: How far an open hand draws back from what it has put down, how steeply, tried in turn, and how deep it may touch it then.
_OFF_M: Final = 0.09
_STEEP: Final = (0.0, 0.5, 1.5, 3.0)
_GRAZE_M: Final = 0.0005
#: Turns of what is put down about the vertical, rad, tried in turn.
_TURNS: Final = (0.0, 0.35, -0.35, 0.75, -0.75, 1.2, -1.2)


def plan_pick(body: Body, arm: Arm, obj: ObjectInstance) -> tuple[Grasp, Reach]:
    """The grasp and the motion to it.

    Raises:
        SkillFailure: TooFar, BodyTooHigh, BodyTooLow or Obstructed.
    """
    found = _find_grasp(body, arm, obj, _MAX_PLANS)
    if found is not None:
        return found

    def elsewhere(body: Body) -> None:
        if _find_grasp(body, arm, obj, _MAX_PLANS // 3) is None:
            raise SkillFailure(FailureCode.OBSTRUCTED)

    raise diagnose(body, {arm: body.world.poses.grips(obj.object_id)[0]}, elsewhere)


def _find_grasp(
    body: Body, arm: Arm, obj: ObjectInstance, limit: int, avoid: Grasp | None = None
) -> tuple[Grasp, Reach] | None:
    """The first grasp that the arm can do and that differs from `avoid`, of at most `limit` that are within its envelope."""
    tried = 0
    for grasp in grasp_candidates(body, arm, obj):
        hand_target = grasp.hand()
        if avoid is not None and avoid.family == grasp.family and float(avoid.pointing @ grasp.pointing) > 0.95:
            continue
        if not body.ik.within(arm, hand_target.position, body.posture.pelvis_height_m):
            continue
        tried += 1
        if tried > limit:
            return None
        first = body.ik.solve(arm, hand_target)
        if not fulfils(first):
            continue
        # the arm points where it can: seat the object in the hand as it will really be turned
        seated = grasp.hand(first.pointing, first.closing)
        way = grasp.retreat(first.pointing)
        reach = plan_reach(
            body, arm, seated, way, _APPROACH_M, pointing=0.97, closing=0.97, opening=grasp.opening, start=first.q
        )
        if reach is not None:
            return grasp, reach
    return None


def stow(body: Body, arm: Arm, ignore: tuple[str | int, ...] = ()) -> Skill:
    """Moves the arm to its ready posture, or to the carrying posture when loaded, around obstacles."""
    held = body.hands.held[arm]
    goal = ready_posture(body.kit, arm) if held is None or not body.obj(held).movable else _carry(body, arm, held)
    if held is not None and body.obj(held).state.fillLitres > 0.0:
        yield from body.arms.move(arm, [*_level_way(body, arm, held, goal), goal], speed=_CARE)
        return
    way = _way_back(body, arm, goal, ignore)
    yield from body.arms.move(arm, [*(tuple(body.ik.vias(arm))[:1] if way is None else way), goal])


#: Small ways of a hand that make room where it can turn nowhere: metres back along the fingers, and up.
_ASIDE: Final = ((0.12, 0.0), (0.0, 0.12), (0.1, 0.1), (0.2, 0.0), (0.0, 0.2), (0.2, 0.1))


def _way_back(body: Body, arm: Arm, goal: Array, ignore: tuple[str | int, ...]) -> tuple[Array, ...] | None:
    """Postures on a way to a goal that touches nothing, the first with the hand drawn aside where there is none from here."""
    start = body.arms.commanded(arm)
    way = route(body, arm, start, goal, ignore)
    if way is not None:
        return way
    position, hand = body.arms.hand_pose(arm)
    for back_m, up_m in _ASIDE:
        target = HandPose(position - back_m * hand[:, 0] + up_m * _UP, hand[:, 0], hand[:, 1])
        aside = body.ik.solve(arm, target, start=start)
        if aside.error_m > 0.03 or float(np.max(np.abs(aside.q - start))) > 1.5:
            continue
        if route(body, arm, start, aside.q, ignore) == () and (way := route(body, arm, aside.q, goal, ignore)) is not None:
            return (aside.q, *way)
    return None


def _carry(body: Body, arm: Arm, held: str) -> Array:
    """(A,) carrying posture with the hand turned so that the object stands as upright as the arm can hold it.

    What holds a liquid is carried where the arm holds it upright, which may be farther ahead.
    """
    usual = carrying_posture(body.kit, arm)
    object_in_world, hand_in_world = body.world.poses.pose(held)[:3, :3], body.arms.hand_pose(arm)[1]
    upright_hand = upright(object_in_world) @ hand_in_world  # in the world
    ahead_in_world = body.posture.turn_to_world(np.array([1.0, 0.0, 0.0]))
    if np.hypot(*upright_hand[:2, 0]) > 0.15:
        azimuth_rad = float(np.arctan2(*ahead_in_world[1::-1]) - np.arctan2(*upright_hand[1::-1, 0]))
        upright_hand = _turn_z(azimuth_rad) @ upright_hand
    carried = HandPose(body.ik.hand_at(arm, usual), upright_hand[:, 0], upright_hand[:, 1])
    solved = body.ik.solve(arm, carried, start=usual, roll_weight=0.2)
    otherwise = solved.q if solved.error_m < 0.05 else usual
    if body.obj(held).state.fillLitres <= 0.0 and body.probe.own_depth_m(body.obj(held), {arm: otherwise}) <= OFF_BODY_M:
        return otherwise
    return _level(body, arm, body.obj(held), hand_in_world.T @ object_in_world[:, 2], carried, otherwise)


def _level_way(body: Body, arm: Arm, held: str, goal: Array) -> list[Array]:
    """(A,) postures on the hand's straight way to carrying on which a vessel stays upright, as far as they exist."""
    (start_m, hand_in_world), end_m = body.arms.hand_pose(arm), body.ik.hand_at(arm, goal)
    upright_hand = upright(body.world.poses.pose(held)[:3, :3]) @ hand_in_world
    way: list[Array] = []
    last = body.arms.commanded(arm)
    for share in (0.25, 0.5, 0.75):
        target = HandPose(start_m + share * (end_m - start_m), upright_hand[:, 0], upright_hand[:, 1])
        solved = body.ik.solve(arm, target, start=last, roll_weight=0.2)
        if solved.error_m < 0.05 and body.probe.free(arm, [solved.q]):
            last = solved.q
            way.append(last)
    return way


#: A small way of the hand that takes more of a joint than this would turn what the hand holds.
_NUDGE_RAD: Final = 0.6


def shift_hand(body: Body, arm: Arm, change: Array) -> Skill:
    """Shifts the hand by a small displacement in the world frame, if the arm can."""
    position, hand = body.arms.hand_pose(arm)
    goal = body.ik.solve(arm, HandPose(position + change, hand[:, 0], hand[:, 1]), start=body.arms.commanded(arm))
    if goal.error_m < 0.03 and float(np.max(np.abs(goal.q - body.arms.commanded(arm)))) < _NUDGE_RAD:
        yield from body.arms.move(arm, [goal.q], speed=0.6)


def _level(body: Body, arm: Arm, obj: ObjectInstance, up_in_hand: Array, near: HandPose, otherwise: Array) -> Array:
    """(A,) posture near a hand pose in which an object whose axis is `up_in_hand` stands upright, or most nearly so.

    The object is off the robot's own body there.
    """
    best: tuple[float, Array] | None = None
    ahead, left = body.posture.turn_to_world(np.array([1.0, 0.0, 0.0])), body.posture.turn_to_world(np.array([0.0, 1.0, 0.0]))
    outward = left if arm is Arm.LEFT else -left
    for ahead_m, up_m, aside_m in itertools.product((0.0, 0.08, 0.16), (0.0, -0.1, 0.1, -0.2), (0.0, 0.08)):
        point = near.position + ahead_m * ahead + aside_m * outward + up_m * _UP
        goal = body.ik.solve(arm, HandPose(point, near.pointing, near.closing), roll_weight=0.2)
        hand_in_world = np.stack([goal.pointing, goal.closing, np.cross(goal.pointing, goal.closing)], axis=1)
        tilt_rad = float(np.arccos(np.clip((hand_in_world @ up_in_hand)[2], -1.0, 1.0)))
        if goal.error_m > 0.05 or not body.probe.free(arm, [goal.q]):
            continue
        if body.probe.own_depth_m(obj, {arm: goal.q}) > OFF_BODY_M:
            continue
        if best is None or tilt_rad < best[0] - 0.02:
            best = (tilt_rad, goal.q)
        if tilt_rad < _LEVEL_RAD:
            return goal.q
    return otherwise if best is None else best[1]


def _close(body: Body, arm: Arm, geoms: NDArray[np.int64]) -> Skill:
    """Closes the hand until both finger groups touch, or it is closed."""
    steps = 28
    start = body.hands.opening(arm)
    for k in range(1, steps + 1):
        body.hands.command(arm, start * (1.0 - k / steps))
        yield
        if k % 2 == 0 and max(body.probe.finger_gaps_m(arm, geoms)) <= 0.002:
            return
    yield from wait(0.1)


def retreat(body: Body, arm: Arm, reach: Reach, ignore: tuple[str | int, ...]) -> Skill:
    """Opens the hand, backs off along the approach and stows the arm."""
    yield from body.hands.move(arm, 1.0)
    yield from body.arms.move(arm, [reach.before])
    yield from stow(body, arm, ignore)


def pick(body: Body, action: Action, outcome_draw: OutcomeDraw) -> Skill:
    """Pick: takes an object with one hand and carries it before the body.

    Raises:
        SkillFailure: what `assess_pick` refuses, GraspMissed, Dropped, or a contingency.
    """
    grasp, reach = assess_pick(body, action)
    arm = action.arm
    assert arm is not None and action.object_id is not None
    obj = body.obj(action.object_id)
    name = (obj.object_id,)
    geoms = body.objects.solid_geoms(obj)
    yield from grip(body, arm, grasp, reach, geoms)
    gaps = body.probe.finger_gaps_m(arm, geoms)
    if max(gaps) > GRASP_GAP_M:  # look again and try another way once
        yield from body.hands.move(arm, 1.0, 0.2)
        yield from body.arms.move(arm, [reach.before])
        again = _find_grasp(body, arm, obj, _MAX_PLANS, avoid=grasp)
        if again is not None:
            grasp, reach = again
            yield from grip(body, arm, grasp, reach, geoms)
            gaps = body.probe.finger_gaps_m(arm, geoms)
    if max(gaps) > GRASP_GAP_M:
        yield from retreat(body, arm, reach, name)
        raise SkillFailure(FailureCode.GRASP_MISSED, {"gap_m": max(gaps)})
    if obj.held_by:
        yield from retreat(body, arm, reach, name)
        raise SkillFailure(FailureCode.ALREADY_HELD)
    outcome = outcome_draw(action)
    body.world.grasps.attach(arm.value, obj.object_id)
    yield from _lift(body, arm)
    if outcome != "success":
        yield from _contingency(body, arm, obj, outcome)
    yield from stow(body, arm, name)
    if body.hands.held[arm] != obj.object_id:
        raise SkillFailure(FailureCode.DROPPED)


def grip(body: Body, arm: Arm, grasp: Grasp, reach: Reach, geoms: NDArray[np.int64]) -> Skill:
    """Moves the open hand to the object and closes it."""
    yield from body.hands.move(arm, grasp.opening, 0.2)
    yield from body.arms.move(arm, [*reach.way, reach.before])
    yield from body.arms.move(arm, [reach.at], speed=0.8)
    yield from wait(0.06)
    if grasp.opening > 0.9:
        yield from _close(body, arm, geoms)


def _lift(body: Body, arm: Arm) -> Skill:
    """Raises the held object straight up."""
    position, hand = body.arms.hand_pose(arm)
    current = body.arms.commanded(arm)
    up = body.ik.solve(arm, HandPose(position + _LIFT_M * _UP, hand[:, 0], hand[:, 1]), start=current)
    if up.error_m < 0.03:
        yield from body.arms.move(arm, [up.q])


def _contingency(body: Body, arm: Arm, obj: ObjectInstance, outcome: str) -> Skill:
    """Executes a contingency of Pick: the object leaves the hand, and may break or spill."""
    codes = {"slipped": FailureCode.SLIPPED, "spilled": FailureCode.SPILLED, "broken": FailureCode.BROKE}
    code = codes.get(outcome, FailureCode.NOTHING_HAPPENED)
    body.world.grasps.detach(arm.value)
    if outcome in ("spilled", "broken"):
        body.world.liquids.spill(obj)
    if outcome == "broken" and obj.type.has("breakable"):
        body.world.states.set_state(obj.object_id, "isBroken", True)
    yield from body.hands.move(arm, 1.0)
    yield from wait(0.3)
    yield from stow(body, arm, (obj.object_id,))
    raise SkillFailure(code, contingency=outcome)


def plan_place(body: Body, arm: Arm, obj: ObjectInstance, receptacle: ObjectInstance) -> tuple[Array, Reach, Array]:
    """Target spot of the held object and the arm motion to it.

    Returns:
        The spot (3,) on the surface, the motion, and the direction in which the hand leaves.

    Raises:
        SkillFailure: ReceptacleFull, TooFar, BodyTooHigh, BodyTooLow or Obstructed.
    """
    spots = body.workspace.free_spots(obj, receptacle, arm)
    if not spots:
        raise SkillFailure(FailureCode.RECEPTACLE_FULL)
    over_m = max(_APPROACH_PLACE_M, _rim_m(body, receptacle) - float(spots[0][2]) + _OVER_RIM_M)
    return plan_bring(body, arm, obj, spots, (obj.object_id, receptacle.object_id), from_m=over_m, clear=(obj.object_id,))


def _rim_m(body: Body, receptacle: ObjectInstance) -> float:
    """World height of the rim of a drawer, box or vessel that is filled from above; minus infinity for other receptacles."""
    data, model = body.world.data, body.world.model
    parts = body.world.scene.part_of_geom[receptacle.object_id]
    hollow = {int(model.geom_bodyid[geom]) for geom, part in parts if part.shape in ("tray", "cup")}
    around = [geom for geom, _ in parts if int(model.geom_bodyid[geom]) in hollow and model.geom_contype[geom] > 0]
    halves = [float(np.abs(data.geom_xmat[geom].reshape(3, 3)[2]) @ model.geom_aabb[geom, 3:]) for geom in around]
    return max((float(data.geom_xpos[geom, 2]) + half for geom, half in zip(around, halves, strict=True)), default=-np.inf)


def plan_bring(
    body: Body,
    arm: Arm,
    obj: ObjectInstance,
    spots: Sequence[Array],
    ignore: Sequence[str],
    point: Array | None = None,
    above_m: float = 0.006,
    coming_from: Array = _UP,
    from_m: float = _APPROACH_PLACE_M,
    clear: Sequence[str] | None = None,
) -> tuple[Array, Reach, Array]:
    """Plan to bring a held object upright to one of several spots.

    Args:
        body: the robot.
        arm: the arm that holds it.
        obj: what it holds.
        spots: (3,) world points, the best first.
        ignore: ids that may be touched at the spot.
        point: (3,) point of the object that belongs above the spot, in its own frame; its frame's origin when None.
        above_m: height of the object's lowest point above the spot.
        coming_from: (3,) unit direction from the spot back to where the last straight way starts.
        from_m: length of that way.
        clear: ids that may be touched by a motion that is preferred, if there is one.

    Returns:
        The spot, the motion, and the direction in which the hand leaves.

    Raises:
        SkillFailure: TooFar, BodyTooHigh, BodyTooLow or Obstructed.
    """
    hand_m, hand_in_world = body.arms.hand_pose(arm)
    object_in_world = body.world.poses.pose(obj.object_id)
    # everything below is in world axes, the object upright again and turned about the vertical only
    righting = upright(object_in_world[:3, :3])
    point_from_origin = np.zeros(3) if point is None else object_in_world[:3, :3] @ point
    point_from_hand = righting @ (object_in_world[:3, 3] + point_from_origin - hand_m)
    upright_hand = righting @ hand_in_world
    lowest_m = _lowest(obj, righting @ object_in_world[:3, :3]) - float((righting @ point_from_origin)[2])
    lift = np.array([0.0, 0.0, above_m - lowest_m])
    shoulder = body.posture.shoulder(arm)
    ways = [(touched, extra) for touched in ((ignore,) if clear is None else (clear, ignore)) for extra in _TURNS]

    def search(body: Body) -> tuple[Array, Reach, Array]:
        for spot in spots:
            # keep the hand's azimuth relative to the line of sight, or turn the object a little
            straight_rad = 0.0
            if np.hypot(*upright_hand[:2, 0]) > 0.15:
                sight = spot[:2] - shoulder[:2]
                straight_rad = float(np.arctan2(*sight[::-1]) - np.arctan2(*upright_hand[1::-1, 0]))
            for touched, extra_rad in ways:
                turn = _turn_z(straight_rad + extra_rad)
                turned = turn @ upright_hand
                target = HandPose(spot + lift - turn @ point_from_hand, turned[:, 0], turned[:, 1])
                reach = plan_reach(body, arm, target, coming_from, from_m, touched, pointing=0.9, closing=0.93)
                if reach is not None:
                    return spot, reach, -turned[:, 0]
        raise SkillFailure(FailureCode.OBSTRUCTED)

    return diagnosed(body, {arm: spots[0] + lift - point_from_hand}, search)


def place(body: Body, action: Action, outcome_draw: OutcomeDraw) -> Skill:
    """Place: puts the held object down on a free spot of a receptacle.

    Raises:
        SkillFailure: what `assess_place` refuses, Obstructed when the arm meets something, PlaceMissed, or a contingency.
    """
    _, reach, away = assess_place(body, action)
    arm = action.arm
    assert arm is not None and action.object_id is not None
    receptacle, obj = body.obj(action.object_id), body.obj(body.hands.held[arm] or "")
    outcome = outcome_draw(action)
    name = (obj.object_id,)
    yield from body.arms.move(arm, [*reach.way, reach.before])
    if body.arms.off_rad(arm, reach.before) > _STUCK_RAD:
        yield from stow(body, arm, name)
        raise SkillFailure(FailureCode.OBSTRUCTED)
    if outcome in ("nothing", "spilled"):
        if outcome == "spilled":
            body.world.liquids.spill(obj)
        yield from stow(body, arm, name)
        raise SkillFailure(FailureCode.SPILLED if outcome == "spilled" else FailureCode.NOTHING_HAPPENED, contingency=outcome)
    rests = TwoTicks()
    for _ in body.arms.move(arm, [reach.at], speed=0.6):
        yield
        if rests(body.contacts.rests(obj)):
            body.arms.hold([arm])
            break
    yield from wait(0.04)
    if outcome == "broken" and obj.type.has("breakable"):
        body.world.states.set_state(obj.object_id, "isBroken", True)
    body.world.grasps.detach(arm.value)
    yield from body.hands.move(arm, 1.0)
    yield from body.arms.move(arm, [_off(body, arm, away, reach)])
    yield from stow(body, arm)
    if outcome == "broken":
        yield from at_rest(body, obj)
        raise SkillFailure(FailureCode.BROKE, contingency=outcome)
    yield from set_down(body, obj, receptacle)


def _off(body: Body, arm: Arm, away: Array, reach: Reach) -> Array:
    """(A,) posture of the open hand off what it has put down: straight back, or steeper where its fingers would drag on it."""
    start = body.arms.commanded(arm)
    position, hand = body.arms.hand_pose(arm)
    best: tuple[float, Array] | None = None
    for steep in _STEEP:
        way = _OFF_M * (away + steep * _UP) / float(np.linalg.norm(away + steep * _UP))
        goal = body.ik.solve(arm, HandPose(position + way, hand[:, 0], hand[:, 1]), start=start)
        if goal.error_m > 0.03:
            continue
        postures = start + np.linspace(0.0, 1.0, 6)[1:, None] * (goal.q - start)
        depth = float(body.probe.depths_m(arm, postures, opening=1.0).max())
        if best is None or depth < best[0] - _GRAZE_M:
            best = (depth, goal.q)
        if depth <= _GRAZE_M:
            break
    return reach.before if best is None else best[1]


#: Speed of what is at rest, for how long it has to keep to it, and how long that is waited for.
_REST_M_S: Final = 0.02
_REST_S: Final = 0.6
_PATIENCE_S: Final = 2.0
#: What is farther than this from an attitude in which it rests by itself leans on something, degrees; than that, on a part of
#: the robot that touches it.
_LEANS_DEG: Final = 10.0
_TOUCHED_DEG: Final = 3.0


def at_rest(body: Body, obj: ObjectInstance) -> Skill:
    """Waits until an object has been at rest for a while, or has not come to rest in time."""
    still = 0
    for _ in range(int(_PATIENCE_S / CONTROL_DT_S)):
        still = still + 1 if body.world.poses.speed_m_s(obj.object_id) < _REST_M_S else 0
        if still >= _REST_S / CONTROL_DT_S:
            break
        yield


def set_down(body: Body, obj: ObjectInstance, receptacle: ObjectInstance) -> Skill:
    """Waits until what was let go of is at rest, and looks whether it is set down.

    It is when the receptacle carries it and it leans on nothing: not on the robot, and elsewhere in containers alone.

    Raises:
        SkillFailure: PlaceMissed.
    """
    yield from at_rest(body, obj)
    world = body.world
    tilt_deg = world.poses.tilt_deg(obj.object_id)
    leans = (tilt_deg > _LEANS_DEG and not receptacle.walled) or (tilt_deg > _TOUCHED_DEG and body.contacts.touches_robot(obj))
    carried = receptacle.object_id in world.containment.parents(obj.object_id)
    moves = world.poses.speed_m_s(obj.object_id) >= _REST_M_S
    if not carried or moves or leans:
        gap = float(np.linalg.norm(world.poses.center(obj.object_id) - world.poses.center(receptacle.object_id)))
        raise SkillFailure(FailureCode.PLACE_MISSED, {"gap_m": gap, "tilt_deg": tilt_deg})


@cached_plan
def assess_pick(body: Body, action: Action) -> tuple[Grasp, Reach]:
    """Plans Pick from the present state, without moving.

    Raises:
        SkillFailure: as Pick would before it moves.
    """
    assert action.arm is not None and action.object_id is not None
    require(body.world, action)
    obj = body.obj(action.object_id)
    return plan_pick(body, action.arm, obj)


@cached_plan
def assess_place(body: Body, action: Action) -> tuple[Array, Reach, Array]:
    """Plans Place from the present state, without moving.

    Raises:
        SkillFailure: as Place would before it moves.
    """
    assert action.arm is not None and action.object_id is not None
    require(body.world, action)
    held = body.obj(body.hands.held[action.arm] or "")
    return plan_place(body, action.arm, held, body.obj(action.object_id))


def reset_arm(body: Body, action: Action, outcome_draw: OutcomeDraw) -> Skill:
    """ResetArm: back to the ready posture, with the hand open unless it holds something.

    Raises:
        SkillFailure: BothHandsBusy, or InUse for a hand that is at a door or drawer.
    """
    del outcome_draw
    assert action.arm is not None
    require(body.world, action)
    if body.hands.held[action.arm] is None:
        yield from body.hands.move(action.arm, 1.0)
    yield from stow(body, action.arm)


def _turn_z(angle_rad: float) -> Array:
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def upright(rotation: Array) -> Array:
    """The smallest rotation that makes the object's z axis vertical again."""
    axis = np.cross(rotation[:, 2], _UP)
    sine, cosine = float(np.linalg.norm(axis)), float(rotation[2, 2])
    if sine < 1e-6:  # upright, or upside down about an axis that does not matter
        return np.eye(3) if cosine > 0.0 else np.diag([1.0, -1.0, -1.0])
    x, y, z = axis / sine
    k = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + sine * k + (1.0 - cosine) * (k @ k)


def _lowest(obj: ObjectInstance, rotation: Array) -> float:
    """Height of the lowest corner of the object's box relative to its frame, for an orientation."""
    corners = np.stack(np.meshgrid(*zip(obj.local_min, obj.local_max, strict=True)), axis=-1).reshape(-1, 3)  # (8, 3)
    return float((corners @ rotation[2]).min())
