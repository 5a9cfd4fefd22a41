"""The memory of LLM-Planner and RAP: tasks that the expert solved, with its steps and what was seen between them.

    python -m proprio_mllm memory [demos=outputs/demos] [out=outputs/memory] [limit=100]

reads the demonstrations that `python train.py stage=data` collects in the training tasks, none of which is a task of the
benchmark (`proprio_mllm.planners.memory_build`). A memory is a folder: `memory.jsonl` has a header line, then one JSON line per
successful episode; `images.safetensors` has the features (N, D) of the pictures, if there are any. Reading checks every line.

Paper: baselines LLM-Planner and RAP. RAP's released code takes its memory from the games it is evaluated on; this one does not.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, TypeVar

import numpy as np
from numpy.typing import NDArray

from configs.validate import ConfigError, build
from data.files import file_hash
from interface.observation import HistoryItem
from interface.steps import PlanStep
from proprio_mllm.planners.protocol import succeeded

T = TypeVar("T")
SCHEMA_VERSION: Final = 1
#: Names of the files in a memory's folder.
MEMORY_FILE: Final = "memory.jsonl"
IMAGES_FILE: Final = "images.safetensors"
_COMMAND: Final = "python -m proprio_mllm memory"


class MemoryFileError(ValueError):
    """A memory that is not there, cannot be made or cannot be read; the message names the file and what to do."""


@dataclass(frozen=True, slots=True)
class MemoryStep:
    """A step that was carried out.

    Attributes:
        step: in the action grammar.
        feedback: each action with `ok` or its failure code.
        visible: ids in view before it.
        known: ids known before it.
        image: row of the features of the view before it, None without pictures.
    """

    step: str
    feedback: str
    visible: tuple[str, ...]
    known: tuple[str, ...]
    image: int | None = None

    def __post_init__(self) -> None:
        PlanStep.parse(self.step)

    @property
    def success(self) -> bool:
        """Whether every action succeeded."""
        return succeeded(HistoryItem(self.step, self.feedback))


@dataclass(frozen=True, slots=True)
class MemoryEpisode:
    """A task and how it was done.

    Attributes:
        task: id of a training task.
        robot: which robot did it.
        room: where.
        category: `single`, `optional` or `essential`; empty when not known.
        family: kind of task within its category; empty when not known.
        instruction: the task in natural language.
        plan: texts of the steps that succeeded.
        steps: all steps.
    """

    task: str
    robot: str
    room: str
    category: str
    family: str
    instruction: str
    plan: tuple[str, ...]
    steps: tuple[MemoryStep, ...]

    def __post_init__(self) -> None:
        if not self.instruction.strip():
            raise ValueError(f"empty instruction {self.instruction!r}")
        expected = plan_of(self.steps)
        if not expected or self.plan != expected:
            raise ValueError(f"plan {list(self.plan)} is not the steps that succeeded, {list(expected)}")


@dataclass(frozen=True, slots=True)
class Features:
    """What made the features of the pictures.

    Attributes:
        model: folder of the image encoder.
        digest: of its weights.
        sha256: of the features' file.
    """

    model: str
    digest: str
    sha256: str


@dataclass(frozen=True, slots=True)
class MemoryHeader:
    """Where a memory comes from.

    Attributes:
        source: the shards.
        source_hash: hash of their manifest.
        count: episodes.
        seed: of their selection.
        command: that made it.
        features: of the pictures, None without.
    """

    source: str
    source_hash: str
    count: int
    seed: int
    command: str
    features: Features | None = None


@dataclass(frozen=True)
class Memory:
    """A memory that has been read.

    Attributes:
        header: where it comes from.
        episodes: in file order.
        images: features (N, D) of the pictures, unit length; None without.
    """

    header: MemoryHeader
    episodes: tuple[MemoryEpisode, ...]
    images: NDArray[np.float32] | None = None


def plan_of(steps: tuple[MemoryStep, ...]) -> tuple[str, ...]:
    """The steps that succeeded; they are what the task took."""
    return tuple(step.step for step in steps if step.success)


def check_memory(folder: Path) -> Path:
    """A memory's folder.

    Raises:
        MemoryFileError: when it holds none.
    """
    if not (folder / MEMORY_FILE).is_file():
        raise MemoryFileError(f"no memory at {folder}: make it with `{_COMMAND}`, or set planner.memory=FOLDER")
    return folder


def read_memory(folder: Path) -> Memory:
    """Reads a memory and checks all of it.

    Raises:
        MemoryFileError: when there is none, a line is broken (the message names file and line), the version is unknown, or
            episodes or features are missing.
    """
    path = check_memory(folder) / MEMORY_FILE
    try:
        lines = path.read_text(encoding="utf-8").splitlines() or [""]
    except UnicodeDecodeError as error:
        raise MemoryFileError(f"{path}: not a text file ({error})") from error
    header = _line(MemoryHeader, lines[0], f"{path}:1")
    episodes = tuple(_line(MemoryEpisode, line, f"{path}:{n}") for n, line in enumerate(lines[1:], start=2))
    if len(episodes) != header.count or not episodes:
        raise MemoryFileError(f"{path}: {len(episodes)} episodes, its header says {header.count}; make it again: {_COMMAND}")
    images = None if header.features is None else _images(folder / IMAGES_FILE, header.features)
    rows = 0 if images is None else len(images)
    for number, episode in enumerate(episodes, start=2):
        wrong = next((s.image for s in episode.steps if s.image is not None and not 0 <= s.image < rows), None)
        if wrong is not None:
            raise MemoryFileError(f"{path}:{number}: image {wrong} is not one of the {rows} in {IMAGES_FILE}")
    return Memory(header, episodes, images)


def _line(kind: type[T], text: str, where: str) -> T:
    try:
        values: Any = json.loads(text)
    except json.JSONDecodeError as error:
        raise MemoryFileError(f"{where}: not JSON ({error})") from error
    if not isinstance(values, Mapping) or values.get("schema_version") != SCHEMA_VERSION:
        found = values.get("schema_version") if isinstance(values, Mapping) else text[:40]
        raise MemoryFileError(f"{where}: schema version {found!r} is unknown; this code reads {SCHEMA_VERSION}")
    try:
        return build(kind, {key: value for key, value in values.items() if key != "schema_version"})
    except ConfigError as error:
        raise MemoryFileError(f"{where}: {error}") from error


def _images(path: Path, features: Features) -> NDArray[np.float32]:
    """The features' file, which must be the one that the header names."""
    from safetensors.numpy import load_file

    if not path.is_file() or file_hash(path) != features.sha256:
        raise MemoryFileError(f"{path}: missing, or not the file that {MEMORY_FILE} was made with; make it again: {_COMMAND}")
    return load_file(path)["images"].astype(np.float32)
