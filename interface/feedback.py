"""What the simulator answers to a plan step: one outcome per action."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

from interface.actions import ActionKind
from interface.failures import FAILURES, FailureCategory, FailureCode
from interface.steps import Action


@dataclass(frozen=True, slots=True)
class ActionOutcome:
    """What became of one action.

    Attributes:
        action: the action as it was asked for.
        success: whether its effect was reached in the physics.
        code: failure code of `interface.failures` (for example `TooFar`), `""` on success.
        category: the paper's failure type the code rolls up to, None on success.
        margins: signed quantities that explain the failure (`reach_m`, `height_m`, `mass_kg` …), for traces and analysis.
        message: one readable sentence without numbers about hidden positions.
        contingency: outcome drawn from the contingency distribution when it was not `success` (`slipped`, `broken` …).
    """

    action: Action
    success: bool
    code: str = ""
    category: FailureCategory | None = None
    margins: Mapping[str, float] = field(default_factory=dict)
    message: str = ""
    contingency: str = ""


@dataclass(frozen=True, slots=True)
class Feedback:
    """Result of a plan step: one outcome per action, and the simulated seconds it took."""

    outcomes: tuple[ActionOutcome, ...]
    duration_s: float

    @property
    def success(self) -> bool:
        """Whether every action of the step succeeded."""
        return all(outcome.success for outcome in self.outcomes)

    @property
    def struck(self) -> bool:
        """Whether a contingency spoiled an action of the step; unknown, and so False, once the feedback is public."""
        return any(outcome.contingency for outcome in self.outcomes)

    def public(self) -> Feedback:
        """The feedback without what a planner must not know: margins and the draws of the contingency."""
        return replace(self, outcomes=tuple(replace(outcome, margins={}, contingency="") for outcome in self.outcomes))

    def to_text(self) -> str:
        """What a planner reads: each action with `ok` or its failure code; never a margin."""
        return "; ".join(f"{outcome.action.to_text()} {'ok' if outcome.success else outcome.code}" for outcome in self.outcomes)


def category_of(code: FailureCode, action: Action) -> FailureCategory:
    """The paper's failure type of a code, given the action that met it."""
    category = FAILURES[code].category
    if category is not None:
        return category
    if action.name in ("MoveUp", "MoveDown"):
        return FailureCategory.BODY_ADJUSTMENT
    return FailureCategory.NAVIGATION if action.spec.kind is ActionKind.BODY else FailureCategory.LOGICAL
