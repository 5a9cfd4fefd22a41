"""Sizes of the robots' hands, as far as grasp planning needs them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

__all__ = ["HandShape", "hand_shape"]


@dataclass(frozen=True, slots=True)
class HandShape:
    """Size of an open hand around its grasp site (x along the fingers, y the closing direction).

    Attributes:
        behind_m: free distance from the site to what closes from behind (site -y): the palm, or one finger.
        max_radius_m: half the width of the widest object that fits between the fingers.
        tip_m: how far the open fingers reach beyond the site.
        half_width_m: half the hand's width across (site z).
        slope: how the thumb limits the seat: free x per metre of radius, and at radius 0; (0, 0) for parallel fingers.
        pinch_m: distance along y at which half-closed fingertips and thumb meet a surface; None when the fingers are parallel.
        clearance_m: free distance between the object and what closes from behind, on arrival.
        press: the fingertip that presses a switch: x and y in the site's frame, and the opening of the hand for it.
    """

    behind_m: float
    max_radius_m: float
    tip_m: float
    half_width_m: float
    slope: tuple[float, float] = (0.0, 0.0)
    pinch_m: float | None = None
    clearance_m: float = 0.0
    press: tuple[float, float, float] = (0.036, 0.0, 0.0)

    def seat(self, radius_m: float) -> tuple[float, float]:
        """Where the middle of an object of that half width belongs: x and y in the site's frame."""
        forward = self.slope[0] * radius_m + self.slope[1]
        return (max(forward, 0.0), max(radius_m + self.clearance_m - self.behind_m, 0.0))


#: Hands by robot, measured on their MJCF. H1: palm 38 mm behind the site, thumb opposite at a slant. X1: parallel pads.
_HANDS: Final = {
    "h1": HandShape(0.04, 0.055, 0.1, 0.045, slope=(1.9, -0.055), pinch_m=0.011, clearance_m=0.012, press=(0.094, -0.051, 1.0)),
    "x1": HandShape(0.058, 0.054, 0.042, 0.016),
}


def hand_shape(robot_name: str) -> HandShape:
    """The hand of a robot; robots without an entry are taken to have X1's gripper."""
    return _HANDS.get(robot_name, _HANDS["x1"])
