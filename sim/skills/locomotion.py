"""Body skills: walk, turn, change pelvis height, go to an object; and the base that moves along with an arm.

The base follows collision-free paths as a disc, the feet step along (`sim.skills.gait`), and a hand that is pressed against
something on the way stops the walk. Balance while walking is not simulated: the base is driven by servos, which the README
states among the limits.

Paper: body actions of the DualTHOR action space. GoTo replaces the paper's teleporting navigation by a planned path.

Constants were chosen by hand; with them the certificates of the 359 benchmark tasks were made on both robots.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from interface.bodies import Arm
from interface.failures import FailureCode
from interface.steps import Action
from sim.skills.body.base import Walk
from sim.skills.body.body import Body
from sim.skills.failures import SkillFailure
from sim.skills.navigation import NavigationMap, Stance, wrap_angle
from sim.skills.runner import CONTROL_DT_S, Skill, TwoTicks
from sim.skills.trajectory import min_jerk, plan, plan_polyline

WALK_SPEED_M_S: Final = 0.9
WALK_ACCELERATION_M_S2: Final = 2.0
TURN_SPEED_RAD_S: Final = 2.2
#: While walking with something in a hand, which is ahead of the base and would be flung round.
LADEN_TURN_SPEED_RAD_S: Final = 0.8
TURN_ACCELERATION_RAD_S2: Final = 5.0
HEIGHT_SPEED_M_S: Final = 0.35
HEIGHT_ACCELERATION_M_S2: Final = 1.0

#: What a walk goes on under, as `Body.pushed` gives it: an arm that presses into something (m), fingers bent beyond their range
#: (rad, or m / 0.2), an arm pushed away from where it is held (rad).
_PUSHED: Final = np.array([0.03, 0.04, 0.3])
#: How far back, in time, a walk goes that has run into something.
_RETREAT_S: Final = 0.35

#: Heading of a step relative to the robot's own, by action.
_DIRECTIONS: Final = {"MoveAhead": 0.0, "MoveLeft": np.pi / 2, "MoveBack": np.pi, "MoveRight": -np.pi / 2}
#: GoTo walks backwards or sideways over ways shorter than this, and turns into the way before longer ones.
_SIDESTEP_M: Final = 0.5
#: Metres of walking that one radian off the object's face is worth.
_FACE_WEIGHT: Final = 3.0
#: Lengths of the last step of GoTo, straight ahead, that are tried in turn.
_LAST_STEP_M: Final = (0.35, 0.25, 0.15)
#: Preference of near over exact: metres of walking that one metre of deviation from the comfortable distance is worth.
_DISTANCE_WEIGHT: Final = 6.0
#: Stances that are asked whether the hands fit there, and how much more than the best one they may cost.
_ASKED: Final = 16
_WORSE: Final = 0.8


def _turn(body: Body, yaw_rad: float) -> Skill:
    start = body.posture.stance()
    yield from _turn_by(body, wrap_angle(yaw_rad - start.yaw_rad))


def _turn_by(body: Body, change_rad: float) -> Skill:
    start = body.posture.stance()
    ways = plan(np.array([[0.0], [change_rad]]), TURN_SPEED_RAD_S, TURN_ACCELERATION_RAD_S2)
    turns = [float(ways.at(time_s)[0]) for time_s in _ticks(ways.duration_s)]
    yield from _travel(body, np.array([(start.x, start.y, start.yaw_rad + turn) for turn in turns]))


def _walk(body: Body, path: NDArray[np.float64], along: bool, limits: NDArray[np.float64] = _PUSHED) -> Skill:
    """Follows a polyline; `along` turns the heading into the direction of travel at a bounded rate."""
    way = plan_polyline(path, WALK_SPEED_M_S, WALK_ACCELERATION_M_S2)
    yaw = body.posture.stance().yaw_rad
    turn = LADEN_TURN_SPEED_RAD_S if any(body.hands.held.values()) else TURN_SPEED_RAD_S
    poses = []
    for time_s in _ticks(way.duration_s):
        x, y = way.at(time_s)
        if along:
            ahead = way.at(time_s + 0.25) - (x, y)
            if float(np.hypot(*ahead)) > 1e-3:
                error = wrap_angle(float(np.arctan2(ahead[1], ahead[0])) - yaw)
                yaw += float(np.clip(4.0 * error, -turn, turn)) * CONTROL_DT_S
        poses.append((float(x), float(y), yaw))
    yield from _travel(body, np.array(poses), limits)


def _ticks(duration_s: float) -> list[float]:
    """The times of the control ticks of a motion, the end included."""
    times = [0.0]
    while times[-1] < duration_s:
        times.append(times[-1] + CONTROL_DT_S)
    return times[1:]


def _travel(body: Body, way: NDArray[np.float64], limits: NDArray[np.float64] = _PUSHED) -> Skill:
    """Moves the base along a path (T, 3) of x, y and yaw with walking legs; stops when a hand hits something.

    What presses at the start may go on pressing a little, so that the robot can walk away from it.

    Raises:
        SkillFailure: BlockedPath with the metres that were walked, after a step back.
    """
    if len(way) == 0:
        return
    start = body.posture.stance()
    way = np.concatenate([[(start.x, start.y, start.yaw_rad)], way])  # (T + 1, 3)
    walk = body.base.walk(way)
    limits, stops = np.maximum(limits, body.contacts.pushed() + 0.5 * _PUSHED), TwoTicks()
    for tick in range(1, len(way)):
        walk.command(tick)
        yield
        if stops(bool(np.any(body.contacts.pushed() > limits))):
            yield from _retreat(body, walk, way[: tick + 1])
            walked = float(np.linalg.norm(body.posture.stance().position - start.position))
            raise SkillFailure(FailureCode.BLOCKED_PATH, {"travel_m": walked})


def _retreat(body: Body, walk: Walk, way: NDArray[np.float64]) -> Skill:
    """Goes back along a way (T, 3) until nothing presses, a third of a second at most, and brings the feet together."""
    tick = yield from _go_back(body, len(way) - 1, lambda earlier: walk.command(earlier, way[earlier]))
    for share in np.linspace(0.0, 1.0, round(0.3 / CONTROL_DT_S))[1:]:
        walk.stand(tick, float(share))
        yield


def _go_back(body: Body, tick: int, command: Callable[[int], None]) -> Generator[None, None, int]:
    """Repeats the commands of a motion backwards until nothing presses, a third of a second at most; returns the last tick."""
    for earlier in reversed(range(max(tick - round(_RETREAT_S / CONTROL_DT_S), 0), tick)):
        tick = earlier
        command(tick)
        yield
        if np.all(body.contacts.pushed() <= 0.5 * _PUSHED):
            break
    return tick


def _settle(body: Body) -> Skill:
    """Waits until the base has come to rest at its target, at most half a second."""
    for _ in range(int(0.5 / CONTROL_DT_S)):
        if body.base.error_m() < 0.004:
            return
        yield


def _length_m(path: NDArray[np.float64]) -> float:
    """Length of a polyline (N, 2)."""
    return float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum())


def _before(body: Body, start: Stance, stance: Stance) -> NDArray[np.float64] | None:
    """A polyline (N, 2) to a place from which a straight step ahead leads to a stance, None when there is none."""
    ahead = np.array([np.cos(stance.yaw_rad), np.sin(stance.yaw_rad)])
    navigation = body.workspace.navigation()
    for distance in _LAST_STEP_M:
        place = stance.position - distance * ahead
        if navigation.is_free(place) and navigation.segment_free(place, stance.position):
            path = navigation.path(start.position, place)
            if path is not None and _length_m(path) > 0.01:
                return path
    return None


def step_to(body: Body, path: NDArray[np.float64], yaw_rad: float) -> Skill:
    """Sidesteps along a polyline (N, 2) to a stance close by, then turns into its heading.

    The arms may be pushed aside farther than in other walks: the way leads around an open door.
    """
    if _length_m(path) > 0.01:
        yield from _walk(body, path, along=False, limits=_PUSHED * (1.0, 1.0, 2.0))
    yield from _turn(body, yaw_rad)
    yield from _settle(body)


def sweep(body: Body, arm: Arm, postures: NDArray[np.float64], stances: NDArray[np.float64], duration_s: float) -> Skill:
    """Moves a hand along a path with arm, base and legs together, from rest to rest.

    Args:
        body: the robot.
        arm: whose hand it is.
        postures: (N, A) arm joints along the way, evenly spaced.
        stances: (N, 3) base poses (x, y, yaw) that go with them; base and legs stay as they are where these are all alike.
        duration_s: time for the whole way.
    """
    steps = max(2, round(duration_s / CONTROL_DT_S))
    shares = np.linspace(0.0, 1.0, len(postures))
    travelled = np.array([min_jerk(k / steps) for k in range(steps + 1)])  # (T,)

    def between(rows: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.column_stack([np.interp(travelled, shares, column) for column in rows.T])  # (N, D) -> (T, D)

    arms = between(postures)
    moves = bool(np.any(np.ptp(stances, axis=0) > 1e-6))
    walk = body.base.walk(between(stances), rises=False) if moves else None
    for k in range(1, steps + 1):
        body.arms.command(arm, arms[k])
        if walk is not None:
            walk.command(k)
        yield


def move(body: Body, action: Action) -> Skill:
    """Walks straight ahead, back or sideways as far as the path is free; fails when it is blocked before the end.

    Raises:
        SkillFailure: BlockedPath with the metres that were walked.
    """
    amount = action.given_amount
    start = body.posture.stance()
    angle = start.yaw_rad + _DIRECTIONS[action.name]
    goal = start.position + amount * np.array([np.cos(angle), np.sin(angle)])
    free_m = body.workspace.navigation().free_travel(start.position, goal)
    blocked = free_m < amount - 0.01
    if free_m > 0.01:
        end = start.position + (goal - start.position) * (free_m / amount)
        yield from _walk(body, np.stack([start.position, end]), along=False)
        yield from _settle(body)
    if blocked:
        raise SkillFailure(FailureCode.BLOCKED_PATH, {"travel_m": free_m})


def rotate(body: Body, action: Action) -> Skill:
    """Turns on the spot.

    Raises:
        SkillFailure: BlockedPath when a hand runs into something.
    """
    degrees = action.given_amount
    sign = 1.0 if action.name == "RotateLeft" else -1.0
    yield from _turn_by(body, sign * np.deg2rad(degrees))
    yield from _settle(body)


def change_height(body: Body, action: Action) -> Skill:
    """MoveUp and MoveDown: bends or stretches the legs within their range, until the arms hit something.

    Raises:
        SkillFailure: HeightLimit, with the part of the change that was not made, when they could do less than asked.
    """
    amount = action.given_amount
    start = body.posture.pelvis_height_m
    wanted = start + (amount if action.name == "MoveUp" else -amount)
    low, high = body.spec.pelvis_height_range_m
    goal = float(np.clip(wanted, low, high))
    way = plan(np.array([[start], [goal]]), HEIGHT_SPEED_M_S, HEIGHT_ACCELERATION_M_S2)
    limits, stops = np.maximum(_PUSHED, body.contacts.pushed() + 0.5 * _PUSHED), TwoTicks()
    heights = [float(way.at(time_s)[0]) for time_s in _ticks(way.duration_s)]
    for tick, height_m in enumerate(heights):
        body.base.command_height(height_m)
        yield
        if stops(bool(np.any(body.contacts.pushed() > limits))):
            yield from _go_back(body, tick, lambda earlier: body.base.command_height(heights[earlier]))
            goal = body.posture.pelvis_height_m
            break
    yield from _settle(body)
    if abs(wanted - goal) > 0.005:
        raise SkillFailure(FailureCode.HEIGHT_LIMIT, {"height_m": wanted - goal})


def best_stance(
    navigation: NavigationMap,
    start: Stance,
    target: NDArray[np.float64],
    comfort_m: tuple[float, float],
    distance_m: float | None,
    bearing_rad: float,
    faces_rad: Sequence[float] = (),
    serves: Callable[[Stance], bool] | None = None,
) -> tuple[Stance, NDArray[np.float64]] | None:
    """The stance for GoTo and the way there.

    Args:
        navigation: free space.
        start: current base pose.
        target: (2,) world position of the object.
        comfort_m: range of distances the arms like; the middle is preferred.
        distance_m: distance asked for, None for the most comfortable one that is free.
        bearing_rad: bearing of the object after arrival.
        faces_rad: directions out of the object in which it is best approached; any direction when empty.
        serves: whether the robot fits at a stance, hands included; asked of a few, the best first. Where none of them
            serves, the best one is taken.

    Returns:
        The stance and a polyline (N, 2) to it, None when no free stance can be reached.
    """
    if distance_m is not None:
        rings = [[distance_m], [distance_m - 0.05, distance_m + 0.05]]
    else:
        low, high = comfort_m
        rings = [list(np.arange(low, high + 1e-9, 0.025)), list(np.arange(high + 0.05, 2.0, 0.05))]
    ways = navigation.ways(start.position)
    middle = distance_m if distance_m is not None else 0.5 * (comfort_m[0] + comfort_m[1])
    for ring in rings:
        stances = navigation.stances(target, [d for d in ring if d > 0.05], bearing_rad)
        if not stances:
            continue
        ranked: list[tuple[float, int, Stance]] = []
        costs = ways.costs_m(np.stack([stance.position for stance in stances]))
        for index, (stance, way_m) in enumerate(zip(stances, map(float, costs), strict=True)):
            off = abs(float(np.linalg.norm(stance.position - target)) - middle)
            turn = abs(wrap_angle(stance.yaw_rad - start.yaw_rad))
            cost = way_m + _DISTANCE_WEIGHT * off + 0.1 * turn
            if faces_rad:
                delta = stance.position - target
                side = float(np.arctan2(delta[1], delta[0]))
                cost += _FACE_WEIGHT * min(abs(wrap_angle(side - face)) for face in faces_rad)
            if np.isfinite(cost):
                ranked.append((round(cost, 9), index, stance))
        if ranked:
            ranked.sort(key=lambda entry: entry[:2])
            near = [stance for cost, _, stance in ranked[:_ASKED] if cost <= ranked[0][0] + _WORSE]
            chosen = next((stance for stance in near if serves is None or serves(stance)), near[0])
            path = ways.to(chosen.position)
            assert path is not None
            return chosen, path
    return None


def go_to(body: Body, action: Action) -> Skill:
    """Walks to a free stance near an object and faces it; the pelvis height stays.

    Raises:
        SkillFailure: NoFreePose, or BlockedPath when a hand runs into something on the way.
    """
    assert action.object_id is not None
    target = body.objects.interaction_point(action.object_id)[:2]
    bearing = np.deg2rad(action.bearing_deg) if action.bearing_deg is not None else 0.0
    start = body.posture.stance()
    found = best_stance(
        body.workspace.navigation(),
        start,
        target,
        body.workspace.comfortable_distance_m(),
        action.amount,
        bearing,
        body.objects.faces_rad(action.object_id),
        body.fits,
    )
    if found is None:
        raise SkillFailure(FailureCode.NO_FREE_POSE)
    stance, path = found
    if _length_m(path) > 0.01:
        along = _length_m(path) > _SIDESTEP_M
        before = _before(body, start, stance) if along else None
        if before is not None:
            path = before
        if along:
            first = path[min(1, len(path) - 1)] - path[0]
            yield from _turn(body, float(np.arctan2(first[1], first[0])))
        yield from _walk(body, path, along)
        if before is not None:  # the last steps straight ahead: hands that turn above a table sweep it
            yield from _turn(body, stance.yaw_rad)
            yield from _walk(body, np.stack([path[-1], stance.position]), along=False)
    yield from _turn(body, stance.yaw_rad)
    yield from _settle(body)
