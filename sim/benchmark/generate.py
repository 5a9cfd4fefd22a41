"""Generates the benchmark: 359 tasks that the expert has solved on every robot, with time limits from its plans.

A slot is a family in a room. Its seeds are tried in order, and those tasks are kept whose certificates say what their category
promises (`sim.benchmark.certificates`), whose instruction is new, and whose subject has not yet been asked for too often. What
a room cannot give is taken from the family's other rooms. Generating takes hours on two cores; what has been tried is kept in
`outputs/tasks`, by version of the physics and by what was drawn, so that it goes on where it was stopped.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

from tqdm import tqdm

from data.workers import worker_pool
from sim.benchmark.certificates import Certificate, certified
from sim.benchmark.composition import COMPOSITION, Share
from sim.tasks.sample import BIG_TYPES, sample_task
from sim.tasks.task import Task
from sim.world.world import WorldError

_SEEDS_PER_SLOT: Final = 200
#: Seeds that a slot tries per task that it has to find.
_TRIES: Final = 12


@dataclass(frozen=True, slots=True)
class Slot:
    """A family in a room.

    Attributes:
        number: its place in the composition; its seeds follow from it.
        family: family of its tasks.
        room: room of its tasks.
        count: how many of them the benchmark has.
        spare: whether it is asked only when the family's other rooms are exhausted.
    """

    number: int
    family: str
    room: str
    count: int
    spare: bool = False

    @property
    def seeds(self) -> range:
        """The seeds it tries."""
        first = self.number * _SEEDS_PER_SLOT
        return range(first, first + min(_SEEDS_PER_SLOT, _TRIES * self.count))

    @property
    def more_seeds(self) -> bool:
        """Whether one more task would let it try more seeds."""
        return _TRIES * self.count < _SEEDS_PER_SLOT


def slots(composition: Sequence[Share] = COMPOSITION) -> tuple[Slot, ...]:
    """Every family's tasks, dealt out to its rooms in turn; a room that gets none stands in for the others."""
    found: list[Slot] = []
    for share in composition:
        for index, room in enumerate(share.rooms):
            count = share.count // len(share.rooms) + (index < share.count % len(share.rooms))
            found.append(Slot(len(found), share.family, room, count))
        found += [Slot(len(found) + index, share.family, room, 0, spare=True) for index, room in enumerate(share.spare)]
    return tuple(found)


def moved(wanted: Sequence[Slot], found: Mapping[int, int], totals: Mapping[str, int]) -> list[Slot]:
    """The slots that have to find more, because others of their family found fewer than they were to.

    Args:
        wanted: all slots, with the counts they were to find.
        found: how many each one found, by its number.
        totals: tasks that each family is to have.

    Raises:
        RuntimeError: when only families are short whose rooms are all exhausted; the message names them.
    """
    more: list[Slot] = []
    short: list[str] = []
    for family, total in totals.items():
        rooms = [slot for slot in wanted if slot.family == family]
        missing = total - sum(found[slot.number] for slot in rooms)
        able = [slot for slot in rooms if found[slot.number] == slot.count and slot.more_seeds]
        able = [slot for slot in able if not slot.spare] or able
        if missing and not able:
            short.append(f"{family}: {missing} of {total}")
            continue
        for index, slot in enumerate(able):
            extra = missing // len(able) + (index < missing % len(able))
            more += [replace(slot, count=slot.count + extra)] if extra else []
    if short and not more:
        raise RuntimeError("no room gives the missing tasks of " + "; ".join(short))
    return more


def _subject(task: Task) -> str:
    """Type of what the task is about first; of the few things that take two hands, also where they go."""
    goal = task.goals[0]
    kind = goal.object_type or next(iter(goal.object_ids())).rsplit("_", 1)[0]
    return f"{kind} {goal.receptacle_id}" if kind in BIG_TYPES else kind


def fill(slot: Slot, folder: Path) -> list[tuple[Task, tuple[Certificate, ...]]]:
    """A slot's tasks, with different instructions and subjects as varied as the room allows.

    Args:
        slot: what is wanted.
        folder: where what has been tried is kept.
    """
    cache = folder / f"{slot.family}-{slot.room}.jsonl"
    tried = _read(cache)
    found: list[tuple[Task, tuple[Certificate, ...]]] = []
    with cache.open("a", encoding="utf-8") as log:
        for seed in slot.seeds:
            if len(found) == slot.count:
                break
            try:
                drawn = sample_task(seed, slot.room, slot.family, "benchmark")
            except (ValueError, WorldError):
                continue
            key = seed, drawn.content_hash()[:12]
            if key not in tried:
                line: dict[str, Any] = {"seed": seed, "drawn": key[1]}
                try:
                    task, proofs = certified(drawn)
                    tried[key] = task, proofs
                    line |= {"task": task.to_json(), "proofs": [proof.to_json() for proof in proofs]}
                except (ValueError, WorldError) as error:
                    tried[key] = None
                    line["refused"] = f"{type(error).__name__}: {error}"
                log.write(json.dumps(line) + "\n")
                log.flush()
            candidate = tried[key]
            if candidate is not None and fits(candidate[0], [task for task, _ in found], slot.count):
                found.append(candidate)
    return found


def fits(task: Task, others: Sequence[Task], count: int) -> bool:
    """Whether a task makes the others more varied: its instruction is new, and its subject not yet asked for too often.

    Args:
        task: a candidate.
        others: the tasks of its slot.
        count: how many the slot is to have.
    """
    subjects = Counter(_subject(other) for other in others)
    new = task.instruction not in {other.instruction for other in others}
    return new and subjects[_subject(task)] < 1 + count // 3


def _read(path: Path) -> dict[tuple[int, str], tuple[Task, tuple[Certificate, ...]] | None]:
    """What a slot has tried before, by seed and what was drawn."""
    tried: dict[tuple[int, str], tuple[Task, tuple[Certificate, ...]] | None] = {}
    for record in read_lines(path):
        proofs = tuple(Certificate.from_json(proof) for proof in record.get("proofs", ()))
        tried[record["seed"], record["drawn"]] = (Task.from_json(record["task"]), proofs) if proofs else None
    return tried


def read_lines(path: Path) -> list[dict[str, Any]]:
    """The JSON lines of a file that may be absent; a last line that was cut short is taken off it."""
    if not path.is_file():
        return []
    content = path.read_bytes()
    whole = content[: content.rfind(b"\n") + 1]
    if whole != content:
        path.write_bytes(whole)
    return [json.loads(line) for line in whole.decode().splitlines()]


def more_seeds(task: Task) -> Iterator[tuple[str, int]]:
    """Rooms and seeds that may give a task in another's place: all of its own room, then those of its family's other rooms."""
    family = [slot for slot in slots() if slot.family == task.family]
    for slot in sorted(family, key=lambda slot: (slot.room != task.room, slot.spare)):
        yield from ((slot.room, seed) for seed in range(slot.seeds.start, slot.seeds.start + _SEEDS_PER_SLOT))


def _fill_star(arguments: tuple[Slot, Path]) -> list[tuple[Task, tuple[Certificate, ...]]]:
    return fill(*arguments)


def generate(folder: Path, workers: int = 2) -> tuple[list[Task], list[Certificate]]:
    """Searches all slots.

    Args:
        folder: where what has been tried is kept.
        workers: processes.

    Raises:
        RuntimeError: when a family's rooms do not give as many tasks as they should.
    """
    folder.mkdir(parents=True, exist_ok=True)
    filled: dict[int, list[tuple[Task, tuple[Certificate, ...]]]] = {}
    wanted = {slot.number: slot for slot in slots()}
    totals = {share.family: share.count for share in COMPOSITION}
    search = list(wanted.values())
    with worker_pool(workers) as pool:
        while search:
            results = pool.map(_fill_star, [(slot, folder) for slot in search])
            for slot, found in zip(search, tqdm(results, total=len(search), desc="slots", unit="slot"), strict=True):
                filled[slot.number] = found
            # A room that is exhausted keeps what it found, and its family's other rooms are asked for the rest.
            search = moved(list(wanted.values()), {number: len(found) for number, found in filled.items()}, totals)
            wanted |= {slot.number: slot for slot in search}
    ordered = [filled[number] for number in sorted(filled)]
    tasks = [task for found in ordered for task, _ in found]
    return tasks, [proof for found in ordered for _, proofs in found for proof in proofs]


def counts(tasks: Sequence[Task]) -> dict[str, Any]:
    """How many tasks there are per category, family, room, split and type; a task counts once for each type in it."""

    def table(values: Iterator[str]) -> dict[str, int]:
        return dict(sorted(Counter(values).items()))

    return {
        "tasks": len(tasks),
        "category": table(task.category for task in tasks),
        "family": table(task.family for task in tasks),
        "room": table(task.room for task in tasks),
        "split": table(task.split for task in tasks),
        "type_named": table(kind for task in tasks for kind in named_types(task)),
        "type_placed": table(kind for task in tasks for kind in {p.object_type for p in task.placements}),
    }


def named_types(task: Task) -> set[str]:
    """Types of the objects that the goals are about, and of the furniture whose state the task sets."""
    ids = [placement.object_id for placement in task.placements]
    goals = {name for goal in task.goals for name in goal.involved(ids)}
    return {name.rsplit("_", 1)[0] for name in goals | set(task.states)}
