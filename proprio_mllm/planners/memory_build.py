"""Builds a memory from the expert's demonstrations: which episodes it takes, and how a shard's rows become an episode.

A row of `demos` has what was seen before a step, the step that the expert chose, and the log so far, which tells what was done
in fact: now and then a perturbed step. An episode's steps are those of its last row's log, and then the expert's last choice,
which no log shows: collectors keep only episodes in which the goals held after it. Only the split `train` is taken, and the
column `privileged` is not read; a task's family is part of its id.

Paper: baselines LLM-Planner (about 100 stored tasks) and RAP.
"""

from __future__ import annotations

import json
import re
import sys
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from tqdm import tqdm

from configs.arguments import command, read_arguments
from data.files import file_hash, new_folder, write_text
from data.shards import ShardError, ShardReader, decode_png
from interface.observation import HistoryItem
from interface.steps import PlanStep
from proprio_mllm.planners.chat.sight import SightError, image_encoder, weights_digest
from proprio_mllm.planners.memory import (
    IMAGES_FILE,
    MEMORY_FILE,
    SCHEMA_VERSION,
    Features,
    Memory,
    MemoryEpisode,
    MemoryFileError,
    MemoryHeader,
    MemoryStep,
    plan_of,
    read_memory,
)
from proprio_mllm.planners.protocol import succeeded
from proprio_mllm.training.sources import shard_hash

#: Columns that an episode is made of, without its pictures and motions.
_COLUMNS: Final = (
    "episode", "task", "split", "category", "robot", "room", "instruction", "visible", "known", "history", "target",
)  # fmt: skip
_FAMILY: Final = re.compile(r"^train_(.+)_\d+$")


@dataclass(frozen=True)
class MemoryConfig:
    """What goes into a memory.

    Attributes:
        demos: folder of `demos` shards.
        out: folder of the memory.
        limit: most episodes; null takes all that have an instruction of their own.
        seed: of the selection.
        vision: folder of the image encoder whose features RAP compares views by; null makes a memory without pictures.
    """

    demos: str = "outputs/demos"
    out: str = "outputs/memory"
    limit: int | None = 100
    seed: int = 0
    vision: str | None = "weights/tiny/base"

    def __post_init__(self) -> None:
        if self.limit is not None and self.limit < 1:
            raise ValueError(f"limit {self.limit} must be positive or null")
        if self.seed < 0:
            raise ValueError(f"seed {self.seed} must not be negative")


@dataclass(frozen=True, slots=True)
class Candidate:
    """An episode of the shards.

    Attributes:
        episode: as it is stored.
        row: index of its first row.
        detours: steps of it that failed or were not the expert's choice.
    """

    episode: MemoryEpisode
    row: int
    detours: int

    @property
    def label(self) -> str:
        """What the selection is balanced over: the family, or where it is not known the last action's name."""
        return self.episode.family or PlanStep.parse(self.episode.plan[-1]).actions[-1].name


def candidates(reader: ShardReader) -> list[Candidate]:
    """All episodes of `demos` shards, in order.

    Raises:
        MemoryFileError: on a row that is not of the split `train`, and on an episode with gaps.
    """
    rows: Sequence[Mapping[str, Any]] = reader.dataset.select_columns(list(_COLUMNS)).to_list()
    found: list[Candidate] = []
    first = 0
    for index in range(1, len(rows) + 1):
        if index == len(rows) or rows[index]["episode"] != rows[first]["episode"]:
            found.append(_candidate(rows[first:index], first, str(reader.folder)))
            first = index
    return found


def _candidate(rows: Sequence[Mapping[str, Any]], first: int, source: str) -> Candidate:
    last = rows[-1]
    if last["split"] != "train":
        raise MemoryFileError(f"{source}: task {last['task']} is of the split {last['split']!r}; a memory takes train only")
    if len(last["history"]) != len(rows) - 1:
        raise MemoryFileError(f"{source}: episode {last['episode']} has {len(rows)} rows and a log of {len(last['history'])}")
    log = [HistoryItem(item["step"], item["feedback"]) for item in last["history"]]
    final = PlanStep.parse(last["target"])
    log.append(HistoryItem(final.to_text(), "; ".join(f"{action.to_text()} ok" for action in final.actions)))
    steps = tuple(
        MemoryStep(item.step, item.feedback, tuple(row["visible"]), tuple(row["known"]))
        for row, item in zip(rows, log, strict=True)
    )
    family = _FAMILY.match(last["task"])
    episode = MemoryEpisode(
        task=last["task"],
        robot=last["robot"],
        room=last["room"],
        category=last["category"],
        family="" if family is None else family.group(1),
        instruction=last["instruction"],
        plan=plan_of(steps),
        steps=steps,
    )
    detours = sum(not succeeded(item) or item.step != row["target"] for row, item in zip(rows, log, strict=True))
    return Candidate(episode, first, detours)


def select(found: Sequence[Candidate], limit: int | None, rng: np.random.Generator) -> list[Candidate]:
    """Takes one episode of every kind in turn, those with the fewest detours first and no instruction twice.

    Args:
        found: to choose from.
        limit: most episodes; None sets no limit.
        rng: decides between equals, and which kinds come first.

    Returns:
        The chosen ones in their old order; each kind's robots take turns as far as there are such episodes.
    """
    order = sorted(rng.permutation(len(found)).tolist(), key=lambda index: found[index].detours)
    kinds: dict[str, list[Candidate]] = {}
    for index in order:
        kinds.setdefault(found[index].label, []).append(found[index])
    names = rng.permutation(sorted(kinds)).tolist()
    chosen: list[Candidate] = []
    told: set[str] = set()
    robots: Counter[tuple[str, str]] = Counter()
    while any(kinds.values()):
        for name in names:
            kinds[name] = [one for one in kinds[name] if one.episode.instruction not in told]
            if not kinds[name] or len(chosen) == limit:
                continue
            taken = min(kinds[name], key=lambda one: robots[name, one.episode.robot])  # of equals the first
            chosen.append(taken)
            told.add(taken.episode.instruction)
            robots[name, taken.episode.robot] += 1
        if len(chosen) == limit:
            break
    return sorted(chosen, key=lambda one: one.row)


def build_memory(config: MemoryConfig, command: str) -> Memory:
    """Writes a memory, whole or not at all.

    Args:
        config: what goes into it.
        command: for its header.

    Raises:
        MemoryFileError: when there is nothing to take, or `out` holds something else.
        data.shards.ShardError: when the shards cannot be read.
        SightError: when there is no image encoder.
    """
    demos, out = Path(config.demos), Path(config.out)
    strange = [path.name for path in out.iterdir() if path.name not in (MEMORY_FILE, IMAGES_FILE)] if out.is_dir() else []
    if strange or out.is_file():
        raise MemoryFileError(
            f"{out} holds something else than a memory ({', '.join(strange[:3]) or 'a file'}); choose another"
        )
    source_hash, reader = shard_hash(demos), ShardReader(demos, "demos")
    chosen = select(candidates(reader), config.limit, np.random.default_rng(config.seed))
    if not chosen:
        raise MemoryFileError(f"{demos}: there are no episodes")
    with new_folder(out) as work:
        episodes, features = [one.episode for one in chosen], None
        if config.vision is not None:
            episodes = _numbered(episodes)
            features = _write_images(work / IMAGES_FILE, config.vision, reader, chosen)
        header = MemoryHeader(str(demos), source_hash, len(episodes), config.seed, command, features)
        lines = [{"schema_version": SCHEMA_VERSION, **asdict(part)} for part in (header, *episodes)]
        write_text(work / MEMORY_FILE, "".join(json.dumps(line, ensure_ascii=False) + "\n" for line in lines))
        read_memory(work)
    return read_memory(out)


def _numbered(episodes: Sequence[MemoryEpisode]) -> list[MemoryEpisode]:
    """Episodes whose steps name their pictures, one after the other."""
    numbered, number = [], 0
    for episode in episodes:
        steps = tuple(replace(step, image=number + index) for index, step in enumerate(episode.steps))
        numbered.append(replace(episode, steps=steps))
        number += len(steps)
    return numbered


def _write_images(path: Path, vision: str, reader: ShardReader, chosen: Sequence[Candidate]) -> Features:
    """Features of every step's view, in the order of the steps."""
    from safetensors.numpy import save_file

    encoder = image_encoder(vision)
    rows = [one.row + index for one in chosen for index in range(len(one.episode.steps))]
    vectors = [encoder.encode([decode_png(reader[row]["image"])])[0] for row in tqdm(rows, desc="memory", unit="view")]
    save_file({"images": np.stack(vectors)}, path)
    return Features(vision, weights_digest(vision), file_hash(path))


@command(MemoryFileError, ShardError, SightError)
def main(arguments: Sequence[str]) -> int:
    """Command line; 0 on success, 2 on wrong arguments or what cannot be read."""
    config = read_arguments(MemoryConfig, arguments)
    memory = build_memory(config, " ".join(["python -m proprio_mllm memory", *arguments]))
    families = {episode.family for episode in memory.episodes}
    robots = Counter(episode.robot for episode in memory.episodes)
    steps = sum(len(episode.steps) for episode in memory.episodes)
    found = f"{len(memory.episodes)} episodes, one of each instruction"
    facts = f"{found}, {steps} steps, {len(families)} families, {dict(sorted(robots.items()))}"
    sys.stdout.write(f"{config.out}: {facts}\n")
    return 0
