"""Logical preconditions of arm skills: what can be refused before anything moves.

Each check raises `SkillFailure` with one code. Their order is part of the contract: the state of the hands first, then what
the object allows, then weight, then access. Reach is found out later, by the skills themselves.
"""

from __future__ import annotations

from data.interface.bodies import Arm
from data.interface.failures import FailureCode
from sim.scene.objects import ObjectInstance
from sim.skills.body.body import Body
from sim.skills.failures import SkillFailure

__all__ = [
    "check_clean",
    "check_fill",
    "check_hold",
    "check_lift",
    "check_open_close",
    "check_pick",
    "check_place",
    "check_place_both",
    "check_pour",
    "check_slice",
    "check_toggle",
    "check_use_up",
]


def _check_accessible(body: Body, thing: ObjectInstance) -> None:
    """Refuses objects that are shut away."""
    for name in body.world.containment.parents(thing.object_id):
        if body.thing(name).is_shut:
            raise SkillFailure(FailureCode.RECEPTACLE_CLOSED)


def _check_free_hand(body: Body, arm: Arm) -> None:
    if body.hands.lifted is not None:
        raise SkillFailure(FailureCode.BOTH_HANDS_BUSY)
    if body.hands.held[arm] is not None:
        raise SkillFailure(FailureCode.HAND_OCCUPIED)


def check_pick(body: Body, arm: Arm, thing: ObjectInstance) -> None:
    """Preconditions of Pick."""
    _check_free_hand(body, arm)
    if thing.held_by:
        raise SkillFailure(FailureCode.ALREADY_HELD)
    if not thing.movable:
        raise SkillFailure(FailureCode.NOT_PICKUPABLE)
    limit = body.spec.arms[arm.value].max_load_kg
    mass = body.world.containment.total_mass_kg(thing.object_id)
    if body.world.containment.needs_two_hands(thing.object_id):
        if mass > body.spec.two_arm_max_load_kg:
            raise SkillFailure(FailureCode.TOO_HEAVY, {"mass_kg": mass - body.spec.two_arm_max_load_kg})
        raise SkillFailure(FailureCode.NEEDS_TWO_HANDS, {"mass_kg": mass - limit})
    if not thing.type.pickupable:
        raise SkillFailure(FailureCode.NOT_PICKUPABLE)
    if thing.is_broken:
        raise SkillFailure(FailureCode.OBJECT_BROKEN)
    _check_accessible(body, thing)


def check_place(body: Body, arm: Arm, receptacle: ObjectInstance) -> ObjectInstance:
    """Preconditions of Place; returns what the hand holds."""
    if body.hands.lifted is not None:
        raise SkillFailure(FailureCode.BOTH_HANDS_BUSY)
    name = body.hands.held[arm]
    if name is None:
        raise SkillFailure(FailureCode.HAND_EMPTY)
    _check_receptacle(body, receptacle, name)
    return body.thing(name)


def _check_receptacle(body: Body, receptacle: ObjectInstance, held: str) -> None:
    if not receptacle.type.receptacle or receptacle.object_id == held:
        raise SkillFailure(FailureCode.NOT_RECEPTACLE)
    if receptacle.held_by and receptacle.movable:  # a hand at a door holds it open
        raise SkillFailure(FailureCode.IN_USE)
    if receptacle.is_shut:
        raise SkillFailure(FailureCode.RECEPTACLE_CLOSED)
    _check_accessible(body, receptacle)


def check_open_close(body: Body, arm: Arm, thing: ObjectInstance, opening: bool) -> None:
    """Preconditions of Open and Close."""
    _check_free_hand(body, arm)
    if not thing.moving:
        raise SkillFailure(FailureCode.NOT_OPENABLE)
    if thing.held_by:
        raise SkillFailure(FailureCode.IN_USE)
    if (thing.openness > 0.6) if opening else (thing.openness < 0.06):
        raise SkillFailure(FailureCode.ALREADY_IN_STATE)


def check_toggle(body: Body, arm: Arm, thing: ObjectInstance, on: bool) -> None:
    """Preconditions of ToggleOn and ToggleOff."""
    _check_free_hand(body, arm)
    if thing.toggle_site < 0:
        raise SkillFailure(FailureCode.NOT_TOGGLEABLE)
    if thing.is_toggled == on:
        raise SkillFailure(FailureCode.ALREADY_IN_STATE)
    if thing.is_broken:
        raise SkillFailure(FailureCode.OBJECT_BROKEN)
    if thing.type.lidded and not thing.is_open:  # the keys of a laptop are below its screen
        raise SkillFailure(FailureCode.OBSTRUCTED)


def _held(body: Body, arm: Arm) -> ObjectInstance:
    """What an arm alone holds and can use."""
    if body.hands.lifted is not None:
        raise SkillFailure(FailureCode.BOTH_HANDS_BUSY)
    name = body.hands.held[arm]
    if name is None:
        raise SkillFailure(FailureCode.HAND_EMPTY)
    return body.thing(name)


def check_hold(body: Body, arm: Arm, thing: ObjectInstance) -> None:
    """Preconditions of Hold."""
    if thing.movable:
        check_pick(body, arm, thing)
        return
    _check_free_hand(body, arm)
    if not thing.moving:
        raise SkillFailure(FailureCode.NOT_PICKUPABLE)
    if thing.held_by:
        raise SkillFailure(FailureCode.ALREADY_HELD)


def _check_steady(body: Body, arm: Arm, thing: ObjectInstance) -> None:
    """Refuses to work on what would roll or slide away, unless the other hand holds it where it rests."""
    if thing.type.has("unsteady") and not (
        arm.other.value in thing.held_by and body.world.containment.parents(thing.object_id)
    ):
        raise SkillFailure(FailureCode.NEEDS_STEADYING)


def check_slice(body: Body, arm: Arm, thing: ObjectInstance) -> ObjectInstance:
    """Preconditions of Slice; returns the knife."""
    tool = _held(body, arm)
    if not tool.type.has("cutter"):
        raise SkillFailure(FailureCode.NEEDS_TOOL)
    if not thing.type.has("sliceable"):
        raise SkillFailure(FailureCode.NOT_SLICEABLE)
    if thing.state.isSliced:
        raise SkillFailure(FailureCode.ALREADY_IN_STATE)
    if arm.value in thing.held_by:
        raise SkillFailure(FailureCode.IN_USE)
    _check_accessible(body, thing)
    _check_steady(body, arm, thing)
    return tool


def check_clean(body: Body, arm: Arm, thing: ObjectInstance) -> ObjectInstance:
    """Preconditions of Clean; returns the sponge or towel."""
    tool = _held(body, arm)
    if not tool.type.has("wiper"):
        raise SkillFailure(FailureCode.NEEDS_TOOL)
    spilled = any(puddle.surface == thing.object_id for puddle in body.world.liquids.puddles)
    if not thing.state.isDirty and not spilled:
        raise SkillFailure(FailureCode.NOT_DIRTY)
    if thing is tool:
        raise SkillFailure(FailureCode.IN_USE)
    _check_accessible(body, thing)
    _check_steady(body, arm, thing)
    return tool


def check_use_up(body: Body, arm: Arm, thing: ObjectInstance) -> None:
    """Preconditions of UseUp."""
    _check_free_hand(body, arm)
    if not thing.type.has("used_up"):
        raise SkillFailure(FailureCode.NOT_USABLE)
    if thing.state.isUsedUp:
        raise SkillFailure(FailureCode.ALREADY_IN_STATE)
    _check_accessible(body, thing)


def check_pour(body: Body, arm: Arm, target: ObjectInstance) -> ObjectInstance:
    """Preconditions of Pour; returns the vessel that is poured from."""
    vessel = _held(body, arm)
    if not (vessel.movable and vessel.type.fillable):
        raise SkillFailure(FailureCode.NEEDS_TOOL)
    if vessel.state.fillLitres <= 0.0:
        raise SkillFailure(FailureCode.EMPTY)
    if not target.type.fillable or target is vessel:
        raise SkillFailure(FailureCode.NOT_FILLABLE)
    if target.is_broken:
        raise SkillFailure(FailureCode.OBJECT_BROKEN)
    if arm.other.value in target.held_by:
        raise SkillFailure(FailureCode.IN_USE)
    if target.state.fillLitres >= 0.999 * target.type.volume_l:
        raise SkillFailure(FailureCode.ALREADY_IN_STATE)
    _check_accessible(body, target)
    return vessel


def check_fill(body: Body, arm: Arm, source: ObjectInstance) -> tuple[ObjectInstance, ObjectInstance]:
    """Preconditions of Fill; returns the vessel and what the liquid comes out of: a tap for its basin, or the source itself."""
    vessel = _held(body, arm)
    if not (vessel.movable and vessel.type.fillable):
        raise SkillFailure(FailureCode.NEEDS_TOOL)
    if vessel.is_broken:
        raise SkillFailure(FailureCode.OBJECT_BROKEN)
    if vessel.state.fillLitres >= 0.999 * vessel.type.volume_l:
        raise SkillFailure(FailureCode.ALREADY_IN_STATE)
    taps = [name for name, basin in body.world.room.links.items() if basin == source.object_id]
    outlet = body.thing(taps[0]) if taps and body.world.liquids.spout(source) is None else source
    if body.world.liquids.spout(outlet) is None:
        raise SkillFailure(FailureCode.NOT_FILLABLE)
    if not outlet.is_toggled:
        raise SkillFailure(FailureCode.SOURCE_OFF)
    return vessel, outlet


def check_lift(body: Body, thing: ObjectInstance) -> None:
    """Preconditions of Lift."""
    if body.hands.lifted is not None:
        raise SkillFailure(FailureCode.BOTH_HANDS_BUSY)
    if any(name is not None for name in body.hands.held.values()):
        raise SkillFailure(FailureCode.HAND_OCCUPIED)
    if not thing.movable:
        raise SkillFailure(FailureCode.NOT_LIFTABLE)
    mass = body.world.containment.total_mass_kg(thing.object_id)
    if mass > body.spec.two_arm_max_load_kg:
        raise SkillFailure(FailureCode.TOO_HEAVY, {"mass_kg": mass - body.spec.two_arm_max_load_kg})
    if not body.world.containment.needs_two_hands(thing.object_id) and max(thing.type.size[:2]) < 0.2:
        raise SkillFailure(FailureCode.NOT_LIFTABLE)
    _check_accessible(body, thing)


def check_place_both(body: Body, receptacle: ObjectInstance) -> ObjectInstance:
    """Preconditions of PlaceBoth; returns what both hands hold."""
    name = body.hands.lifted
    if name is None:
        raise SkillFailure(FailureCode.HAND_EMPTY)
    _check_receptacle(body, receptacle, name)
    return body.thing(name)
