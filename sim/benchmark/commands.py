"""The benchmark's files: drawn again, solved again, brought to the present physics, tabulated, or made anew.

    python -m sim benchmark                # do=check_fast: draws every task again from its seed and compares
    python -m sim benchmark do=check       # the same, and solves every task again and lists the facts that drifted
    python -m sim benchmark do=refresh     # brings certificates to the present physics; family=lift robot=x1 for a part
    python -m sim benchmark do=table       # the certificates per family and robot, as Markdown
    python -m sim benchmark do=generate    # searches all tasks anew, which takes hours

All but `table` print counts per category, family, room, split and type as JSON. Certificates of another physics are a warning,
and an error with `release=true`.
"""

from __future__ import annotations

import json
import logging
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final, Literal

from tqdm import tqdm

from configs.arguments import command, read_arguments
from configs.validate import allowed_values
from data.files import write_text
from data.workers import worker_pool
from interface.bodies import PAPER_ROBOTS
from sim.benchmark.certificates import (
    CERTIFICATES_PATH,
    Certificate,
    certificates_table,
    certificates_text,
    load_certificates,
)
from sim.benchmark.composition import COMPOSITION
from sim.benchmark.generate import counts, generate
from sim.benchmark.refresh import drift, refresh, solve_again
from sim.scene.compiler import PHYSICS
from sim.tasks.sample import sample_task
from sim.tasks.task import BENCHMARK_PATH, Task, load_benchmark, tasks_text, write_tasks
from sim.world.world import WorldError

logger = logging.getLogger(__name__)

_KEPT: Final = Path("outputs/tasks")


@dataclass(frozen=True)
class BenchmarkConfig:
    """What is done with the benchmark.

    Attributes:
        do: see `python -m sim benchmark --help`.
        family: of `check` and `refresh`: tasks of this family; all by default.
        robot: of `check` and `refresh`: certificates of this robot; both by default.
        workers: processes.
        kept: folder of what has been tried and solved; outputs/tasks/physics-N by default.
        release: whether certificates of another physics are an error.
    """

    do: Literal["check_fast", "check", "refresh", "table", "generate"] = "check_fast"
    family: str | None = None
    robot: str | None = None
    workers: int = 2
    kept: str = ""
    release: bool = False

    def __post_init__(self) -> None:
        families = sorted(share.family for share in COMPOSITION if share.count)
        for name, value, allowed in (("family", self.family, families), ("robot", self.robot, PAPER_ROBOTS)):
            if value is not None and value not in allowed:
                raise ValueError(f"{name}: {value!r} is not allowed; {allowed_values(value, allowed)}")


def stale_note(proofs: Sequence[Certificate]) -> str:
    """How many certificates are of another physics than the present one; empty when none is."""
    stale = [proof for proof in proofs if proof.stale]
    if not stale:
        return ""
    made = ", ".join(map(str, sorted({proof.physics for proof in stale})))
    return (
        f"{len(stale)} of {len(proofs)} certificates were made with physics {made}, the present one is {PHYSICS}; "
        "`python -m sim benchmark do=refresh` makes them again"
    )


def rebuild(task: Task) -> Task:
    """The task as its seed makes it today, with its own time limit.

    Raises:
        ValueError: when its seed makes no task.
        WorldError: when its objects do not fit.
    """
    return replace(sample_task(task.seed, task.room, task.family, "benchmark"), time_limit=task.time_limit)


def _differs(task: Task) -> str:
    """How a task differs from what its seed makes; empty when it does not."""
    try:
        return "" if rebuild(task) == task else f"{task.id}: its seed makes another task"
    except (ValueError, WorldError) as error:
        return f"{task.id}: {error}"


def _check(tasks: Sequence[Task], workers: int) -> list[str]:
    """Differences between the file of tasks and what its seeds make."""
    with worker_pool(workers) as pool:
        found = tqdm(pool.map(_differs, tasks, chunksize=8), total=len(tasks), desc="draws", unit="task")
        problems = [problem for problem in found if problem]
    if tasks_text(tasks) != BENCHMARK_PATH.read_text(encoding="utf-8"):
        problems.append(f"{BENCHMARK_PATH.name}: differs in its formatting")
    return problems


@command()
def main(arguments: Sequence[str]) -> int:
    """Command line; returns the exit code: 0, 1 when files differ or tasks are missing, 2 for unknown arguments."""
    options = read_arguments(BenchmarkConfig, arguments)
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    tasks, certificates = load_benchmark(), load_certificates()
    robots = PAPER_ROBOTS if options.robot is None else (options.robot,)
    kept = Path(options.kept or _KEPT / f"physics-{PHYSICS}")
    solved = kept / "solved.jsonl"  # until a refresh has written its result
    problems: list[str] = []
    try:
        if options.do == "table":
            sys.stdout.write(certificates_table(tasks, certificates))
            return 0
        if options.do == "generate":
            made, proofs = generate(kept, options.workers)
        elif options.do == "refresh":
            made, proofs, replaced = refresh(tasks, certificates, robots, options.family, options.workers, solved)
            for line in replaced:
                logger.info("%s", line)
        else:
            problems = _check(tasks, options.workers)
            chosen = [task for task in tasks if options.family in (None, task.family)]
            if options.do == "check":
                again = solve_again(chosen, certificates, robots, options.workers)
                for task, now in zip(chosen, again, strict=True):
                    problems += drift(task, [proof for proof in certificates if proof.task == task.id], now)
            note = stale_note(certificates)
            if note and options.release:
                problems.append(note)
            elif note:
                logger.warning("%s", note)
            made, proofs = None, []
    except RuntimeError as error:
        sys.stderr.write(f"{error}\n")
        return 1
    if made is not None:
        write_tasks(made, BENCHMARK_PATH)
        write_text(CERTIFICATES_PATH, certificates_text(proofs))
        solved.unlink(missing_ok=True)
    sys.stdout.write(json.dumps(counts(made or tasks)) + "\n")
    for problem in problems:
        sys.stderr.write(problem + "\n")
    return int(bool(problems))
