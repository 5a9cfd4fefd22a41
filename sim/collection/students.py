"""What a learned planner may do where the expert corrects it (DAgger), in the simulator and in episodes in words alike."""

from __future__ import annotations

from data.interface.observation import HistoryItem
from data.interface.steps import PlanStep

__all__ = ["accepted"]


def accepted(proposed: PlanStep | None, last: HistoryItem | None) -> PlanStep | None:
    """The student's step; None where it names none, ends the episode, or does again what has just failed.

    Args:
        proposed: what the student said.
        last: the newest entry of the log.
    """
    if proposed is None or proposed.actions[0].name == "Done":
        return None
    if last is None or all(outcome.endswith(" ok") for outcome in last.feedback.split("; ")):
        return proposed
    return None if last.step == proposed.to_text() else proposed
