"""Failure codes and margins in words, for people who read an episode.

Margins are signed and named as `interface.failures` says.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Final

from interface.failures import FAILURES, FailureCode


def code_in_words(code: str) -> str:
    """What a failure code means; a code that the simulator does not have stands for itself."""
    return FAILURES[FailureCode(code)].meaning if code in set(FailureCode) else code


def _metres(value: float) -> str:
    return f"{abs(value):.2f} m"


def _height(robot: str, code: str, value: float) -> str:
    if code == FailureCode.HEIGHT_LIMIT:
        return f"{robot}'s legs could not do the last {_metres(value)} {'down' if value < 0 else 'up'}"
    return f"{robot}'s pelvis is {_metres(value)} too {'high' if value < 0 else 'low'}"


def _reach(robot: str, code: str, value: float) -> str:
    if value <= 0:
        return f"the target is within {robot}'s reach by {_metres(value)}"
    return f"the target is {_metres(value)} beyond {robot}'s reach"


def _gap(robot: str, code: str, value: float) -> str:
    if code == FailureCode.HANDLE_SLIPPED:
        return f"the joint stands at {100 * value:.0f} % of its range"
    return f"{_metres(value)} between {robot}'s hand or load and where it should be"


#: A sentence per margin: robot, failure code and value to text.
_SENTENCES: Final[Mapping[str, Callable[[str, str, float], str]]] = {
    "height_m": _height,
    "reach_m": _reach,
    "gap_m": _gap,
    "travel_m": lambda robot, code, value: f"{robot} could go {_metres(value)} before it was blocked",
    "tilt_deg": lambda robot, code, value: f"it leans by {value:.0f} degrees",
    "mass_kg": lambda robot, code, value: f"{abs(value):.2f} kg {'above' if value > 0 else 'below'} what {robot} carries so",
    "missed_l": lambda robot, code, value: f"{abs(value):.2f} l went beside it",
}


def margins_in_words(robot: str, code: str, margins: Mapping[str, float]) -> list[str]:
    """A sentence per margin with its name and signed value: `X1's pelvis is 0.12 m too high (height_m -0.12)`."""
    said = []
    for name, value in margins.items():
        raw = f"{name} {value:+.3g}"
        said.append(f"{_SENTENCES[name](robot.upper(), code, value)} ({raw})" if name in _SENTENCES else raw)
    return said
