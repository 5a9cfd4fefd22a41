"""Which failed action gave a failed episode its type: the rule of `proprio_mllm.evaluation.attribution`, told step by step.

`attribute` gives the type alone, because a ledger needs no more; people who read an episode want to see the action. A test
holds the two together.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from data.records import Action
from proprio_mllm.evaluation.attribution import INVALID_OUTPUT

__all__ = ["Deciding", "deciding_failure"]


@dataclass(frozen=True, slots=True)
class Deciding:
    """The failure that decided.

    Attributes:
        step: index of the step in the trace.
        outcome: index of the action within the step.
        about_goal: whether its object is part of a goal that did not hold at the end; otherwise it is the last standing one.
    """

    step: int
    outcome: int
    about_goal: bool


def deciding_failure(trace: Sequence[Mapping[str, Any]], unmet_objects: Collection[str]) -> Deciding | None:
    """The failure that decided; None when no failure stands, so that the plan itself was wrong or ended too early.

    Args:
        trace: steps of a ledger line.
        unmet_objects: ids named in goals that did not hold at the end.
    """
    done: set[tuple[str, str | None]] = set()
    fallback: Deciding | None = None
    for step in range(len(trace) - 1, -1, -1):
        outcomes = trace[step]["outcomes"]
        for number in range(len(outcomes) - 1, -1, -1):
            outcome = outcomes[number]
            if outcome["code"] == INVALID_OUTPUT:
                fallback = fallback or Deciding(step, number, False)
                continue
            action = Action.parse(outcome["action"])
            key = (action.name, action.object_id)
            if outcome["ok"]:
                done.add(key)
            elif key not in done:
                if action.object_id is not None and action.object_id in unmet_objects:
                    return Deciding(step, number, True)
                fallback = fallback or Deciding(step, number, False)
    return fallback
