"""Why an episode failed: exactly one of the paper's three failure types per failed episode.

The paper counts failures so that they add up to the failed episodes (Table IV), and does not print the rule. Ours, on the
trace:

1. A failed action is *made good* when the same action (same verb, same object, either arm) succeeds later. The others stand.
2. The last standing failure of an action whose object is part of an unmet goal decides.
3. Without one, the last standing failure of any action decides.
4. Without any, the plan itself was wrong or stopped too early: logical. An invalid reply is a logical failure without an
object.

A failure's own type comes with its code (`sim.failures`): out of reach at every pelvis height is navigation, out of reach at
this pelvis height is body adjustment, the rest is logical.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import Any

from data.records import Action, FailureCategory

__all__ = ["INVALID_OUTPUT", "attribute"]

#: Feedback code of a reply outside the action grammar.
INVALID_OUTPUT = "InvalidOutput"


def attribute(trace: Sequence[Mapping[str, Any]], unmet_objects: Collection[str]) -> FailureCategory:
    """The failure type of a failed episode.

    Args:
        trace: steps as the episode runner writes them; `outcomes` has `action`, `ok`, `code` and `category`.
        unmet_objects: ids named in goals that did not hold at the end.
    """
    done: set[tuple[str, str | None]] = set()
    fallback: FailureCategory | None = None
    for step in reversed(trace):
        for outcome in reversed(step["outcomes"]):
            if outcome["code"] == INVALID_OUTPUT:
                fallback = fallback or FailureCategory.LOGICAL
                continue
            action = Action.parse(outcome["action"])
            key = (action.name, action.object_id)
            if outcome["ok"]:
                done.add(key)
                continue
            if key in done:
                continue
            category = FailureCategory(outcome["category"])
            if action.object_id is not None and action.object_id in unmet_objects:
                return category
            fallback = fallback or category
    return fallback or FailureCategory.LOGICAL
