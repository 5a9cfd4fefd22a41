"""Runs skills on one clock: one coroutine per action, advanced together once per control tick.

A skill is a generator. Between two `yield`s it reads the world and writes targets of the joints it owns; the runner then lets
physics run for one control tick. Two arm skills therefore act truly in parallel, and each sees what the other does. A skill
ends by returning (success, after it has verified its effect) or by raising `SkillFailure`; its own `finally` or `except` blocks
bring the arm back to a safe posture before that.

Paper: dual-arm parallel execution on a continuous clock.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Sequence
from typing import Final

from interface.failures import FailureCode
from interface.feedback import ActionOutcome
from interface.steps import Action
from sim.skills.failures import SkillFailure, failed, succeeded

#: A coroutine that acts between its yields.
Skill = Generator[None, None, None]

#: Control period, seconds.
CONTROL_DT_S: Final = 0.02

#: A skill that takes longer than this has lost its way, which is a bug: no path or arm motion is this long.
_MAX_TICKS: Final = int(120.0 / CONTROL_DT_S)


class TwoTicks:
    """A condition that counts when it holds twice running: a contact that flickers in the last bits decides nothing."""

    def __init__(self) -> None:
        self._before = False

    def __call__(self, now: bool) -> bool:
        """Whether it holds now and held when it was last asked."""
        both, self._before = now and self._before, now
        return both


def run_skills(skills: Sequence[tuple[Action, Skill]], advance: Callable[[], None]) -> tuple[ActionOutcome, ...]:
    """Advances all skills together until each has ended.

    Args:
        skills: the actions of one plan step with their coroutines, in the order they were asked for.
        advance: runs physics for one control tick.

    Returns:
        One outcome per action, in the same order.

    Raises:
        RuntimeError: when a skill does not end within two simulated minutes.
    """
    outcomes: list[ActionOutcome | None] = [None] * len(skills)
    for _ in range(_MAX_TICKS):
        for index, (action, skill) in enumerate(skills):
            if outcomes[index] is not None:
                continue
            try:
                next(skill)
            except StopIteration:
                outcomes[index] = succeeded(action)
            except SkillFailure as failure:
                outcomes[index] = failed(action, failure)
        finished = [outcome for outcome in outcomes if outcome is not None]
        if len(finished) == len(outcomes):
            return tuple(finished)
        advance()
    running = [action.to_text() for (action, _), outcome in zip(skills, outcomes, strict=True) if outcome is None]
    raise RuntimeError(f"skills did not end within {_MAX_TICKS * CONTROL_DT_S:g} s: {running}")


def refuse(code: FailureCode, margins: dict[str, float] | None = None) -> Skill:
    """A skill that fails at once, for actions that are refused before anything moves."""
    raise SkillFailure(code, margins)
    yield


def wait(seconds: float) -> Skill:
    """Lets physics run."""
    for _ in range(round(seconds / CONTROL_DT_S)):
        yield
