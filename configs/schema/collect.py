"""Frozen configuration of data collection in the simulator (`python -m sim collect`)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal

#: Rooms of training tasks and views: of every kind one room is kept back.
TRAIN_ROOMS: Final = ("kitchen_1", "kitchen_2", "living_room_1", "living_room_2", "bedroom_1", "bathroom_1")


@dataclass(frozen=True)
class CollectConfig:
    """What is collected, how much, and where it goes.

    Attributes:
        kind: `views` (posed views) or `demos` (expert steps).
        out: shard folder.
        count: views, or episodes.
        robots: robots in turn.
        rooms: rooms in turn.
        seed: every draw is keyed by it.
        image_size: rows and columns of the head camera's pictures.
        part_size: views or episodes per part file.
        workers: processes; 1 stays in this one.
        views_per_world: views drawn from one arrangement of objects.
        noise: demos: probability that a perturbed step is executed in place of the expert's, whose choice is recorded.
        chance_share: demos: share of episodes in which skills fail by chance, one in three of them at `hard`, the others at
            `medium`, so that recoveries appear.
        foreseen: lessons: whether the right step is the one that the reach test foresees (`sim.collection.demonstrations`).
    """

    kind: Literal["views", "demos"]
    out: str
    count: int
    robots: tuple[str, ...] = ("h1", "x1")
    rooms: tuple[str, ...] = TRAIN_ROOMS
    seed: int = 0
    image_size: int = 112
    part_size: int = 240
    workers: int = 1
    views_per_world: int = 48
    noise: float = 0.2
    chance_share: float = 0.3
    foreseen: bool = False

    def __post_init__(self) -> None:
        for name in ("count", "image_size", "part_size", "workers", "views_per_world"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, got {getattr(self, name)}")
        for name in ("noise", "chance_share"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise ValueError(f"{name} must be within [0, 1], got {getattr(self, name)}")
        if not self.robots or not self.rooms:
            raise ValueError(f"robots and rooms must not be empty, got {self.robots} and {self.rooms}")

    def indices(self, part: int) -> range:
        """Numbers of the views or episodes of one part."""
        first = part * self.part_size
        return range(first, min(first + self.part_size, self.count))
