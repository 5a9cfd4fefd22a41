"""Generates the benchmark: 359 tasks that the expert has solved on every robot, with time limits from its plans.

    python -m sim benchmark do=generate    # writes benchmark.jsonl and certificates.jsonl
    python -m sim benchmark do=check       # rebuilds every task from its seed, solves it again, compares bytes
    python -m sim benchmark do=check_fast  # the same without solving: time limits are taken as they are
    python -m sim benchmark do=table       # the certificates per family and robot, as Markdown

A slot is a family in a room. Its seeds are tried in order, and those tasks are kept whose certificates say what their category
promises (`sim.benchmark.certificates`), whose instruction is new, and whose subject has not yet been asked for too often. What
a room cannot give is taken from the family's other rooms. Both checks print counts per category, family, room, split and type
as JSON. Generating takes hours on two cores; what has been tried is kept in `outputs/tasks`, by a hash of the simulator's
files, so that it goes on where it was stopped.
"""

from __future__ import annotations

import hashlib
import json
import logging
import multiprocessing
import sys
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final, Literal

from tqdm import tqdm

import sim
from configs.arguments import command, read_arguments
from data.files import write_text
from data.workers import start_worker
from sim.benchmark.certificates import (
    CERTIFICATES_PATH,
    Certificate,
    Refusal,
    certificates_table,
    certificates_text,
    certified,
    load_certificates,
)
from sim.benchmark.composition import COMPOSITION, Share
from sim.tasks.sample import BIG_TYPES, sample_task
from sim.tasks.task import BENCHMARK_PATH, Task, load_benchmark, tasks_text, write_tasks
from sim.world.world import WorldError

__all__ = ["Slot", "counts", "generate", "main", "moved", "rebuild", "slots"]

_LOG = logging.getLogger(__name__)

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


def _attempt(slot: Slot, seed: int) -> tuple[Task, tuple[Certificate, ...]]:
    """The task of a seed with its certificates.

    Raises:
        ValueError: when the seed makes no task, or one that is not certified.
        WorldError: when its objects do not fit.
    """
    return certified(sample_task(seed, slot.room, slot.family, "benchmark"))


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
            if seed not in tried:
                line: dict[str, Any] = {"seed": seed}
                try:
                    task, proofs = _attempt(slot, seed)
                    tried[seed] = task, proofs
                    line |= {"task": task.to_json(), "proofs": [proof.to_json() for proof in proofs]}
                except (ValueError, WorldError) as error:
                    tried[seed] = None
                    line["refused"] = f"{type(error).__name__}: {error}"
                log.write(json.dumps(line) + "\n")
                log.flush()
            candidate = tried[seed]
            if candidate is None:
                continue
            subjects = Counter(_subject(task) for task, _ in found)
            often = 1 + slot.count // 3
            words = {task.instruction for task, _ in found}
            if candidate[0].instruction not in words and subjects[_subject(candidate[0])] < often:
                found.append(candidate)
    return found


def _read(path: Path) -> dict[int, tuple[Task, tuple[Certificate, ...]] | None]:
    """What a slot has tried before, by seed; a last line that was cut short is left out."""
    tried: dict[int, tuple[Task, tuple[Certificate, ...]] | None] = {}
    if path.is_file():
        content = path.read_bytes()
        whole = content[: content.rfind(b"\n") + 1]
        if whole != content:
            path.write_bytes(whole)
        for line in whole.decode().splitlines():
            record = json.loads(line)
            proofs = tuple(Certificate.from_json(proof) for proof in record.get("proofs", ()))
            tried[record["seed"]] = (Task.from_json(record["task"]), proofs) if proofs else None
    return tried


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
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(workers, context, start_worker) as pool:
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


def rebuild(task: Task, solve: bool) -> tuple[Task, tuple[Certificate, ...]]:
    """The task as its seed makes it today.

    Args:
        task: a task of the benchmark.
        solve: whether the time limit comes from the expert again, or is taken over.

    Raises:
        Refusal: when the expert does not solve it any more as its category says.
    """
    fresh = sample_task(task.seed, task.room, task.family, "benchmark")
    if not solve:
        return replace(fresh, time_limit=task.time_limit), ()
    try:
        return certified(fresh)
    except Refusal as refusal:
        raise Refusal(f"{task.id}: {refusal}") from refusal


def _rebuilt(arguments: tuple[Task, bool]) -> tuple[Task | str, tuple[Certificate, ...]]:
    try:
        return rebuild(*arguments)
    except (ValueError, WorldError) as error:
        return f"{arguments[0].id}: {error}", ()


def _check(solve: bool) -> Iterator[str]:
    """Differences between the files and what their seeds make."""
    tasks = load_benchmark()
    with ProcessPoolExecutor(2, multiprocessing.get_context("spawn"), start_worker) as pool:
        results = pool.map(_rebuilt, [(task, solve) for task in tasks])
        rebuilt = list(tqdm(results, total=len(tasks), desc="check", unit="task"))
    yield from (str(new) for new, _ in rebuilt if isinstance(new, str))
    changed = [old.id for old, (new, _) in zip(tasks, rebuilt, strict=True) if not isinstance(new, str) and old != new]
    if changed:
        yield f"{BENCHMARK_PATH.name}: differs for {', '.join(changed)}"
    if tasks_text(tasks) != BENCHMARK_PATH.read_text(encoding="utf-8"):
        yield f"{BENCHMARK_PATH.name}: differs in its formatting"
    if solve:
        text = certificates_text([proof for _, proofs in rebuilt for proof in proofs])
        if text != CERTIFICATES_PATH.read_text(encoding="utf-8"):
            yield f"{CERTIFICATES_PATH.name}: differs"


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


def _digest() -> str:
    """Hash of everything that decides what the simulator does."""
    digest = hashlib.sha256()
    root = Path(sim.__file__).parent
    for path in sorted(p for p in root.rglob("*") if p.suffix in (".py", ".yaml", ".xml", ".csv", ".stl")):
        digest.update(path.relative_to(root).as_posix().encode() + path.read_bytes())
    return digest.hexdigest()[:12]


@dataclass(frozen=True)
class BenchmarkConfig:
    """What is done with the benchmark.

    Attributes:
        do: `check_fast` draws every task again and compares the files, `check` solves them again, too, `table` prints the
            certificates per family and robot, `generate` writes both files anew.
        workers: processes of `generate`.
        tried: folder of what `generate` has tried; outputs/tasks/HASH by default.
    """

    do: Literal["check_fast", "check", "table", "generate"] = "check_fast"
    workers: int = 2
    tried: str = ""


@command()
def main(arguments: Sequence[str]) -> int:
    """Command line; returns the exit code: 0, 1 when the files differ or slots stay empty, 2 for unknown arguments."""
    options = read_arguments(BenchmarkConfig, arguments)
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    if options.do == "table":
        sys.stdout.write(certificates_table(load_benchmark(), load_certificates()))
        return 0
    if options.do in ("check", "check_fast"):
        problems = list(_check(solve=options.do == "check"))
        sys.stdout.write(json.dumps(counts(load_benchmark())) + "\n")
        for problem in problems:
            sys.stderr.write(problem + "\n")
        return int(bool(problems))
    try:
        tasks, certificates = generate(Path(options.tried or Path("outputs/tasks") / _digest()), options.workers)
    except RuntimeError as error:
        sys.stderr.write(f"{error}\n")
        return 1
    write_tasks(tasks, BENCHMARK_PATH)
    write_text(CERTIFICATES_PATH, certificates_text(certificates))
    sys.stdout.write(json.dumps(counts(tasks)) + "\n")
    return 0
