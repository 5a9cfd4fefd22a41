"""Why an episode failed: exactly one of the paper's three failure types per failed episode.

The paper counts failures so that they add up to the failed episodes (Table IV), and does not print the rule. Ours, on the
trace:

1. A failed action *stands* unless it is made good later. An action on an object is made good when the same verb on the same
   object succeeds, with either arm; Place and PlaceBoth also need the same load. GoTo is made good by any success on its object
   as well. What names no object (a step in a direction, a change of height, an invalid reply) is made good by whatever gets
   the robot further: a GoTo or an arm action that succeeds, or the same verb.
2. Standing failures are about the task when they name no object, or when their object or load is part of an unmet goal: named
   in it, or the receptacle that such an object started in. If there are any, only they count.
3. The type that most of them have decides, in a tie the type of the last one.
4. Without any standing failure the plan itself was wrong or stopped too early: logical.

A failure's own type comes with its code (`interface.failures`): out of reach at every pelvis height is navigation, out of
reach at this pelvis height is body adjustment, the rest is logical, invalid replies included.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, Literal

from interface.actions import ActionKind
from interface.effects import Grasp, LetGo, PutDown
from interface.failures import INVALID_OUTPUT, FailureCategory, FailureCode
from interface.steps import Action

if TYPE_CHECKING:
    from sim.tasks.task import Task

#: Codes with which the hand has lost what it was to put down.
_LOST: Final = (FailureCode.DROPPED, FailureCode.PLACE_MISSED, FailureCode.SLIPPED, FailureCode.BROKE)


@dataclass(frozen=True, slots=True)
class Deciding:
    """The failure that gave a failed episode its type: the last one of that type that counts.

    Attributes:
        step: index of the step in the trace.
        outcome: index of the action within the step.
        about: `goal` when its object or load is part of an unmet goal, `nothing` when it names no object, else `other`.
        category: its type.
    """

    step: int
    outcome: int
    about: Literal["goal", "nothing", "other"]
    category: FailureCategory


def attribute(trace: Sequence[Mapping[str, Any]], unmet: Collection[str]) -> FailureCategory:
    """The failure type of a failed episode.

    Args:
        trace: steps as the episode runner writes them; `outcomes` has `action`, `ok`, `code` and `category`.
        unmet: ids that unmet goals are about, see `unmet_objects`.
    """
    found = deciding_failure(trace, unmet)
    return FailureCategory.LOGICAL if found is None else found.category


def deciding_failure(trace: Sequence[Mapping[str, Any]], unmet: Collection[str]) -> Deciding | None:
    """The failure that decided; None when none stands. Arguments as for `attribute`."""
    standing = _standing(trace, unmet)
    counted = [failure for failure in standing if failure.about != "other"] or standing
    if not counted:
        return None
    votes = Counter(failure.category for failure in counted)
    most = max(votes.values())
    return next(failure for failure in reversed(counted) if votes[failure.category] == most)


def unmet_objects(task: Task, met: Sequence[bool]) -> frozenset[str]:
    """Ids that a task's unmet goals are about: what they name, and the receptacles that these objects started in.

    Args:
        task: the task.
        met: whether each of its goals held at the end.
    """
    ids = tuple(placement.object_id for placement in task.placements)
    named = {name for goal, holds in zip(task.goals, met, strict=True) if not holds for name in goal.involved(ids)}
    return frozenset(named | {placement.receptacle for placement in task.placements if placement.object_id in named})


def _standing(trace: Sequence[Mapping[str, Any]], unmet: Collection[str]) -> list[Deciding]:
    """Failures that were not made good, oldest first."""
    loads = _loads(trace)
    done: set[tuple[str, str | None, str | None]] = set()  # what succeeded later
    reached: set[str] = set()  # objects on which something succeeded later
    further = False  # whether the robot got further later
    found: list[Deciding] = []
    for step in range(len(trace) - 1, -1, -1):
        outcomes = trace[step]["outcomes"]
        for number in range(len(outcomes) - 1, -1, -1):
            outcome = outcomes[number]
            category = FailureCategory(outcome["category"] or FailureCategory.LOGICAL)
            if outcome["code"] == INVALID_OUTPUT:
                if not further:
                    found.append(Deciding(step, number, "nothing", category))
                continue
            action, load = Action.parse(outcome["action"]), loads.get((step, number))
            key = (action.name, action.object_id, load)
            if outcome["ok"]:
                done.add(key)
                reached.update(() if action.object_id is None else (action.object_id,))
                further = further or action.name == "GoTo" or action.spec.kind in (ActionKind.ARM, ActionKind.TWO_ARM)
            elif key in done or (action.name == "GoTo" and action.object_id in reached):
                continue
            elif action.object_id is None:
                if not further:
                    found.append(Deciding(step, number, "nothing", category))
            else:
                about = "goal" if {action.object_id, load} & set(unmet) else "other"
                found.append(Deciding(step, number, about, category))
    return found[::-1]


def _loads(trace: Sequence[Mapping[str, Any]]) -> dict[tuple[int, int], str]:
    """What was to be put down by each action that puts down, by step and action; a hand is believed to keep what it took."""
    held: dict[str, str] = {}  # by arm, `both` for what is lifted
    found: dict[tuple[int, int], str] = {}
    for step, entry in enumerate(trace):
        for number, outcome in enumerate(entry["outcomes"]):
            if outcome["code"] == INVALID_OUTPUT:
                continue
            action = Action.parse(outcome["action"])
            hand = "both" if action.arm is None else action.arm.value
            if action.spec.has_effect(Grasp) and outcome["ok"]:
                held = {other: item for other, item in held.items() if item != action.object_id}
                held[hand] = action.object_id or ""
            elif action.spec.has_effect(PutDown) and hand in held:
                found[step, number] = held[hand]
            if action.spec.has_effect(PutDown, LetGo) and (outcome["ok"] or outcome["code"] in _LOST):
                held.pop(hand, None)
    return found
