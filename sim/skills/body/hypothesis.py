"""A what-if about the robot: the stance and pelvis height for which a geometric question is asked.

A question about another stance or height is asked of `Body.assuming(...)`, which carries the hypothesis as a value; the body
that was asked does not change, and nothing moves.
"""

from __future__ import annotations

from dataclasses import dataclass

from sim.skills.navigation import Stance


@dataclass(frozen=True, slots=True)
class Hypothesis:
    """What is assumed in place of the commanded posture; the default assumes nothing.

    Attributes:
        stance: where the base is, None as commanded.
        pelvis_height_m: metres above the floor, None as commanded.
        diagnose: whether a refusal says what is wrong, which takes trying other pelvis heights; False answers `Obstructed`.
    """

    stance: Stance | None = None
    pelvis_height_m: float | None = None
    diagnose: bool = True
