"""Which skill an action is, whether two of them may run together, and what an action would meet without doing it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Final

from data.interface.failures import FailureCode
from data.interface.steps import Action, PlanStep
from sim.skills import articulate, holding, locomotion, manipulate, pouring, set_down, tools, two_arm
from sim.skills.body.body import Body
from sim.skills.failures import SkillFailure
from sim.skills.manipulate import OutcomeDraw
from sim.skills.push import Push
from sim.skills.runner import Skill, refuse

__all__ = ["ARM_SKILLS", "BODY_SKILLS", "assess_action", "excludes", "skills_for"]

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
ARM_SKILLS: Final[Mapping[str, Callable[[Body, Action, OutcomeDraw], Skill]]] = {
    "Pick": manipulate.pick,
    "Place": manipulate.place,
    "ResetArm": manipulate.reset_arm,
    "Open": articulate.open_close,
    "Close": articulate.open_close,
    "ToggleOn": articulate.toggle,
    "ToggleOff": articulate.toggle,
    "Hold": holding.hold,
    "Release": holding.release,
    "Slice": tools.slice_object,
    "Clean": tools.clean,
    "UseUp": tools.use_up,
    "Pour": pouring.pour,
    "Fill": pouring.fill,
    "Lift": two_arm.lift,
    "PlaceBoth": set_down.place_both,
}


def skills_for(body: Body, step: PlanStep, known: frozenset[str], outcome_draw: OutcomeDraw) -> list[tuple[Action, Skill]]:
    """The coroutines of a plan step, in its order; what is refused at once is a coroutine that fails at once."""
    conflict = excludes(body, step, known)
    skills: list[tuple[Action, Skill]] = []
    for action in step.actions:
        if conflict:
            skills.append((action, refuse(FailureCode.ARM_CONFLICT)))
        elif action.object_id is not None and action.object_id not in known:
            skills.append((action, refuse(FailureCode.OBJECT_NOT_KNOWN)))
        elif action.name in BODY_SKILLS and body.hands.at_furniture():
            skills.append((action, refuse(FailureCode.IN_USE)))
        elif action.name in BODY_SKILLS:
            skills.append((action, BODY_SKILLS[action.name](body, action)))
        else:
            skills.append((action, ARM_SKILLS[action.name](body, action, outcome_draw)))
    return skills


def excludes(body: Body, step: PlanStep, known: frozenset[str]) -> bool:
    """Whether two parallel actions exclude each other: both want one object, or one would walk off with the other."""
    return _conflict(step) or (len(step.actions) == 2 and any(_walks(body, action, known) for action in step.actions))


def _walks(body: Body, action: Action, known: frozenset[str]) -> bool:
    """Whether an arm action would move the base to where the other arm does not expect it."""
    if action.name != "Close" or action.object_id not in known:
        return False
    try:
        plan = articulate.assess_open_close(body, action)
    except SkillFailure:
        return False
    return isinstance(plan, Push) and plan.walks


def _conflict(step: PlanStep) -> bool:
    """Whether two parallel actions want the same object, other than both putting something into one receptacle."""
    if len(step.actions) < 2:
        return False
    first, second = step.actions
    same = first.object_id is not None and first.object_id == second.object_id
    if {first.name, second.name} & {"Hold"} and {first.name, second.name} & {"Slice", "Clean", "Pour"}:
        return False
    return same and not (first.name == second.name == "Place")


def assess_action(body: Body, action: Action, known: frozenset[str]) -> SkillFailure | None:
    """Why an action would be refused from here, None when it would be tried; plans the arm's motion but moves nothing."""
    if action.object_id is not None and action.object_id not in known:
        return SkillFailure(FailureCode.OBJECT_NOT_KNOWN)
    planners: Mapping[str, Callable[[Body, Action], object]] = {
        "Pick": manipulate.assess_pick,
        "Place": manipulate.assess_place,
        "Open": articulate.assess_open_close,
        "Close": articulate.assess_open_close,
        "ToggleOn": articulate.assess_toggle,
        "ToggleOff": articulate.assess_toggle,
        "Hold": holding.assess_hold,
        "Slice": tools.assess_slice,
        "Clean": tools.assess_clean,
        "UseUp": tools.assess_use_up,
        "Pour": pouring.assess_pour,
        "Fill": pouring.assess_fill,
        "Lift": two_arm.assess_lift,
        "PlaceBoth": set_down.assess_place_both,
    }
    if action.name not in planners:
        return None
    try:
        planners[action.name](body, action)
    except SkillFailure as failure:
        return failure
    return None
