"""Opening and closing lids by a tab or knob: the fingertips follow the arc of the handle.

A door's bar lies deep in the hand, and the hand turns with it. A lid's tab is small and is held by the fingertips; the lid
turns about a level axis by more than a right angle, which no wrist follows. So the hand keeps its direction as well as it can,
and the tab turns between the fingers. Paper: Open and Close of the DualTHOR action space.

Constants were chosen by hand; with them the certificates of the 359 benchmark tasks were made on both robots, and
`benchmarks/doors.py` shows what they give on every door, drawer and lid of the ten rooms.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from interface.bodies import Arm
from sim.skills.body.body import Body
from sim.skills.navigation import Stance
from sim.skills.reach import Reach, fulfils, plan_reach
from sim.skills.reach_map import HandPose

Array = NDArray[np.float64]

_UP: Final = np.array([0.0, 0.0, 1.0])
#: The fingertips reach this far past the middle of a tab.
_PAST_M: Final = 0.004
#: Farthest that the fingertips may be from the tab's arc, and most that a joint turns between two of its points.
_TOLERANCE_M: Final = 0.015
_STEP_RAD: Final = 0.9
#: A lid that nears the upright turns a small error of the hand's height into a long push: the arc is solved to this distance.
_EXACT_M: Final = 0.003
_LOST_M: Final = 0.06
#: A point of the arc that is farther than this from every sampled hand is not tried.
_NEAR_M: Final = 0.1
_ROUNDS: Final = 4
#: Ways to a tab that are led to their end before the longest is taken.
_TRIED: Final = 6


@dataclass(frozen=True, slots=True)
class _Tab:
    """How a hand takes a tab: where it belongs in the grasp site's frame, and the hand's openings before and after."""

    seat: tuple[float, float, float]
    opening: float
    closed: float


@dataclass(frozen=True, slots=True)
class Lead:
    """Motion of a hand to a tab and along its arc.

    Attributes:
        reach: the motion to the tab.
        postures: (N, A) arm joints along its arc, from where it is; N is less than asked for where the arm ends.
        back_m: how far the base steps back on the whole way.
        opening, closed: opening of the hand on arrival, and when it has the tab.
    """

    reach: Reach
    postures: Array
    back_m: float
    opening: float
    closed: float


@dataclass(frozen=True, slots=True)
class _Held:
    """A tab between the fingers of an arm posture: the hand's directions, and where the tab is in the grasp site's frame."""

    q: Array
    pointing: Array
    closing: Array
    seat: tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class _Taking:
    reach: Reach
    pointing: Array
    closing: Array
    tab: _Tab


def _site(tab: Array, seat: tuple[float, float, float], pointing: Array, closing: Array) -> Array:
    """(3,) grasp site of a hand with those directions that has a tab at a seat."""
    return tab - seat[0] * pointing - seat[1] * closing - seat[2] * np.cross(pointing, closing)


def _tab(body: Body) -> _Tab:
    """Five fingers pinch between half-closed fingertips and thumb; parallel fingers close on the tab from both sides."""
    hand = body.spec.hand
    if hand.pinch_m is not None:
        return _Tab((0.04, hand.pinch_m, 0.0), 0.5, 0.5)
    return _Tab((hand.tip_m - _PAST_M, 0.0, 0.0), 1.0, closed_on(body))


def closed_on(body: Body) -> float:
    """Opening to which a hand closes on a bar or tab: five fingers hook it, two parallel ones press on it from both sides."""
    return 0.35 if body.spec.hand.pinch_m is not None else 0.1


def _closings(body: Body, pointing: Array) -> Iterator[Array]:
    level = np.cross(_UP, pointing)
    level /= np.linalg.norm(level)
    down = np.cross(pointing, level)
    if down[2] > 0.0:
        down = -down
    yield from (down, level, -level) if body.spec.hand.pinch_m is not None else (level,)


def _takings(body: Body, arm: Arm, tab: Array, pointings: Iterable[Array], bar: Sequence[int]) -> Iterator[_Taking]:
    """Motions that bring the fingertips to a tab."""
    how = _tab(body)
    for pointing in pointings:
        for closing in _closings(body, pointing):
            first = body.ik.solve(arm, HandPose(_site(tab, how.seat, pointing, closing), pointing, closing))
            if not fulfils(first, pointing=0.7, closing=0.5):
                continue
            # the tab belongs between the fingertips of the hand as it will really be turned
            x, y = first.pointing, first.closing
            hand_target = HandPose(_site(tab, how.seat, x, y), x, y)
            reach = plan_reach(body, arm, hand_target, -x, 0.07, bar, 0.97, 0.95, opening=how.opening, start=first.q)
            if reach is not None:
                yield _Taking(reach, x, y, how)
                break


def plan_tab(body: Body, arm: Arm, tab: Array, pointings: Iterable[Array], bar: Sequence[int]) -> Reach | None:
    """Approach of the fingertips to a tab (3,) in the world, None when out of reach; `bar` are geoms that may be touched."""
    return next((taking.reach for taking in _takings(body, arm, tab, pointings, bar)), None)


def plan_lead(
    body: Body,
    arm: Arm,
    arc: Callable[[float], Array],
    positions: Array,
    pointings: Iterable[Array],
    bar: Sequence[int],
    enough: int,
) -> Lead | None:
    """Plan to grasp a tab and move it along its arc as far as the arm reaches.

    Args:
        body: the robot.
        arm: which one.
        arc: (3,) world point of the tab by the lid's joint position.
        positions: (N,) joint positions along the way, the present one first.
        pointings: directions of the fingers to try, the best first.
        bar: geoms that may be touched on arrival.
        enough: a way with fewer points is of no use.
    """
    backs = _backs(body, arm, arc(float(positions[enough - 1])), (enough - 1) / (len(positions) - 1))
    if not backs:
        return None
    best: Lead | None = None
    for tried, taking in enumerate(_takings(body, arm, arc(float(positions[0])), pointings, bar), 1):
        for back in backs:
            stances = _stances(body, back, len(positions))
            way = _Held(taking.reach.at, taking.pointing, taking.closing, taking.tab.seat)
            postures = _follow(body, arm, [arc(float(p)) for p in positions], stances, way)
            if len(postures) >= enough and (best is None or len(postures) > len(best.postures)):
                made = back * (len(postures) - 1) / (len(positions) - 1)
                best = Lead(taking.reach, np.stack(postures), made, taking.tab.opening, taking.tab.closed)
            if len(postures) == len(positions):
                break
        if tried >= _TRIED or (best is not None and len(best.postures) == len(positions)):
            break
    return best


def led_on(body: Body, arm: Arm, arc: Callable[[float], Array], positions: Array, back_m: float) -> Array:
    """Postures that lead a tab on from where it really is between the fingers, a little beside where it was planned.

    Args:
        body: the robot.
        arm: which one.
        arc: (3,) world point of the tab by the lid's joint position.
        positions: (N,) joint positions along the way, the present one first.
        back_m: how far the base steps back on the way.

    Returns:
        (M, A) arm joints, M at most N: the arm may end before the way does.
    """
    tab = arc(float(positions[0]))
    q = body.arms.commanded(arm)
    site, hand = body.ik.hand_pose_at(arm, q)
    x, y, z = hand.T @ (tab - site)
    points = [arc(float(p)) for p in positions]
    held = _Held(q, hand[:, 0], hand[:, 1], (float(x), float(y), float(z)))
    return np.stack(_follow(body, arm, points, _stances(body, back_m, len(positions)), held))


def _backs(body: Body, arm: Arm, point: Array, share: float) -> list[float]:
    """How far the base may step back on the way, so that a point of it at that share can be in reach at all."""
    base = body.posture.stance()
    ahead = np.array([np.cos(base.yaw_rad), np.sin(base.yaw_rad)])
    free_m = body.workspace.navigation().free_travel(base.position, base.position - 0.3 * ahead)
    found: list[float] = []
    for back in (0.0, 0.12, 0.24):
        x, y = base.position - share * back * ahead
        shoulder = body.posture.shoulder(arm) - share * back * np.append(ahead, 0.0)
        site = point + _tab(body).seat[0] * (shoulder - point) / float(np.linalg.norm(shoulder - point))
        stance = Stance(float(x), float(y), base.yaw_rad)
        if back <= free_m and body.ik.maps[arm.value].gap_m(body.posture.in_trunk(site, None, stance)) <= _NEAR_M:
            found.append(back)
    return found


def _stances(body: Body, back_m: float, count: int) -> list[Stance]:
    """The base's ways back, evenly."""
    base = body.posture.stance()
    ahead = np.array([np.cos(base.yaw_rad), np.sin(base.yaw_rad)])
    places = [base.position - share * back_m * ahead for share in np.linspace(0.0, 1.0, count)]
    return [Stance(float(x), float(y), base.yaw_rad) for x, y in places]


def _follow(body: Body, arm: Arm, points: Sequence[Array], stances: Sequence[Stance], held: _Held) -> list[Array]:
    """(A,) postures whose fingertips are at the points, as many as the arm can do one after the other."""
    postures, pointing, closing = [held.q], held.pointing, held.closing
    for point, stance in zip(points[1:], stances[1:], strict=True):
        start = postures[-1]
        missed, gap_m = np.zeros(3), np.inf
        for _ in range(_ROUNDS):
            hand_target = HandPose(_site(point, held.seat, pointing, closing) - missed, pointing, closing)
            goal = body.ik.solve(arm, hand_target, start=start, base=stance, pointing_weight=0.05, roll_weight=0.02)
            site, hand = body.ik.hand_pose_at(arm, goal.q, stance)
            off = site + hand @ held.seat - point
            gap_m, start, pointing, closing = float(np.linalg.norm(off)), goal.q, hand[:, 0], hand[:, 1]
            if gap_m <= _EXACT_M or gap_m > _LOST_M:
                break
            missed = missed + off  # the solver is content too early: aim beside the point by what it missed
        if gap_m > _TOLERANCE_M:
            return postures
        if float(np.max(np.abs(start - postures[-1]))) > _STEP_RAD:
            return postures
        postures.append(start)
    return postures
