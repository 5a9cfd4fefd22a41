"""How a skill ends: refused before it moves, by a failure code with its margins, or by success."""

from __future__ import annotations

from collections.abc import Mapping

from interface.actions import first_refusal
from interface.failures import FAILURES, FailureCode
from interface.feedback import ActionOutcome, category_of
from interface.steps import Action
from sim.world.facts import world_facts
from sim.world.world import World


class SkillFailure(Exception):  # noqa: N818  # a failed skill is an outcome, not an error
    """Raised inside a skill to end it with a failure code; the skill runner turns it into an `ActionOutcome`.

    Attributes:
        code: the reason.
        margins: signed quantities that explain it.
        contingency: outcome name when the reason was drawn from a contingency distribution.
    """

    def __init__(self, code: FailureCode, margins: Mapping[str, float] | None = None, contingency: str = "") -> None:
        allowed = FAILURES[code].margins
        unknown = sorted(set(margins or {}) - set(allowed))
        if unknown:
            raise ValueError(f"margins {unknown} do not belong to {code.value}; allowed: {list(allowed)}")
        super().__init__(f"{code.value}: {FAILURES[code].meaning}")
        self.code = code
        self.margins = dict(margins or {})
        self.contingency = contingency


def require(world: World, action: Action) -> None:
    """Refuses an action whose preconditions do not hold.

    Raises:
        SkillFailure: the code of the first one that does not, with its margin.
    """
    refusal = first_refusal(action, world_facts(world))
    if refusal is not None:
        raise SkillFailure(refusal.code, dict(refusal.margins))


def failed(action: Action, failure: SkillFailure) -> ActionOutcome:
    """The outcome of an action that ended with `failure`."""
    return ActionOutcome(
        action=action,
        success=False,
        code=failure.code.value,
        category=category_of(failure.code, action),
        margins={name: round(float(value), 4) for name, value in failure.margins.items()},
        message=FAILURES[failure.code].meaning,
        contingency=failure.contingency,
    )


def succeeded(action: Action) -> ActionOutcome:
    """The outcome of an action whose effect was verified."""
    return ActionOutcome(action=action, success=True)
