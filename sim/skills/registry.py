"""Skill registry: the skill behind every action, which of them exclude each other, and dry-run assessment."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Final

from interface.actions import exclude_each_other, first_refusal
from interface.failures import FailureCode
from interface.steps import Action, PlanStep
from sim.skills import articulate, holding, locomotion, manipulate, pouring, set_down, tools, two_arm
from sim.skills.body.body import Body
from sim.skills.failures import SkillFailure
from sim.skills.manipulate import OutcomeDraw
from sim.skills.push_door import Push
from sim.skills.runner import Skill, refuse
from sim.world.facts import world_facts


@dataclass(frozen=True, slots=True)
class ArmSkill:
    """A skill of one or both arms.

    Attributes:
        run: carries an action out.
        assess: plans it without moving anything, and refuses what `run` would refuse at once; None when nothing is planned.
    """

    run: Callable[[Body, Action, OutcomeDraw], Skill]
    assess: Callable[[Body, Action], object] | None = None


#: Skills of the base and the legs.
BODY_SKILLS: Final[Mapping[str, Callable[[Body, Action], Skill]]] = {
    "GoTo": locomotion.go_to,
    "MoveAhead": locomotion.move,
    "MoveBack": locomotion.move,
    "MoveLeft": locomotion.move,
    "MoveRight": locomotion.move,
    "RotateLeft": locomotion.rotate,
    "RotateRight": locomotion.rotate,
    "MoveUp": locomotion.change_height,
    "MoveDown": locomotion.change_height,
}

#: Skills of one or both arms.
SKILLS: Final[Mapping[str, ArmSkill]] = {
    "Pick": ArmSkill(manipulate.pick, manipulate.assess_pick),
    "Place": ArmSkill(manipulate.place, manipulate.assess_place),
    "ResetArm": ArmSkill(manipulate.reset_arm),
    "Open": ArmSkill(articulate.open_close, articulate.assess_open_close),
    "Close": ArmSkill(articulate.open_close, articulate.assess_open_close),
    "ToggleOn": ArmSkill(articulate.toggle, articulate.assess_toggle),
    "ToggleOff": ArmSkill(articulate.toggle, articulate.assess_toggle),
    "Hold": ArmSkill(holding.hold, holding.assess_hold),
    "Release": ArmSkill(holding.release),
    "Slice": ArmSkill(tools.slice_object, tools.assess_slice),
    "Clean": ArmSkill(tools.clean, tools.assess_clean),
    "UseUp": ArmSkill(tools.use_up, tools.assess_use_up),
    "Pour": ArmSkill(pouring.pour, pouring.assess_pour),
    "Fill": ArmSkill(pouring.fill, pouring.assess_fill),
    "Lift": ArmSkill(two_arm.lift, two_arm.assess_lift),
    "PlaceBoth": ArmSkill(set_down.place_both, set_down.assess_place_both),
}


def skills_for(body: Body, step: PlanStep, known: frozenset[str], outcome_draw: OutcomeDraw) -> list[tuple[Action, Skill]]:
    """The coroutines of a plan step, in its order; what is refused at once is a coroutine that fails at once."""
    conflict = excludes(body, step, known)
    return [(action, _skill(body, action, conflict, known, outcome_draw)) for action in step.actions]


def _skill(body: Body, action: Action, conflict: bool, known: frozenset[str], outcome_draw: OutcomeDraw) -> Skill:
    if conflict:
        return refuse(FailureCode.ARM_CONFLICT)
    if action.object_id is not None and action.object_id not in known:
        return refuse(FailureCode.OBJECT_NOT_KNOWN)
    if action.name in SKILLS:
        return SKILLS[action.name].run(body, action, outcome_draw)
    refusal = first_refusal(action, world_facts(body.world))
    return BODY_SKILLS[action.name](body, action) if refusal is None else refuse(refusal.code)


def excludes(body: Body, step: PlanStep, known: frozenset[str]) -> bool:
    """Whether two parallel actions exclude each other: both want one object, or one would walk off with the other."""
    if len(step.actions) < 2:
        return False
    return exclude_each_other(*step.actions) or any(_walks(body, action, known) for action in step.actions)


def _walks(body: Body, action: Action, known: frozenset[str]) -> bool:
    """Whether an arm action would move the base to where the other arm does not expect it: pushing a door shut may."""
    if action.name != "Close" or action.object_id not in known:
        return False
    try:
        plan = articulate.assess_open_close(body, action)
    except SkillFailure:
        return False
    return isinstance(plan, Push) and plan.walks


def assess_action(body: Body, action: Action, known: frozenset[str]) -> SkillFailure | None:
    """Dry run: why an action would be refused from here, None when it would be tried. Plans the motion, moves nothing."""
    if action.object_id is not None and action.object_id not in known:
        return SkillFailure(FailureCode.OBJECT_NOT_KNOWN)
    skill = SKILLS.get(action.name)
    if skill is None or skill.assess is None:
        return None
    try:
        skill.assess(body, action)
    except SkillFailure as failure:
        return failure
    return None
