"""Shutting a door or drawer from outside: the fist goes to the outside face and follows its arc, or slides back with it.

Nothing ties the hand to the door: contact alone moves it. An open door's outside face looks away from where a robot stands to
use what is inside, and a drawer's front is close to a robot that uses it, so the plan may begin with a short step to another
stance, and the base may walk along while the hand pushes. Stances are screened with the reach maps, the survivors are solved
and checked for collisions.

Frames: world. The paper has no counterpart: Close is ours.

Constants were chosen by hand; with them the certificates of the 359 benchmark tasks were made on both robots, and
`benchmarks/doors.py` shows what they give on every door, drawer and lid of the ten rooms.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from interface.bodies import Arm
from interface.failures import FailureCode
from interface.steps import Action
from sim.scene.objects import MovingPart, ObjectInstance
from sim.skills.body.body import Body
from sim.skills.body.clearance import TOUCH_M
from sim.skills.body.ik import ArmGoal
from sim.skills.door import Door
from sim.skills.failures import SkillFailure
from sim.skills.locomotion import step_to, sweep
from sim.skills.manipulate import GRASP_GAP_M, stow
from sim.skills.navigation import Stance
from sim.skills.obstacles import navigation_map
from sim.skills.reach import Reach, route
from sim.skills.reach_map import HandPose
from sim.skills.runner import Skill, wait

Array = NDArray[np.float64]

#: How far past shut the hand is led, share of the joint's range: the door is pressed against its stop.
_PAST_SHUT: Final = 0.04
#: Largest way of the door between two waypoints, as `MovingPart.travel_m` gives it.
_STEP_M: Final = 0.08
#: Where the fist may touch: shares of the way from hinge to free edge, and heights relative to the shoulder. Of a drawer, whose
#: ends are both free, the end on the arm's own side comes first.
_SPOTS_SHARE_M: Final = ((0.88, -0.22), (0.72, -0.22), (0.88, -0.4), (0.88, -0.05), (0.58, -0.22), (0.72, -0.4))
#: Half the width of a fist, with some room.
_FIST_HALF_M: Final = 0.075
#: Depth to which the fist is commanded into the door that it moves, and how exactly.
_PRESS_M: Final = 0.006
_PRESS_SLACK_M: Final = 0.006
#: Distance of the grasp site from the face while it pushes, before the hand's real shape is known, and where it starts from.
_FIST_M: Final = 0.05
_BEFORE_M: Final = 0.1
#: Longest way to the stance from which the door is pushed, and longest way along with the door.
_WALK_M: Final = 1.3
_ALONG_M: Final = 0.7
_ALONG_RAD: Final = 1.2
#: Half size and spacing of the grid of stances around the hinge.
_GRID_M: Final = 1.3
_SPACING_M: Final = 0.1
#: Bearings of the point of contact from the robot's heading.
_BEARINGS_RAD: Final = (0.0, 0.45, -0.45, 0.9, -0.9)
#: Comfortable distances between shoulder and hand, as shares of the reach.
_NEAR_SHARE, _FAR_SHARE = 0.45, 0.85
#: Pairs of stances that get this far in the search, by stage.
_KEPT: Final = 80
_QUERIED: Final = 60
_SOLVED: Final = 3
#: Upper limit of solved stances in one plan, and in one that is made for another pelvis height to explain a failure.
_TRIALS: Final = 14
_TRIALS_DIAGNOSING: Final = 4
#: Room between the hands and the door before anything moves.
_HAND_ROOM_M: Final = 0.004
#: The same for a hand behind the door: its fingers would hook the door as they close.
_FINGERS_M: Final = 0.035
#: Way of the door from which on the fist has met it.
_NUDGED_M: Final = 0.01
#: Way of the door in the step before the push from which on the plan does not hold any more.
_TAKEN_ALONG_M: Final = 0.075
#: Peak speed of the free edge or drawer.
_EDGE_SPEED_M_S: Final = 0.4
#: How much deeper than in its push a fist may come to a door while it is drawn back.
_CATCH_M: Final = 0.004
#: How far a posture may be from the one before.
_JUMP_RAD: Final = 0.9


@dataclass(frozen=True, slots=True)
class Push:
    """How a door is pushed shut.

    Attributes:
        reach: the motion of the fist to the face, from the first stance.
        part: the door.
        positions: (N,) joint positions along the way.
        postures: (N, A) arm joints that go with them.
        stances: (N, 3) base poses (x, y, yaw) that go with them.
        away: (2, A) postures with which the fist is drawn back from the shut door.
        way: (M, 2) polyline to the first stance, None when the robot already stands there.
    """

    reach: Reach
    part: MovingPart
    positions: Array
    postures: Array
    stances: Array
    away: Array
    way: Array | None

    @property
    def walks(self) -> bool:
        """Whether the base moves at all."""
        return self.way is not None or bool(np.any(np.ptp(self.stances, axis=0) > 1e-6))


def plan_push(body: Body, arm: Arm, obj: ObjectInstance, part: MovingPart) -> Push | None:
    """How one arm shuts a door by pushing, with as little walking as possible; None when no way was found."""
    if any(name is not None and not body.obj(name).movable for name in body.hands.held.values()):
        return None  # a hand at another door or drawer: walking would tear at it
    door = Door.of(body, obj, part)
    low, high = part.range
    goal = low - _PAST_SHUT * (high - low)
    count = 2 + int(np.ceil(part.travel_m(door.now - goal) / _STEP_M))
    positions = np.linspace(door.now, goal, count)
    trials = _TRIALS if body.hypothesis.pelvis_height_m is None else _TRIALS_DIAGNOSING
    for spot in _spots(body, arm, door, obj):
        for stances in _stances(body, arm, door, spot, positions)[:_SOLVED]:
            if trials == 0:
                return None
            trials -= 1
            push = _solve(body, arm, door, spot, positions, stances)
            if push is not None:
                return push
    return None


def _spots(body: Body, arm: Arm, door: Door, obj: ObjectInstance) -> list[tuple[float, float]]:
    """Where the fist may touch, as distances from the hinge and heights: beside the handle first, which would catch it."""
    model, data = body.world.model, body.world.data
    shoulder_m = float(body.posture.shoulder(arm)[2])
    low, high = door.heights
    clear: list[tuple[float, float]] = []
    at_handle: list[tuple[float, float]] = []
    along_m, handle_z = np.inf, np.inf
    if door.part.handle_site >= 0:
        handle = data.site_xpos[door.part.handle_site]
        along_m, handle_z = float((handle - door.hinge(door.now)) @ door.along(door.now)), float(handle[2])
    long_m = high_m = 0.0  # half the handle's extent along the door and upwards, in excess of its thickness
    for geom in body.objects.part_geoms(obj, "handle"):
        half, axes = model.geom_aabb[geom, 3:], data.geom_xmat[geom].reshape(3, 3)
        long_m = max(long_m, float(np.abs(door.along(door.now) @ axes) @ half - np.min(half)))
        high_m = max(high_m, float(np.abs(axes[2]) @ half - np.min(half)))
    for share, rise in _SPOTS_SHARE_M:
        height = float(np.clip(shoulder_m + rise, low + 0.06, high - 0.06))
        ends = (share,) if not door.slides else (1.0 - share, share) if arm is Arm.LEFT else (share, 1.0 - share)
        for end in ends:
            spot = (end * door.width_m, height)
            beside, above = abs(along_m - spot[0]) > long_m + _FIST_HALF_M, abs(handle_z - height) > high_m + _FIST_HALF_M
            rank = clear if beside or above else at_handle
            if spot not in clear and spot not in at_handle:
                rank.append(spot)
    return clear + at_handle


# ---- stances


def _stances(body: Body, arm: Arm, door: Door, spot: tuple[float, float], positions: Array) -> list[Array]:
    """Base poses (N, 3) along the way from which the arm may push at a spot (distance from the hinge, height), best first."""
    base = body.posture.stance()
    sites = np.stack([door.point(float(p), *spot, _FIST_M) for p in positions])
    nav = body.workspace.navigation()
    first = _grid(door, base, sites[0])
    ways = nav.ways(base.position).costs_m(first[:, :2])
    here = np.zeros(len(first), dtype=bool)
    here[0] = True
    ways = np.where(here, 0.0, ways)
    keep = (here | (nav.clearance(first[:, :2]) >= 0.0)) & (ways <= _WALK_M)
    first, ways = first[keep], ways[keep]
    turn = np.abs(_wrapped(first[:, 2] - base.yaw_rad))
    strain = _strain(body, arm, first, np.broadcast_to(sites[0], (len(first), 3)))
    cost = ways + 0.15 * turn + strain
    cost[_behind(body, arm, door, first, sites[0], float(positions[0]))] = np.inf
    first, cost = _best(first, cost)
    room = navigation_map(body.world, body.spec.footprint_radius_m, door.part.body_id)
    last = _grid(door, base, sites[-1])
    last = np.concatenate([first, last])
    last = last[room.clearance(last[:, :2]) >= -0.02]
    last, last_cost = _best(last, _strain(body, arm, last, np.broadcast_to(sites[-1], (len(last), 3))))
    if not len(first) or not len(last):
        return []
    # pairs of a first and a last stance
    a, b = np.repeat(first, len(last), axis=0), np.tile(last, (len(first), 1))
    change = np.stack([b[:, 0] - a[:, 0], b[:, 1] - a[:, 1], _wrapped(b[:, 2] - a[:, 2])], axis=1)
    shift = np.hypot(change[:, 0], change[:, 1])
    total = np.repeat(cost, len(last)) + np.tile(last_cost, len(first)) + 0.6 * shift + 0.2 * np.abs(change[:, 2])
    fits = (shift <= _ALONG_M) & (np.abs(change[:, 2]) <= _ALONG_RAD)
    a, change, total = a[fits], change[fits], total[fits]
    shares = np.linspace(0.0, 1.0, len(positions))
    strained = np.zeros(len(a))
    clear = np.full(len(a), np.inf)
    for share, site, position in zip(shares, sites, positions, strict=True):
        pose = a + share * change
        strained = np.maximum(strained, _strain(body, arm, pose, np.broadcast_to(site, (len(a), 3))))
        clear = np.minimum(clear, door.distance_m(pose[:, :2], float(position)) - body.spec.footprint_radius_m)
    # a robot that stands closer to the door than its disc allows may not come closer
    total = total + 3.0 * strained
    total[clear < -0.03] = np.inf
    order = np.argsort(total, kind="stable")
    found: list[Array] = []
    for index in order[:_QUERIED]:
        if not np.isfinite(total[index]):
            break
        way = a[index] + shares[:, None] * change[index]
        if np.any(room.clearance(way[:, :2]) < -0.02):
            continue
        height = body.posture.pelvis_height_m
        if all(body.ik.within(arm, s, height, Stance(*map(float, p))) for s, p in zip(sites, way, strict=True)):
            found.append(way)
            if len(found) >= _SOLVED:
                break
    return found


def _grid(door: Door, base: Stance, site: Array) -> Array:
    """(M, 3) base poses around a door that face the point of contact, the present one first."""
    steps = np.arange(-_GRID_M, _GRID_M + 1e-9, _SPACING_M)
    u, v = (axis.ravel() for axis in np.meshgrid(steps, steps))
    spots = door.hinge(door.now)[:2] + u[:, None] * door.side[:2] + v[:, None] * door.front[:2]
    spots = spots[np.hypot(*(spots - site[:2]).T) < 0.95]
    bearing = np.arctan2(site[1] - spots[:, 1], site[0] - spots[:, 0])
    poses = [np.column_stack([spots, _wrapped(bearing + off)]) for off in _BEARINGS_RAD]
    return np.concatenate([np.array([[base.x, base.y, base.yaw_rad]]), *poses])


def _strain(body: Body, arm: Arm, poses: Array, sites: Array) -> Array:
    """(M,) metres by which a hand at (M, 3) sites is too close to the shoulder or too far from it, infinite out of reach."""
    shoulder, reach = body.ik.maps[arm.value].shoulder, body.ik.maps[arm.value].reach_m
    local = _shoulders(body, arm, poses)
    delta = sites - local
    distance = np.linalg.norm(delta, axis=1)
    c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    ahead = c * delta[:, 0] + s * delta[:, 1] + float(shoulder[0])
    strain = np.maximum(np.maximum(_NEAR_SHARE * reach - distance, distance - _FAR_SHARE * reach), 0.0)
    strain += np.maximum(0.1 - ahead, 0.0)
    strain[(distance > 0.98 * reach) | (distance < 0.25 * reach) | (ahead < -0.02)] = np.inf
    return strain


def _shoulders(body: Body, arm: Arm, poses: Array) -> Array:
    """(M, 3) shoulders of the robot at base poses (M, 3)."""
    base = body.posture.stance()
    delta = body.posture.shoulder(arm) - (base.x, base.y, 0.0)
    local = body.posture.turn_to_pelvis(delta)
    c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    x, y = c * local[0] - s * local[1], s * local[0] + c * local[1]
    return np.stack([poses[:, 0] + x, poses[:, 1] + y, np.full(len(poses), local[2])], axis=1)


def _behind(body: Body, arm: Arm, door: Door, poses: Array, site: Array, position: float) -> NDArray[np.bool_]:
    """(M,) whether the straight line from shoulder to hand would pass through the door."""
    shoulders = _shoulders(body, arm, poses) - door.hinge(position)
    out = shoulders @ door.normal(position) - door.face_m
    along = shoulders @ door.along(position)
    hand = float((site - door.hinge(position)) @ door.along(position))
    crossing = hand + (along - hand) * _FIST_M / np.maximum(_FIST_M - out, 1e-6)
    return (out < 0.0) & (crossing < door.width_m + 0.02) & (crossing > -0.02 if door.slides else True)


def _best(poses: Array, cost: Array) -> tuple[Array, Array]:
    order = np.argsort(cost, kind="stable")[:_KEPT]
    order = order[np.isfinite(cost[order])]
    return poses[order], cost[order]


def _wrapped(angle: Array) -> Array:
    return np.asarray((angle + np.pi) % (2.0 * np.pi) - np.pi)


# ---- postures


def _solve(body: Body, arm: Arm, door: Door, spot: tuple[float, float], positions: Array, stances: Array) -> Push | None:
    """The arm's postures along the way, None when it cannot follow or would collide."""
    base = body.posture.stance()
    first = Stance(*map(float, stances[0]))
    there = body.assuming(stance=first)  # a hand that is at the door already would move it
    states = [there.probe.against_door(a, body.arms.commanded(a), door.part, door.now, fist=False) for a in Arm]
    if any(state.gap_m < (_HAND_ROOM_M if door.before(state, door.now) else _FINGERS_M) for state in states):
        return None
    for hand_target in _directions(body, arm, door, spot, float(positions[0]), first):
        postures: list[Array] = []
        out_m = _FIST_M
        for position, pose in zip(map(float, positions), stances, strict=True):
            stance = Stance(*map(float, pose))
            start = postures[-1] if postures else None
            found = _at_face(body, arm, door, spot, position, stance, out_m, hand_target if start is None else None, start)
            if found is None:
                break
            q, out_m = found
            if start is not None and float(np.max(np.abs(q - start))) > _JUMP_RAD:
                break
            postures.append(q)
        if len(postures) < len(positions):
            continue
        away = _away(body, arm, door, positions, np.stack(postures), Stance(*map(float, stances[-1])))
        if away is None:
            continue
        reach = _approach(there, arm, door, spot, float(positions[0]), postures[0])
        if reach is None:
            continue
        moves = float(np.hypot(first.x - base.x, first.y - base.y)) + abs(
            float(_wrapped(np.array(first.yaw_rad - base.yaw_rad)))
        )
        way = body.workspace.navigation().ways(base.position).to(first.position) if moves > 1e-3 else None
        if moves > 1e-3 and way is None:
            return None
        return Push(reach, door.part, positions, np.stack(postures), stances, away, way)
    return None


def _directions(
    body: Body, arm: Arm, door: Door, spot: tuple[float, float], position: float, stance: Stance
) -> Iterator[Array | None]:
    """Directions of the forearm that are tried at the first contact: none in particular, into the face, from the shoulder."""
    yield None
    inward = -door.normal(position)
    sight = door.point(position, *spot, _FIST_M) - _shoulders(body, arm, np.array([[stance.x, stance.y, stance.yaw_rad]]))[0]
    sight[2] = 0.0
    sight /= max(float(np.linalg.norm(sight)), 1e-9)
    yield sight
    yield inward
    middle = inward + sight
    if float(np.linalg.norm(middle)) > 0.3:
        yield middle / np.linalg.norm(middle)


def _at_face(
    body: Body,
    arm: Arm,
    door: Door,
    spot: tuple[float, float],
    position: float,
    stance: Stance,
    out_m: float,
    pointing: Array | None,
    start: Array | None,
) -> tuple[Array, float] | None:
    """An arm posture whose fist presses on the door, and how far the grasp site then is before the face."""
    there = body.assuming(stance=stance)
    for _ in range(4):
        goal = there.ik.solve(arm, HandPose(door.point(position, *spot, out_m), pointing), start)
        if goal.error_m > 0.025:
            return None
        state = there.probe.against_door(arm, goal.q, door.part, position)
        if state.depth_m > TOUCH_M:
            return None
        if abs(state.gap_m + _PRESS_M) <= _PRESS_SLACK_M:
            return (goal.q, out_m) if door.outside(state, position) else None
        out_m = float(np.clip(out_m - (state.gap_m + _PRESS_M), -0.02, 0.2))
        start = goal.q
    return None


def _away(body: Body, arm: Arm, door: Door, positions: Array, postures: Array, stance: Stance) -> Array | None:
    """The postures after the push: at the shut door and away from it; None when the fist would catch the handle on the way."""
    shut = door.part.range[0]
    order = np.argsort(positions, kind="stable")
    at = np.array([np.interp(shut, positions[order], column[order]) for column in postures.T])
    there = body.assuming(stance=stance)
    goal = there.ik.solve(arm, HandPose(there.ik.hand_at(arm, at) + _BEFORE_M * door.normal(shut)), start=at)
    if goal.error_m > 0.04:
        return None
    shares = (0.0, 0.2, 0.4, 0.6, 0.8, 1.0)
    states = [there.probe.against_door(arm, at + s * (goal.q - at), door.part, shut) for s in shares]
    caught = any(state.gap_m < min(states[0].gap_m, 0.0) - _CATCH_M for state in states)
    return None if caught else np.stack([at, goal.q])


def _approach(body: Body, arm: Arm, door: Door, spot: tuple[float, float], position: float, at: Array) -> Reach | None:
    """The way of the fist to its first contact, from the assumed stance."""
    hand = body.ik.hand_at(arm, at)
    for out in (door.normal(position), 0.7 * door.normal(position) + 0.7 * door.along(position)):
        before: ArmGoal | None = None
        for distance in (_BEFORE_M, 0.6 * _BEFORE_M):
            before = body.ik.solve(arm, HandPose(hand + distance * out), start=at)
            if before.error_m <= 0.024 and float(np.max(np.abs(before.q - at))) < 1.5:
                break
            before = None
        if before is None:
            continue
        steps = [before.q + share * (at - before.q) for share in (0.0, 0.25, 0.5, 0.75)]
        states = [body.probe.against_door(arm, q, door.part, position) for q in steps]
        if any(s.gap_m < -_PRESS_M or s.depth_m > TOUCH_M or not door.outside(s, position) for s in states):
            continue
        way = _route(body, arm, door, spot, position, before.q)
        if way is not None:
            return Reach(way, before.q, at)
    return None


def _route(
    body: Body, arm: Arm, door: Door, spot: tuple[float, float], position: float, goal: Array
) -> tuple[Array, ...] | None:
    """Postures to pass on the way to `goal`: the usual ones, or one beyond the door's free edge."""
    start = body.arms.commanded(arm)
    way = route(body, arm, start, goal, (), 0.0)
    if way is not None:
        return way
    for beyond, out in ((0.12, 0.08), (0.12, -0.05), (0.2, 0.0)):
        point = door.point(position, door.width_m + beyond, spot[1], out)
        if not body.ik.within(arm, point, body.posture.pelvis_height_m):
            continue
        via = body.ik.solve(arm, HandPose(point), start=goal)
        if via.error_m > 0.03:
            continue
        first, second = route(body, arm, start, via.q, (), 0.0), route(body, arm, via.q, goal, (), 0.0)
        if first is not None and second is not None:
            return (*first, via.q, *second)
    return None


# ---- motion


def push_shut(body: Body, action: Action, push: Push, outcome: str) -> Skill:
    """Walks to the stance, moves the fist to the door face, pushes along the arc, retracts and stows the arm.

    Where the step takes the door along, it ends there: the rest has to be planned again.

    Raises:
        SkillFailure: GraspMissed when the fist does not come to the door, or a contingency.
    """
    arm, part = action.arm, push.part
    assert arm is not None and action.object_id is not None
    if push.way is not None:
        yield from step_to(body, push.way, float(push.stances[0, 2]))
        if part.travel_m(float(body.world.data.qpos[part.qpos_adr] - push.positions[0])) > _TAKEN_ALONG_M:
            return
    yield from body.hands.move(arm, 0.0, 0.2)
    yield from body.arms.move(arm, [*push.reach.way, push.reach.before])
    yield from body.arms.move(arm, [push.reach.at], speed=0.5)
    yield from wait(0.1)
    panel = np.flatnonzero(body.world.model.geom_bodyid == part.body_id)
    gap = body.probe.limb_gap_m(arm, panel)
    moved = part.travel_m(float(body.world.data.qpos[part.qpos_adr] - push.positions[0]))
    if gap > GRASP_GAP_M and moved < _NUDGED_M:
        yield from _draw_back(body, arm, push.reach.before[None])
        raise SkillFailure(FailureCode.GRASP_MISSED, {"gap_m": gap})
    if outcome != "success":
        yield from wait(0.2)
        yield from _draw_back(body, arm, push.reach.before[None])
        code = FailureCode.LOCKED if outcome == "locked" else FailureCode.NOTHING_HAPPENED
        raise SkillFailure(code, contingency=outcome)
    stances = push.stances + (0.0, 0.0, body.posture.stance().yaw_rad - push.stances[0, 2])  # the same turn of the heading
    length = part.travel_m(float(push.positions[-1] - push.positions[0]))
    yield from sweep(body, arm, push.postures, stances, 1.875 * max(length, 0.1) / _EDGE_SPEED_M_S)
    yield from wait(0.2)
    yield from _draw_back(body, arm, push.away)


def _draw_back(body: Body, arm: Arm, away: Array) -> Skill:
    """Retracts the fist from the face and stows the arm with an open hand."""
    yield from body.arms.move(arm, list(away))
    yield from body.hands.move(arm, 1.0, 0.2)
    yield from stow(body, arm)
