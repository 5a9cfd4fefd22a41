"""What a memory brings to mind: the tasks nearest to an instruction, and the moments nearest to what a step is about.

`TaskRecall` is LLM-Planner's: cosine of the instructions. With a task's family, predicted from its instruction as that of the
nearest stored task, it is RAP's first retrieval: task cosine + category cosine. `MomentRecall` is RAP's second one: task +
category + plan cosine of an episode, + the best over its steps of the cosine of a key with what was seen (an object is sought)
or done (an action is intended), + that of the views where the memory has pictures. All terms weigh the same. What stands around
the best step goes into the prompt: here two steps before it and two after.

Paper: baselines LLM-Planner and RAP. Shape letters: E episodes, S steps of all episodes, D numbers of a vector.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from data.files import file_hash
from proprio_mllm.planners.chat.embedding import Embedder, nearest, sentence_embedder
from proprio_mllm.planners.chat.sight import ImageEncoder, image_encoder, weights_digest
from proprio_mllm.planners.chat.spoken import plan_words, step_words, type_words
from proprio_mllm.planners.memory import (
    MEMORY_FILE,
    Memory,
    MemoryEpisode,
    MemoryFileError,
    MemoryStep,
    check_memory,
    read_memory,
)

#: Steps before and after the best one that are brought to mind with it.
AROUND: Final = 2


@dataclass(frozen=True, slots=True)
class Key:
    """What a thought is about.

    Attributes:
        kind: an object that is sought, or an action that is intended.
        text: in words or in the grammar.
    """

    kind: Literal["object", "action"]
    text: str


@dataclass(frozen=True, slots=True)
class Moment:
    """A part of a stored episode.

    Attributes:
        episode: the whole of it.
        best: index of the step that matched.
        score: sum of the likenesses.
    """

    episode: MemoryEpisode
    best: int
    score: float

    @property
    def steps(self) -> tuple[MemoryStep, ...]:
        """The steps around the best one."""
        return self.episode.steps[max(0, self.best - AROUND) : self.best + AROUND + 1]


class TaskRecall:
    """The tasks of a memory.

    Args:
        memory: what there is.
        embedder: of sentences.
    """

    def __init__(self, memory: Memory, embedder: Embedder) -> None:
        self.memory, self.embedder = memory, embedder
        episodes = memory.episodes
        self._tasks = embedder.embed([one.instruction for one in episodes])  # (E, D)
        self._families = embedder.embed([_family_words(one.family) for one in episodes])  # (E, D)

    def nearest(self, instruction: str, k: int) -> list[MemoryEpisode]:
        """The `k` stored tasks whose instructions are most alike, best first."""
        return [self.memory.episodes[index] for index in nearest(self._vector(instruction), self._tasks, k)]

    def family(self, instruction: str) -> str:
        """The family that an instruction's nearest stored task has."""
        return self.nearest(instruction, 1)[0].family

    def likeness(self, instruction: str, family: str) -> NDArray[np.floating]:
        """Task cosine + category cosine of every episode (E,)."""
        return self._tasks @ self._vector(instruction) + self._families @ self._vector(_family_words(family))

    def similar(self, instruction: str, family: str, k: int) -> list[MemoryEpisode]:
        """The `k` stored tasks that are most alike in instruction and family, best first."""
        order = np.argsort(-self.likeness(instruction, family), kind="stable")[:k]
        return [self.memory.episodes[int(index)] for index in order]

    def _vector(self, text: str) -> NDArray[np.float32]:
        return self.embedder.embed([text])[0]


class MomentRecall:
    """The steps of a memory.

    Args:
        tasks: its tasks.
        eyes: the encoder that made the features of its pictures; None leaves pictures out.

    Raises:
        ValueError: when `eyes` is given for a memory without pictures.
    """

    def __init__(self, tasks: TaskRecall, eyes: ImageEncoder | None = None) -> None:
        self.tasks, self.eyes = tasks, eyes
        episodes, embed = tasks.memory.episodes, tasks.embedder.embed
        steps = [step for one in episodes for step in one.steps]
        counts = [len(one.steps) for one in episodes]
        self._starts = np.cumsum([0, *counts[:-1]])  # (E,)
        self._plans = embed([plan_words(one.plan) for one in episodes])  # (E, D)
        self._stored = {
            "object": embed([seen_words(step.visible) for step in steps]),  # (S, D)
            "action": embed([step_words(step.step) for step in steps]),  # (S, D)
        }
        self._views: NDArray[np.float32] | None = None
        if eyes is not None:
            images, rows = tasks.memory.images, [step.image for step in steps]
            if images is None or None in rows:
                raise ValueError(f"the memory made by `{tasks.memory.header.command}` has no pictures")
            self._views = images[np.asarray(rows)]  # (S, D)

    def moments(
        self, instruction: str, family: str, plan: Sequence[str], key: Key, image: NDArray[np.uint8] | None, k: int
    ) -> list[Moment]:
        """The `k` episodes with the moments that fit best, best first; one moment of each.

        Args:
            instruction: the task.
            family: its predicted family.
            plan: lines of its overall plan.
            key: what the thought is about.
            image: what is seen now; None leaves pictures out of this one.
            k: number of episodes.
        """
        embed, episodes = self.tasks.embedder.embed, self.tasks.memory.episodes
        whole = self.tasks.likeness(instruction, family) + self._plans @ embed([plan_words(plan)])[0]  # (E,)
        words = seen_words([key.text]) if key.kind == "object" else step_words(key.text)
        fit = self._stored[key.kind] @ embed([words])[0]  # (S,)
        if self._views is not None and self.eyes is not None and image is not None:
            fit = fit + self._views @ self.eyes.encode([image])[0]
        score = whole + np.maximum.reduceat(fit, self._starts)  # (E,)
        found: list[Moment] = []
        for index in np.argsort(-score, kind="stable")[:k].tolist():
            own = fit[self._starts[index] :][: len(episodes[index].steps)]
            found.append(Moment(episodes[index], int(np.argmax(own)), float(score[index])))
        return found


def load_tasks(folder: str) -> TaskRecall:
    """A memory's tasks, read and embedded once per process.

    Raises:
        MemoryFileError: when the memory cannot be read.
        EmbeddingError: when a package is not installed.
    """
    return _tasks(folder, file_hash(check_memory(Path(folder)) / MEMORY_FILE))


def load_moments(folder: str) -> MomentRecall:
    """A memory's steps, with pictures if it has them, read and embedded once per process.

    Raises:
        MemoryFileError: when the memory cannot be read, or its pictures were encoded by other weights.
        EmbeddingError: when a package is not installed.
        SightError: when the encoder of its pictures is not there.
    """
    return _moments(folder, file_hash(check_memory(Path(folder)) / MEMORY_FILE))


@functools.lru_cache(maxsize=4)  # the digest is in the key, so that a memory that was made again is read again
def _tasks(folder: str, digest: str) -> TaskRecall:
    return TaskRecall(read_memory(Path(folder)), sentence_embedder())


@functools.lru_cache(maxsize=4)
def _moments(folder: str, digest: str) -> MomentRecall:
    tasks = _tasks(folder, digest)
    features = tasks.memory.header.features
    if features is None:
        return MomentRecall(tasks)
    if weights_digest(features.model) != features.digest:
        command = tasks.memory.header.command
        raise MemoryFileError(f"{folder}: {features.model} is not the encoder that its pictures were encoded by: `{command}`")
    return MomentRecall(tasks, image_encoder(features.model))


def seen_words(ids: Sequence[str]) -> str:
    """What is in view, in words: each type once."""
    return ", ".join(dict.fromkeys(type_words(one) for one in ids)) or "nothing"


def _family_words(family: str) -> str:
    return family.replace("_", " ") or "any"
