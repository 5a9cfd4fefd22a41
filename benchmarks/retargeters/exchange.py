"""Files between `benchmarks/retarget.py` and the process of a method, and the clock that all methods are timed with.

A method's script is called as `PYTHON script.py JOB.npz RESULT.npz` and knows only NumPy and its own library. Both files hold
plain arrays and one JSON text, no pickles.
Shape letters: T frames, J joints, R repetitions. World frame, z up, floor at 0, metres, 20 frames per second.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Value = TypeVar("Value")


@dataclass(frozen=True, slots=True)
class Clip:
    """A human motion.

    Attributes:
        name: clip id.
        joints: (T, 22, 3).
        height_m: how tall the person is.
    """

    name: str
    joints: Array
    height_m: float


@dataclass(frozen=True, slots=True)
class Job:
    """What a method shall do.

    Attributes:
        robot: name of the robot and what the method may know of it, from the robot's description.
        human_joints: names of the human's joints.
        clips: human motions.
        fps: frames per second.
        repeats: how often each clip is retargeted, for the clock.
    """

    robot: dict[str, Any]
    human_joints: tuple[str, ...]
    clips: tuple[Clip, ...]
    fps: float
    repeats: int

    def write(self, path: Path) -> None:
        text = {
            "robot": self.robot,
            "human_joints": self.human_joints,
            "clips": [{"name": clip.name, "height_m": clip.height_m} for clip in self.clips],
            "fps": self.fps,
            "repeats": self.repeats,
        }
        joints: dict[str, Any] = {f"joints_{i}": clip.joints for i, clip in enumerate(self.clips)}
        np.savez(path, text=np.array(json.dumps(text)), **joints)

    @staticmethod
    def read(path: Path) -> Job:
        with np.load(path, allow_pickle=False) as stored:
            text = json.loads(str(stored["text"]))
            clips = tuple(Clip(c["name"], stored[f"joints_{i}"], c["height_m"]) for i, c in enumerate(text["clips"]))
        return Job(text["robot"], tuple(text["human_joints"]), clips, text["fps"], text["repeats"])


@dataclass(frozen=True, slots=True)
class Outcome:
    """One retargeted clip.

    Attributes:
        root: (T, 7) position and quaternion (w, x, y, z) of the pelvis.
        q: (T, J) joints.
        seconds: (R, 2) time of each repetition: by the clock on the wall, and of the process's processor.
        targets: (T, N, 3) where the method wanted `Results.points`; None when it has no such points.
    """

    root: Array
    q: Array
    seconds: Array
    targets: Array | None = None


@dataclass(frozen=True, slots=True)
class Results:
    """What a method made.

    Attributes:
        joint_names: of the columns of `Outcome.q`.
        versions: of the libraries that it used.
        outcomes: one per clip.
        points: robot points with targets, as (role, body or site, position in it): roles are left_hand, left_shoulder,
            left_foot and the same on the right.
    """

    joint_names: list[str]
    versions: dict[str, str]
    outcomes: list[Outcome]
    points: list[tuple[str, str, tuple[float, float, float]]] = field(default_factory=list)

    def write(self, path: Path) -> None:
        text = json.dumps({"joint_names": self.joint_names, "versions": self.versions, "points": self.points})
        arrays: dict[str, Any] = {}
        for i, outcome in enumerate(self.outcomes):
            arrays |= {f"root_{i}": outcome.root, f"q_{i}": outcome.q, f"seconds_{i}": outcome.seconds}
            if outcome.targets is not None:
                arrays[f"targets_{i}"] = outcome.targets
        np.savez(path, text=np.array(text), **arrays)

    @staticmethod
    def read(path: Path) -> Results:
        with np.load(path, allow_pickle=False) as stored:
            text = json.loads(str(stored["text"]))
            count = sum(name.startswith("root_") for name in stored.files)
            outcomes = [
                Outcome(
                    stored[f"root_{i}"],
                    stored[f"q_{i}"],
                    stored[f"seconds_{i}"],
                    stored[f"targets_{i}"] if f"targets_{i}" in stored.files else None,
                )
                for i in range(count)
            ]
        return Results(text["joint_names"], text["versions"], outcomes, [(r, b, tuple(p)) for r, b, p in text["points"]])


def timed(run: Callable[[], Value], repeats: int) -> tuple[Value, Array]:
    """The value of the last call and the time (R, 2) of each: wall and processor seconds.

    Raises:
        ValueError: when `repeats` is not positive.
    """
    if repeats < 1:
        raise ValueError(f"repeats {repeats} must be at least 1")
    seconds = []
    while True:
        wall, processor = time.perf_counter(), time.process_time()
        value = run()
        seconds.append((time.perf_counter() - wall, time.process_time() - processor))
        if len(seconds) == repeats:
            return value, np.array(seconds)
