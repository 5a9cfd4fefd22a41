"""What a task is: the room, the objects put into it, the robot's start, the instruction, the goal and the time limit.

Tasks are plain data: one JSON object per line in `sim/tasks/benchmark.jsonl`, read back through strict validation. Paper: the
DualTHOR task suite with its categories (single-arm, dual-arm optional, dual-arm essential).
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, Literal

from configs.validate import build
from data.files import write_text
from interface.episode import STEP_LIMIT
from sim.tasks.predicates import Predicate

BENCHMARK_PATH: Final = Path(__file__).parent / "benchmark.jsonl"
CATEGORIES: Final = ("single", "optional", "essential")

_OBJECT_ID = re.compile(r"^[A-Za-z][A-Za-z0-9]*_[1-9][0-9]*$")


class TaskError(ValueError):
    """A task that is not well formed; the message names the value and what is allowed."""


@dataclass(frozen=True, slots=True)
class Placement:
    """One movable object of a task.

    Attributes:
        object_id: `Type_n`, unique in the task.
        object_type: a type of the catalogue.
        receptacle: id of the object that carries it at the start (furniture of the room, or another placed object).
        xy: world position of its centre, metres; None lets the world choose a free spot from the task's seed.
        yaw_deg: orientation about the vertical, degrees.
        state: AI2-THOR state values at the start (`isOpen`, `isToggled`, `fillLiquid`, `mass` …).
    """

    object_id: str
    object_type: str
    receptacle: str
    xy: tuple[float, float] | None = None
    yaw_deg: float = 0.0
    state: Mapping[str, bool | float | str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not _OBJECT_ID.match(self.object_id) or self.object_id.rsplit("_", 1)[0] != self.object_type:
            raise TaskError(f"object id {self.object_id!r} is not {self.object_type}_n")


@dataclass(frozen=True, slots=True)
class Start:
    """Where the robot stands at the start.

    Attributes:
        x_m: world x of the base, metres.
        y_m: world y of the base, metres.
        yaw_deg: heading, degrees, counter-clockwise from world x.
        pelvis_height_m: pelvis height per robot name, metres above the floor.
    """

    x_m: float
    y_m: float
    yaw_deg: float
    pelvis_height_m: Mapping[str, float]


@dataclass(frozen=True, slots=True)
class Task:
    """One task.

    Attributes:
        id: unique name.
        room: name of a room layout.
        category: `single` (one arm is enough), `optional` (two arms are faster), `essential` (impossible with one).
        family: the kind of task within its category.
        instruction: what the robot is told.
        paraphrases: other wordings of the same instruction.
        start: the robot's start.
        placements: movable objects; a carrier stands before what it carries.
        states: start states of the room's own objects by id, for example `{"Fridge_1": {"isOpen": true}}`.
        goals: predicates that must all hold.
        time_limit: plan steps within which it is done in time, 1..50, the same for every robot. An episode may go on after it.
        split: `train`; of the benchmark's tasks `seen`, or `unseen` when the room or an object that the task names occurs in no
            training task.
        seed: seed the task was drawn with, also the world's seed.

    Raises:
        TaskError: on duplicate ids, no goals, no instruction, or a time limit out of range.
    """

    id: str
    room: str
    category: Literal["single", "optional", "essential"]
    family: str
    instruction: str
    start: Start
    placements: tuple[Placement, ...]
    goals: tuple[Predicate, ...]
    time_limit: int
    split: Literal["seen", "unseen", "train"]
    seed: int
    paraphrases: tuple[str, ...] = ()
    states: Mapping[str, Mapping[str, bool | float | str]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        ids = [placement.object_id for placement in self.placements]
        repeated = sorted({object_id for object_id in ids if ids.count(object_id) > 1})
        if repeated:
            raise TaskError(f"{self.id}: object {repeated[0]!r} is placed twice")
        if not self.goals:
            raise TaskError(f"{self.id}: a task needs at least one goal, got {self.goals!r}")
        if not self.instruction.strip():
            raise TaskError(f"{self.id}: empty instruction {self.instruction!r}")
        if not 1 <= self.time_limit <= STEP_LIMIT:
            raise TaskError(f"{self.id}: time limit {self.time_limit} outside 1..{STEP_LIMIT}")

    def to_json(self) -> dict[str, Any]:
        """Plain form, the inverse of `from_json`."""
        return {
            "id": self.id,
            "room": self.room,
            "category": self.category,
            "family": self.family,
            "instruction": self.instruction,
            "paraphrases": list(self.paraphrases),
            "start": {
                "x_m": self.start.x_m,
                "y_m": self.start.y_m,
                "yaw_deg": self.start.yaw_deg,
                "pelvis_height_m": dict(self.start.pelvis_height_m),
            },
            "placements": [
                {
                    "object_id": placement.object_id,
                    "object_type": placement.object_type,
                    "receptacle": placement.receptacle,
                    "xy": None if placement.xy is None else list(placement.xy),
                    "yaw_deg": placement.yaw_deg,
                    "state": dict(placement.state),
                }
                for placement in self.placements
            ],
            "states": {object_id: dict(state) for object_id, state in self.states.items()},
            "goals": [goal.to_json() for goal in self.goals],
            "time_limit": self.time_limit,
            "split": self.split,
            "seed": self.seed,
        }

    def content_hash(self) -> str:
        """Hash of everything in it (SHA-256, hexadecimal), so that an edited task is told from what it was."""
        return hashlib.sha256(json.dumps(self.to_json(), sort_keys=True).encode()).hexdigest()

    @staticmethod
    def from_json(record: Mapping[str, Any]) -> Task:
        """Reads a task back.

        Raises:
            configs.validate.ConfigError: on an unknown or missing key or a wrong value, with its path.
        """
        return build(Task, record, where=f"task {record.get('id', '?')}" if isinstance(record, Mapping) else "task")


def write_tasks(tasks: Iterable[Task], path: Path) -> None:
    """Writes one JSON object per line, atomically and byte-stable."""
    write_text(path, tasks_text(tasks))


def tasks_text(tasks: Iterable[Task]) -> str:
    """The file content `write_tasks` writes."""
    return "".join(json.dumps(task.to_json(), ensure_ascii=False, separators=(", ", ": ")) + "\n" for task in tasks)


def read_tasks(path: Path) -> tuple[Task, ...]:
    """Reads a JSON-lines file of tasks.

    Raises:
        TaskError: when two tasks share an id.
        configs.validate.ConfigError: on a malformed task.
    """
    tasks = tuple(Task.from_json(json.loads(line)) for line in path.read_text(encoding="utf-8").splitlines() if line.strip())
    ids = [task.id for task in tasks]
    if len(set(ids)) != len(ids):
        raise TaskError(f"{path.name}: task id {next(i for i in ids if ids.count(i) > 1)!r} occurs twice")
    return tasks


def load_benchmark() -> tuple[Task, ...]:
    """The benchmark's tasks, in file order."""
    return read_tasks(BENCHMARK_PATH)
