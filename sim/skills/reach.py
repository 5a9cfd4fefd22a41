"""From a target for the hand to a checked arm motion, or to the failure code that says what is wrong.

A target that the arm cannot fulfil is told apart by trying other pelvis heights at the same stance: none helps, TooFar; a lower
one does, BodyTooHigh; a higher one does, BodyTooLow; the present one should do but every motion collides, Obstructed.

Constants were chosen by hand; with them the certificates of the 359 benchmark tasks were made on both robots.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final, TypeVar

import numpy as np
from numpy.typing import NDArray

from interface.bodies import Arm
from interface.failures import FailureCode
from sim.skills.body.body import Body
from sim.skills.body.ik import REACH_TOLERANCE_M, ArmGoal
from sim.skills.failures import SkillFailure
from sim.skills.reach_map import HandPose

Array = NDArray[np.float64]
T = TypeVar("T")

#: How well the fingers must agree with the directions asked for (cosines) for a grasp to be tried.
MIN_POINTING: Final = 0.75
MIN_CLOSING: Final = 0.8
#: Largest turn of a joint between two postures that are checked on the way.
_PATH_STEP_RAD: Final = 0.1
#: Penetration on the way that is no obstacle, and the most that is tried when there is no better way: an edge catches a hand.
_GRAZE_M: Final = 0.002
_SLIDE_M: Final = 0.005


@dataclass(frozen=True, slots=True)
class Reach:
    """A checked motion of the hand to a target.

    Attributes:
        way: (A,) arm postures to pass on the way to `before`.
        before: (A,) posture short of the target.
        at: (A,) posture at the target.
    """

    way: tuple[Array, ...]
    before: Array
    at: Array


def fulfils(goal: ArmGoal, pointing: float = MIN_POINTING, closing: float = MIN_CLOSING) -> bool:
    """Whether a solved posture is close enough to its target."""
    return goal.error_m <= REACH_TOLERANCE_M and goal.pointing_cos >= pointing and goal.closing_cos >= closing


def diagnose(body: Body, points: Mapping[Arm, Array], plan: Callable[[Body], object]) -> SkillFailure:
    """Why a plan failed: whether another pelvis height at this stance would have served, else distance or obstruction.

    Args:
        body: the robot.
        points: what each arm reaches for, world frame.
        plan: plans for a body; raises SkillFailure when it cannot.
    """
    if not body.hypothesis.diagnose:
        return SkillFailure(FailureCode.OBSTRUCTED)
    present = body.posture.pelvis_height_m
    common = [height for height in body.ik.heights() if all(body.ik.within(arm, p, height) for arm, p in points.items())]
    gap = max(
        max(body.ik.maps[a.value].beyond_m(body.posture.in_trunk(p)), body.ik.maps[a.value].gap_m(body.posture.in_trunk(p)))
        for a, p in points.items()
    )
    for height in sorted(common, key=lambda height: abs(height - present)):
        if abs(height - present) < 0.03:
            continue
        try:
            plan(body.assuming(pelvis_height_m=height))
        except SkillFailure:
            continue
        code = FailureCode.BODY_TOO_HIGH if height < present else FailureCode.BODY_TOO_LOW
        return SkillFailure(code, {"height_m": height - present, "reach_m": gap})
    if not common or not all(body.ik.within(arm, p, present) for arm, p in points.items()):
        return SkillFailure(FailureCode.TOO_FAR, {"reach_m": gap})
    return SkillFailure(FailureCode.OBSTRUCTED, {"gap_m": gap})


def diagnosed(body: Body, points: Mapping[Arm, Array], search: Callable[[Body], T]) -> T:
    """Runs a search; a failure is attributed to distance, height or obstruction, see `diagnose`.

    Raises:
        SkillFailure: TooFar, BodyTooHigh, BodyTooLow or Obstructed.
    """
    try:
        return search(body)
    except SkillFailure:
        raise diagnose(body, points, search) from None


def route(
    body: Body, arm: Arm, start: Array, goal: Array, ignore: Iterable[str | int] = (), opening: float | None = None
) -> tuple[Array, ...] | None:
    """Collision-free via postures between two arm postures: none, or one with the hand drawn in or raised."""
    ignore = tuple(ignore)
    best: tuple[float, tuple[Array, ...]] | None = None
    for via in (None, *body.ik.vias(arm)):
        legs = [(start, goal)] if via is None else [(start, via), (via, goal)]
        worst = 0.0
        for number, (a, b) in enumerate(legs):
            shares = np.linspace(0.0, 1.0, 2 + int(np.max(np.abs(b - a)) / _PATH_STEP_RAD))
            # an arm that touches something at the start may do so until it has come away from it
            relief = np.maximum(1.0 - 3.0 * shares, 0.0) if number == 0 else np.zeros_like(shares)
            depths = body.probe.depths_m(arm, a + shares[:, None] * (b - a), ignore, opening, _SLIDE_M, relief)
            worst = max(worst, float((depths - depths[0] * relief[: len(depths)]).max()))
            if worst > _SLIDE_M:  # how much more does not matter: this way is not taken
                break
        if worst <= _GRAZE_M:
            return () if via is None else (via,)
        if best is None or worst < best[0]:
            best = (worst, () if via is None else (via,))
    return best[1] if best is not None and best[0] <= _SLIDE_M else None


def plan_reach(
    body: Body,
    arm: Arm,
    hand_target: HandPose,
    retreat: Array,
    distance_m: float,
    ignore: Sequence[str | int] = (),
    pointing: float = MIN_POINTING,
    closing: float = MIN_CLOSING,
    opening: float | None = None,
    start: Array | None = None,
) -> Reach | None:
    """A motion to a hand pose that arrives along a straight line, None when there is none.

    Args:
        body: the robot.
        arm: which one.
        hand_target: hand pose at the target, world frame.
        retreat: unit direction from the target back to where the straight line starts.
        distance_m: length of the straight line.
        ignore: ids of objects, or numbers of geoms, that may be touched at the target.
        pointing: cosine demanded of the fingers' direction.
        closing: cosine demanded of the closing direction.
        opening: opening of the hand on the way, None as it is.
        start: (A,) joints near the solution, when they are known.
    """
    if not body.ik.within(arm, hand_target.position, body.posture.pelvis_height_m):
        return None
    at = body.ik.solve(arm, hand_target, start)
    if not fulfils(at, pointing, closing) or not body.probe.free(arm, [at.q], ignore, opening):
        return None
    before = None
    for share in (1.0, 0.6):
        short = HandPose(
            hand_target.position + share * distance_m * retreat,
            hand_target.pointing,
            hand_target.closing,
            hand_target.either_way,
        )
        before = body.ik.solve(arm, short, start=at.q)
        if before.error_m <= 2.0 * REACH_TOLERANCE_M and float(np.max(np.abs(before.q - at.q))) < 1.5:
            break
        before = None
    if before is None:
        return None
    approach = [before.q + share * (at.q - before.q) for share in (0.0, 0.2, 0.4, 0.6, 0.8)]
    if not body.probe.free(arm, approach, ignore, opening):
        return None
    way = route(body, arm, body.arms.commanded(arm), before.q, (), opening)
    return None if way is None else Reach(way, before.q, at.q)
