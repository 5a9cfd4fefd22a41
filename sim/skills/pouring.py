"""Pour and Fill: liquids by tilting the vessel in the hand, and by holding it below a tap or a coffee machine.

Pour brings the vessel beside and above the target's opening, turns the hand about its own pointing axis (the last joint of the
arm) until the vessel's axis is past the horizontal as far as the joint goes. The liquid then runs as it does from any tilted
vessel (`sim.world.liquids.run_out`): into what is below the rim, or beside it. Paper: pouring and filling of DualTHOR, there
switches.

Constants were chosen by hand; with them the certificates of the 359 benchmark tasks were made on both robots.
"""

from __future__ import annotations

from typing import Final

import mujoco
import numpy as np
from numpy.typing import NDArray

from interface.bodies import Arm
from interface.facts import FULL_SHARE
from interface.failures import FailureCode
from interface.steps import Action
from sim.scene.objects import ObjectInstance
from sim.skills.body.body import Body
from sim.skills.failures import SkillFailure, require
from sim.skills.manipulate import OutcomeDraw, plan_bring, shift_hand, stow
from sim.skills.plan_cache import cached_plan
from sim.skills.reach import Reach
from sim.skills.runner import CONTROL_DT_S, Skill, wait
from sim.world.facts import world_facts
from sim.world.liquids import STEEP, opening_radius_m

Array = NDArray[np.float64]

#: The least tilt that a pour must reach, and the share of what is poured that may go beside.
_MISSED_SHARE: Final = 0.1
_TILT_RAD: Final = float(np.radians(75.0))
#: Height of the vessel above the opening, and shares of the tilt at which its rim is checked.
_ABOVE_M: Final = 0.04
_TILT_SHARES: Final = (0.4, 0.55, 0.7, 0.85, 1.0)
#: Longest time that a liquid runs.
_LONGEST_S: Final = 20.0
#: How often a vessel is moved under a spout, and how exactly.
_CORRECTIONS: Final = 3
_CENTRED_M: Final = 0.015


def _opening(body: Body, obj: ObjectInstance) -> tuple[Array, float]:
    """(3,) middle of a vessel's opening in the world, and its radius in metres."""
    middle = 0.5 * (obj.local_min + obj.local_max)
    pose = body.world.poses.pose(obj.object_id)
    top = pose[:3, 3] + pose[:3, :3] @ np.array([middle[0], middle[1], obj.local_max[2]])
    return top, opening_radius_m(obj)


@cached_plan
def assess_pour(body: Body, action: Action) -> tuple[Reach, float]:
    """Plans Pour from the present state, without moving: the motion to beside the target, and the turn of the last joint.

    Raises:
        SkillFailure: as the skill would before it moves.
    """
    assert action.arm is not None and action.object_id is not None
    require(body.world, action)
    arm, target = action.arm, body.obj(action.object_id)
    vessel = body.obj(body.hands.held[arm] or "")
    top, radius = _opening(body, target)
    spots = _beside(body, arm, vessel, top, radius)
    names = (vessel.object_id, target.object_id)
    failure: SkillFailure | None = None
    for spot in spots:
        try:
            reach = plan_bring(body, arm, vessel, [spot], names, above_m=_ABOVE_M)[1]
        except SkillFailure as found:
            failure = failure or found
            continue
        for turn in _turns(body, arm, reach.at):
            if _lands(body, arm, vessel, reach.at, turn, top, radius):
                return reach, turn
    raise failure or SkillFailure(FailureCode.OBSTRUCTED)


def _beside(body: Body, arm: Arm, vessel: ObjectInstance, top: Array, radius: float) -> list[Array]:
    """World points for the bottom of the vessel: so far beside that its rim comes over the opening when it is tilted."""
    height = float(vessel.local_max[2] - vessel.local_min[2])
    sight = top[:2] - body.posture.shoulder(arm)[:2]
    across = np.array([-sight[1], sight[0]]) / max(float(np.linalg.norm(sight)), 1e-6)
    outer = 1.0 if arm is Arm.LEFT else -1.0
    spots = []
    for side in (outer, -outer):
        for share in (0.8, 0.5, 1.1):
            offset = side * share * height * across
            spots.append(np.array([top[0] + offset[0], top[1] + offset[1], top[2]]))
    return spots


def _turns(body: Body, arm: Arm, q: Array) -> list[float]:
    """Turns of the last joint that tilt a vessel, the farther one first."""
    name = body.spec.arms[arm.value].joints[-1]
    low, high = map(float, body.world.model.joint(name).range)
    up, down = min(high - 0.02 - q[-1], np.radians(130.0)), max(low + 0.02 - q[-1], -np.radians(130.0))
    return sorted((float(up), float(down)), key=lambda turn: -abs(turn))


def _pose_at(body: Body, arm: Arm, vessel: ObjectInstance, q: Array, turn: float) -> Array:
    """(4, 4) pose of the held vessel for an arm posture with its last joint turned on, from the commanded base."""
    scratch, model = mujoco.MjData(body.world.model), body.world.model
    scratch.qpos[:] = body.world.data.qpos
    offset = np.linalg.inv(body.world.servos.grasp_pose(arm.value)) @ body.world.poses.pose(vessel.object_id)
    for joint, value in zip(body.spec.arms[arm.value].joints, [*q[:-1], q[-1] + turn], strict=True):
        scratch.qpos[model.joint(joint).qposadr[0]] = value
    mujoco.mj_kinematics(model, scratch)
    site = int(model.site(body.spec.arms[arm.value].grasp_site).id)
    hand = np.eye(4)
    hand[:3, :3], hand[:3, 3] = scratch.site_xmat[site].reshape(3, 3), scratch.site_xpos[site]
    return hand @ offset


def _lands(body: Body, arm: Arm, vessel: ObjectInstance, q: Array, turn: float, top: Array, radius: float) -> bool:
    """Whether the vessel gets steep enough, and its rim stays above the opening from where the liquid begins to run."""
    tilt = 0.0
    for share in _TILT_SHARES:
        pose = _pose_at(body, arm, vessel, q, share * turn)
        tilt = float(np.arccos(np.clip(pose[2, 2], -1.0, 1.0)))
        rim = body.world.liquids.rim(vessel, pose)
        if pose[2, 2] < STEEP and (float(np.hypot(*(rim[:2] - top[:2]))) > radius or rim[2] < top[2]):
            return False
    return tilt >= _TILT_RAD


def pour(body: Body, action: Action, outcome_draw: OutcomeDraw) -> Skill:
    """Pour: pours from the vessel in the hand into another one, or into a basin, until the first is empty or the second full.

    Raises:
        SkillFailure: what `assess_pour` refuses, PourMissed when a tenth or more went beside, or a contingency.
    """
    reach, turn = assess_pour(body, action)
    arm = action.arm
    assert arm is not None and action.object_id is not None
    target, vessel = body.obj(action.object_id), body.obj(body.hands.held[arm] or "")
    outcome = outcome_draw(action)
    yield from body.arms.move(arm, [*reach.way, reach.before])
    yield from body.arms.move(arm, [reach.at], speed=0.6)
    tilted = reach.at.copy()
    tilted[-1] += turn
    if outcome != "success":
        body.world.liquids.spill(vessel)
    before, had = target.state.fillLitres, vessel.state.fillLitres
    full = FULL_SHARE * target.type.volume_l
    pouring = body.arms.move(arm, [tilted], speed=0.35)
    for _ in range(int(_LONGEST_S / CONTROL_DT_S)):
        next(pouring, None)  # then the arm stays as it is commanded
        yield
        if vessel.state.fillLitres <= 1e-6 or target.state.fillLitres >= full:
            break
    yield from body.arms.move(arm, [reach.at])
    yield from body.arms.move(arm, [reach.before])
    yield from stow(body, arm, (vessel.object_id,))
    if outcome != "success":
        raise SkillFailure(FailureCode.SPILLED, contingency=outcome)
    poured, came = had - vessel.state.fillLitres, target.state.fillLitres - before
    if came <= 0.0 or poured - came > _MISSED_SHARE * poured:
        raise SkillFailure(FailureCode.POUR_MISSED, {"missed_l": poured - came})


def _outlet(body: Body, object_id: str) -> ObjectInstance:
    """The tap or machine that a liquid comes out of there."""
    return body.obj(world_facts(body.world).objects[object_id].outlet or "")


@cached_plan
def assess_fill(body: Body, action: Action) -> Reach:
    """Plans Fill from the present state, without moving.

    Raises:
        SkillFailure: as the skill would before it moves.
    """
    assert action.arm is not None and action.object_id is not None
    require(body.world, action)
    vessel, outlet = body.obj(body.hands.held[action.arm] or ""), _outlet(body, action.object_id)
    point = body.world.liquids.spout(outlet)
    assert point is not None
    height = float(vessel.local_max[2] - vessel.local_min[2])
    spots = [point - (0.0, 0.0, height + gap) for gap in (0.03, 0.06, 0.01)]
    basin = body.world.room.links.get(outlet.object_id)
    names = tuple(name for name in (vessel.object_id, outlet.object_id, basin) if name is not None)
    aside = body.posture.shoulder(action.arm) - point  # from the front: above it there is the spout
    aside = np.array([aside[0], aside[1], 0.0]) / np.hypot(aside[0], aside[1])
    return plan_bring(body, action.arm, vessel, spots, names, above_m=0.0, coming_from=aside)[1]


def fill(body: Body, action: Action, outcome_draw: OutcomeDraw) -> Skill:
    """Fill: holds the vessel in the hand below a running tap or coffee machine until it is full.

    Raises:
        SkillFailure: what `assess_fill` refuses, PourMissed when nothing gets in, or a contingency.
    """
    reach = assess_fill(body, action)
    arm = action.arm
    assert arm is not None and action.object_id is not None
    vessel, outlet = body.obj(body.hands.held[arm] or ""), _outlet(body, action.object_id)
    outcome = outcome_draw(action)
    before = vessel.state.fillLitres
    yield from body.arms.move(arm, [*reach.way, reach.before])
    yield from body.arms.move(arm, [reach.at], speed=0.6)
    full = FULL_SHARE * vessel.type.volume_l
    for _ in range(_CORRECTIONS):
        yield from wait(0.1)
        point, (top, _) = body.world.liquids.spout(outlet), _opening(body, vessel)
        assert point is not None
        aside = np.array([point[0] - top[0], point[1] - top[1], 0.0])
        if float(np.hypot(aside[0], aside[1])) < _CENTRED_M:
            break
        yield from shift_hand(body, arm, aside)
    for _ in range(int(_LONGEST_S / CONTROL_DT_S)):
        if vessel.state.fillLitres >= full or body.hands.held[arm] != vessel.object_id or outcome == "nothing":
            break
        yield
    if outcome == "spilled":
        body.world.liquids.spill(vessel)
    yield from wait(0.1)
    yield from body.arms.move(arm, [reach.before])
    yield from stow(body, arm, (vessel.object_id,))
    if outcome != "success":
        code = FailureCode.SPILLED if outcome == "spilled" else FailureCode.NOTHING_HAPPENED
        raise SkillFailure(code, contingency=outcome)
    if vessel.state.fillLitres <= before + 1e-6:
        raise SkillFailure(FailureCode.POUR_MISSED)
