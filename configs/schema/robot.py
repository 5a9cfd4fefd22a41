"""Frozen configuration of the robot of a run: which robot, and which description of it."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class RobotConfig:
    """Which robot is used.

    Attributes:
        name: name in commands, tables and file names.
        spec: path of the robot's YAML description (`robots/README.md`); None takes the built-in description of that name.
        mjcf: path of an MJCF file that replaces the description's own, for example one with the vendor's meshes; its joint,
            body and site names must be the ones that the description uses.
    """

    name: str
    spec: str | None = None
    mjcf: str | None = None

    def __post_init__(self) -> None:
        if not self.name.isidentifier():
            raise ValueError(f"robot name {self.name!r} must be an identifier (letters, digits, _)")
