"""PlaceBoth: both hands carry their load over the edge of a receptacle and put it down.

A load that is carried lower than the receptacle's top comes straight up first, then passes over the edge, then comes down. How
high it passes, and past what, is asked of a copy of the simulator's state; where the arms do not raise it as far, another
pelvis height is asked for. Paper: dual-arm essential tasks.

World frame, metres, radians; poses are (4, 4).

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
from sim.skills.body.clearance import TOUCH_M
from sim.skills.body.ik import BothGoal
from sim.skills.failures import SkillFailure, require
from sim.skills.manipulate import OutcomeDraw, set_down, upright
from sim.skills.plan_cache import cached_plan
from sim.skills.reach import diagnose
from sim.skills.reach_map import HandPose
from sim.skills.runner import Skill, TwoTicks, wait
from sim.skills.two_arm import BOTH_TOLERANCE_M, against_sag, hands_m, way_round

Array = NDArray[np.float64]
_UP: Final = np.array([0.0, 0.0, 1.0])
#: Heights above its spot at which a load passes over the receptacle's edge, tried in turn, and the least of it that counts as
#: over the edge already.
_OVER_M: Final = (0.07, 0.15, 0.25)
_EDGE_M: Final = 0.03
#: How much higher it is raised than that, tried in turn: a load that leans reaches farther down.
_EXTRA_M: Final = (0.02, 0.08, -0.02)
#: How much a load may lean more than it is meant to while it is raised, and lean when it is put down as it is held.
_LEANING_RAD: Final = 0.5
#: How deep a load may run into what is on its way over the receptacle.
_SHOVE_M: Final = 0.03
#: Distance between the places of a load that are asked on its way.
_SWEEP_M: Final = 0.03


@dataclass(frozen=True, slots=True)
class BothPlacement:
    """A motion of both hands with a load: straight up, above the spot, and at it.

    Attributes:
        surface_m: height of the spot.
        raised: the load high enough to pass over the receptacle's edge; None where it is already and the arms do not go higher.
        above: over the spot.
        at: on the spot.
    """

    surface_m: float
    raised: BothGoal | None
    above: BothGoal
    at: BothGoal


@cached_plan
def assess_place_both(body: Body, action: Action) -> BothPlacement:
    """Plans PlaceBoth from the present state, without moving.

    Raises:
        SkillFailure: as PlaceBoth would before it moves.
    """
    assert action.object_id is not None
    require(body.world, action)
    receptacle, obj = body.obj(action.object_id), body.obj(body.hands.lifted or "")
    spots = body.workspace.free_spots(obj, receptacle, None)
    if not spots:
        raise SkillFailure(FailureCode.RECEPTACLE_FULL)
    load = _Load.of(body, obj)
    heights = [_height_over(body, load, spot) for spot in spots]
    carried_m = body.ik.hand_height(_hold(body))

    def search(body: Body) -> BothPlacement:
        higher_m = body.ik.hand_height(_hold(body)) - carried_m  # the load comes along with the pelvis
        for spot, over_m in zip(spots, heights, strict=True):
            if over_m is None:
                continue
            at = body.ik.solve_both(load.hands(load.above(spot + 0.004 * _UP)), body.arms.commanded_both())
            above = body.ik.solve_both(load.hands(load.above(spot + over_m * _UP)), at.arms)
            over = load.bottom_m + higher_m > spot[2] + _EDGE_M
            if at.error_m > BOTH_TOLERANCE_M or above.error_m > 1.5 * BOTH_TOLERANCE_M:
                continue
            if load.sunk_m(above.tilt_rad) > over_m:  # it would lean into the edge
                continue
            level_m = float(spot[2]) + over_m
            raised = _raised(body, load, level_m, higher_m, np.inf if over else _LEANING_RAD)
            if over or raised is not None:
                return BothPlacement(float(spot[2]), raised, above, at)
        raise SkillFailure(FailureCode.OBSTRUCTED)

    try:
        return search(body)
    except SkillFailure:
        way = load.above(spots[0])[:3, 3] - load.turned_in_world[:3, 3]
        raise diagnose(body, {arm: body.arms.hand_pose(arm)[0] + way for arm in Arm}, search) from None


def _hold(body: Body) -> BothGoal:
    """The posture that is commanded."""
    return BothGoal(body.arms.commanded_both(), body.arms.commanded_waist(), 0.0)


@dataclass(frozen=True, slots=True)
class _Load:
    """What both hands hold, moved with them as one rigid piece; poses are (4, 4), world frame.

    Attributes:
        obj: the object.
        object_in_world: where it is.
        turned_in_world: as it is put down: as it is, or turned upright between the hands where it leans too much for that.
        hands_in_object: per arm.
        sole_m: how far its lowest point is below its origin as it is put down.
        bottom_m: height of its lowest point now.
    """

    obj: ObjectInstance
    object_in_world: Array
    turned_in_world: Array
    hands_in_object: Mapping[Arm, Array]
    sole_m: float
    bottom_m: float

    @classmethod
    def of(cls, body: Body, obj: ObjectInstance) -> _Load:
        """What is held now."""
        object_in_world = body.world.poses.pose(obj.object_id)
        hands_in_world = {arm: _pose(*body.arms.hand_pose(arm)) for arm in Arm}
        bottom_m = float(body.world.poses.bounds(obj.object_id)[0][2])
        turned_in_world, sole_m = object_in_world, float(object_in_world[2, 3]) - bottom_m
        if float(np.arccos(np.clip(object_in_world[2, 2], -1.0, 1.0))) > _LEANING_RAD:
            middle = 0.5 * (hands_in_world[Arm.LEFT][:3, 3] + hands_in_world[Arm.RIGHT][:3, 3])
            turn = upright(object_in_world[:3, :3])
            turned_in_world = _pose(middle + turn @ (object_in_world[:3, 3] - middle), turn @ object_in_world[:3, :3])
            sole_m = -float(obj.local_min[2])
        world_in_object = np.linalg.inv(object_in_world)
        hands_in_object = {arm: world_in_object @ hand for arm, hand in hands_in_world.items()}
        return cls(obj, object_in_world, turned_in_world, hands_in_object, sole_m, bottom_m)

    def hands(self, object_in_world: Array) -> dict[Arm, HandPose]:
        """Where the hands are, world frame, when the object is at a pose."""
        found = {arm: object_in_world @ hand for arm, hand in self.hands_in_object.items()}
        return {arm: HandPose(hand[:3, 3], hand[:3, 0], hand[:3, 1]) for arm, hand in found.items()}

    def above(self, point: Array) -> Array:
        """The object's pose with its lowest point at the height of a point (3,) and its origin over it."""
        return _pose(point + self.sole_m * _UP, self.turned_in_world[:3, :3])

    def sunk_m(self, tilt_rad: float) -> float:
        """How much lower its lowest point is when it leans ahead or back between the hands."""
        held_m = float(np.mean([hand[2, 3] for hand in self.hands_in_object.values()])) - float(self.obj.local_min[2])
        depth_m = float(np.min((self.obj.local_max - self.obj.local_min)[:2]))
        return max(0.0, 0.5 * depth_m * float(np.sin(tilt_rad)) - held_m * (1.0 - float(np.cos(tilt_rad))))


def _pose(position: Array, rotation: Array) -> Array:
    """(4, 4) of a position and a rotation."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, position
    return pose


def _raised(body: Body, load: _Load, level_m: float, higher_m: float, lean_rad: float) -> BothGoal | None:
    """Both hands straight up until a load's lowest point is at a level, None where the arms cannot, or tilt it too much.

    Args:
        body: the robot.
        load: what the hands hold.
        level_m: where the lowest point has to be, world frame.
        higher_m: how much higher the load comes with the pelvis height under consideration.
        lean_rad: how much it may lean more than it is meant to; without a bound nothing depends on the raise.
    """
    present_m = float(load.turned_in_world[2, 3]) - load.sole_m + higher_m
    for extra_m in _EXTRA_M:
        bottom_m = max(level_m, present_m) + extra_m
        goal = body.ik.solve_both(
            load.hands(load.above(np.array([*load.turned_in_world[:2, 3], bottom_m]))), body.arms.commanded_both()
        )
        if goal.error_m > BOTH_TOLERANCE_M or goal.tilt_rad > lean_rad:
            continue
        if np.isinf(lean_rad) or bottom_m - load.sunk_m(goal.tilt_rad) >= level_m - _EDGE_M:
            return goal
    return None


def _height_over(body: Body, load: _Load, spot: Array) -> float | None:
    """How high above a spot the load passes over what is before it, None where there is something on every way."""
    for over_m in _OVER_M:
        end = load.above(spot + over_m * _UP)
        top, start = load.turned_in_world.copy(), load.object_in_world.copy()
        top[2, 3] = max(end[2, 3], top[2, 3])
        start[2, 3] += top[2, 3] - load.turned_in_world[2, 3]
        up = body.probe.load_depths_m(load.obj, _between(load.object_in_world, start))
        across = body.probe.load_depths_m(load.obj, _between(top, end))
        if max(up) <= max(up[0], TOUCH_M) and max(across) <= _SHOVE_M:
            return over_m
    return None


def _between(start: Array, end: Array) -> list[Array]:
    """Poses (4, 4) on a straight line, a few centimetres apart, turned like the start."""
    way = end[:3, 3] - start[:3, 3]
    count = 2 + int(np.linalg.norm(way) / _SWEEP_M)
    return [_pose(start[:3, 3] + share * way, start[:3, :3]) for share in np.linspace(0.0, 1.0, count)]


def _under_m(body: Body, obj: ObjectInstance, placement: BothPlacement) -> float:
    """How far a load's lowest point is below the surface that it is brought to, negative above it."""
    return placement.surface_m - float(body.world.poses.bounds(obj.object_id)[0][2])


def place_both(body: Body, action: Action, outcome_draw: OutcomeDraw) -> Skill:
    """PlaceBoth: puts down what both hands hold, straight up first and then over the receptacle's edge.

    Raises:
        SkillFailure: what `assess_place_both` refuses, BodyTooLow where the arms give way below the edge, PlaceMissed, or a
            contingency.
    """
    placement = assess_place_both(body, action)
    assert action.object_id is not None
    obj, receptacle = body.obj(body.hands.lifted or ""), body.obj(action.object_id)
    hold, first = _hold(body), []
    if placement.raised is not None:
        first = [placement.raised]
        yield from body.arms.move_both(first, speed=0.6)
        yield from wait(0.1)
        if _under_m(body, obj, placement) > -_EDGE_M:
            higher = against_sag(body, body.ik.hand_height(placement.raised) - hands_m(body))
            if higher is not None:
                first = [higher]
                yield from body.arms.move_both(first, speed=0.5)
        under_m = _under_m(body, obj, placement)
        if under_m > 0.0:
            yield from body.arms.move_both([hold], speed=0.6)
            raise SkillFailure(FailureCode.BODY_TOO_LOW, {"height_m": under_m + _EDGE_M})
    yield from body.arms.move_both([placement.above], speed=0.6)
    outcome = outcome_draw(action)
    if outcome != "success":
        yield from body.arms.move_both([*first, hold], speed=0.6)
        raise SkillFailure(FailureCode.NOTHING_HAPPENED, contingency=outcome)
    rests = TwoTicks()
    for _ in body.arms.move_both([placement.at], speed=0.4):
        yield
        if rests(body.contacts.rests(obj)):
            body.arms.hold(Arm)
            break
    yield from wait(0.1)
    for arm in Arm:
        body.world.grasps.detach(arm.value)
    hand_targets = {}
    outward = body.posture.turn_to_world(np.array([0.0, 1.0, 0.0]))
    for arm, sign in ((Arm.LEFT, 1.0), (Arm.RIGHT, -1.0)):
        position, hand = body.arms.hand_pose(arm)
        hand_targets[arm] = HandPose(position + sign * 0.09 * outward + 0.01 * _UP, hand[:, 0], hand[:, 1])
    apart = body.ik.solve_both(hand_targets, body.arms.commanded_both())
    yield from body.arms.move_both([apart], speed=0.6)
    ready = body.arms.ready_both()
    way = way_round(body, ready)  # past the load, not across it; an arm that would press on it stays there
    home = {arm: q if body.probe.free(arm, [q], opening=1.0) else way.arms[arm] for arm, q in ready.arms.items()}
    yield from body.arms.move_both([way, BothGoal(home, ready.waist, 0.0)])
    yield from set_down(body, obj, receptacle)
