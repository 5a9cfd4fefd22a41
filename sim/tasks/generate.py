"""Generates the benchmark: tasks that the expert has solved on every robot, with budgets from its plans.

    python -m sim.tasks.generate               # writes benchmark.jsonl and certificates.jsonl
    python -m sim.tasks.generate --check       # rebuilds every task from its seed, solves it again, compares bytes
    python -m sim.tasks.generate --check-fast  # the same without solving: budgets are taken as they are

Each slot (family and room) tries its seeds in order and keeps the first tasks that both robots solve at difficulty easy within
a sensible number of steps. Step budget: 1.5 times the longer plan, rounded up, plus 2. A certificate holds each robot's plan.

Choices within the paper's categories: `essential` tasks lift or carry something that needs two hands, or end with one object
in each hand; doors here have no closing spring, so holding a door open while storing is no essential task.
"""

from __future__ import annotations

import json
import logging
import multiprocessing
import sys
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from data.files import write_text
from sim.tasks.sample import ROBOTS, sample_task, typical_steps
from sim.tasks.task import BENCHMARK_PATH, MAX_STEPS, Task, load_benchmark, tasks_text, write_tasks

__all__ = ["CERTIFICATES_PATH", "SLOTS", "Certificate", "Slot", "budget_of", "certify", "generate", "main", "rebuild"]

_LOG = logging.getLogger(__name__)

CERTIFICATES_PATH: Final = Path(__file__).parent / "certificates.jsonl"
_SEEDS_PER_SLOT: Final = 1000
_TRIES: Final = 40
#: Steps beyond the family's typical number that a certified plan may take.
_EXTRA_STEPS: Final = 5
_SEARCH_BUDGET: Final = 30


@dataclass(frozen=True, slots=True)
class Slot:
    """A family in a room, and how many tasks of it the benchmark has."""

    family: str
    room: str
    count: int


#: The benchmark's composition: 12 tasks per category.
SLOTS: Final = (
    Slot("pick", "kitchen_1", 2),
    Slot("pick", "living_room_1", 1),
    Slot("place", "kitchen_1", 2),
    Slot("place", "living_room_1", 1),
    Slot("open", "kitchen_1", 1),
    Slot("open", "living_room_1", 1),
    Slot("close", "kitchen_1", 1),
    Slot("toggle_on", "kitchen_1", 1),
    Slot("toggle_on", "living_room_1", 1),
    Slot("toggle_off", "kitchen_1", 1),
    Slot("transport_two", "kitchen_1", 2),
    Slot("pick_and_toggle_off", "kitchen_1", 1),
    Slot("transport_each", "kitchen_1", 1),
    Slot("pick_and_toggle_on", "kitchen_1", 1),
    Slot("fetch_hold", "kitchen_1", 1),
    Slot("pick_and_open", "kitchen_1", 1),
    Slot("pick_and_open", "living_room_1", 1),
    Slot("fetch", "kitchen_1", 1),
    Slot("fetch_hold", "living_room_1", 1),
    Slot("stow", "living_room_1", 1),
    Slot("stow_close", "kitchen_1", 1),
    Slot("lift", "kitchen_1", 2),
    Slot("lift", "living_room_1", 2),
    Slot("carry", "kitchen_1", 1),
    Slot("carry", "living_room_1", 2),
    Slot("hold_two", "kitchen_1", 2),
    Slot("hold_two", "living_room_1", 2),
    Slot("carry_and_toggle", "living_room_1", 1),
)


@dataclass(frozen=True, slots=True)
class Certificate:
    """Proof that a robot can solve a task.

    Attributes:
        task: task id.
        robot: robot name.
        plan: the expert's steps.
        makespan_s: simulated seconds.
        path_length_m: length of the base's path.
        arm_utilisation: mean fraction of arm-steps in which an arm acted.
    """

    task: str
    robot: str
    plan: tuple[str, ...]
    makespan_s: float
    path_length_m: float
    arm_utilisation: float

    def to_json(self) -> dict[str, Any]:
        """Plain form; simulated quantities are rounded, steps are exact."""
        return {
            "task": self.task,
            "robot": self.robot,
            "steps": len(self.plan),
            "plan": list(self.plan),
            "makespan_s": round(self.makespan_s, 1),
            "path_length_m": round(self.path_length_m, 1),
            "arm_utilisation": round(self.arm_utilisation, 3),
        }


def budget_of(steps: Sequence[int]) -> int:
    """Step budget from the numbers of steps that the expert took on the robots."""
    return min(MAX_STEPS, int(np.ceil(1.5 * max(steps))) + 2)


def certify(task: Task, robot: str) -> Certificate | None:
    """The expert's solution on a robot at difficulty easy, None when it fails."""
    from sim.expert import Expert
    from sim.session import Session

    session = Session(robot, "easy", image_size=0)
    try:
        session.reset(task, seed=task.seed)
        expert = Expert(session)
        expert.reset()
        while not session.finished:
            session.step(expert.next_step())
        stats = session.stats
        plan = tuple(item.step for item in session.history)
        if not session.succeeded or plan[-1] == "Done()":
            return None
        return Certificate(task.id, robot, plan, stats.makespan_s, stats.path_length_m, stats.arm_utilisation)
    finally:
        session.close()


def _solved(task: Task) -> tuple[Task, tuple[Certificate, ...]] | None:
    """The task with its budget and certificates, None when some robot fails or needs too long."""
    limit = typical_steps(task.family) + _EXTRA_STEPS
    found: list[Certificate] = []
    for robot in ROBOTS:
        certificate = certify(replace(task, step_budget=min(limit, _SEARCH_BUDGET)), robot)
        if certificate is None:
            return None
        found.append(certificate)
    return replace(task, step_budget=budget_of([len(c.plan) for c in found])), tuple(found)


def _fill(number: int, slot: Slot) -> list[tuple[Task, tuple[Certificate, ...]]]:
    """The slot's tasks, with different instructions."""
    found: list[tuple[Task, tuple[Certificate, ...]]] = []
    for seed in range(number * _SEEDS_PER_SLOT, number * _SEEDS_PER_SLOT + _TRIES * slot.count):
        if len(found) == slot.count:
            break
        try:
            task = sample_task(seed, slot.room, slot.family, "benchmark")
        except ValueError:
            continue
        if any(task.instruction == other.instruction for other, _ in found):
            continue
        solved = _solved(task)
        _LOG.info("%s seed %d: %s", slot, seed, "kept" if solved else "not solved")
        if solved is not None:
            found.append(solved)
    return found


def _fill_star(arguments: tuple[int, Slot]) -> list[tuple[Task, tuple[Certificate, ...]]]:
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    return _fill(*arguments)


def generate(workers: int = 2) -> tuple[list[Task], list[Certificate]]:
    """Searches all slots.

    Raises:
        RuntimeError: when a slot cannot be filled.
    """
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(workers, mp_context=context) as pool:
        filled = list(pool.map(_fill_star, enumerate(SLOTS)))
    tasks: list[Task] = []
    certificates: list[Certificate] = []
    for slot, found in zip(SLOTS, filled, strict=True):
        if len(found) < slot.count:
            raise RuntimeError(f"{slot}: only {len(found)} of {slot.count} tasks in {_TRIES * slot.count} seeds")
        for task, proofs in found:
            tasks.append(task)
            certificates.extend(proofs)
    return tasks, certificates


def rebuild(task: Task, solve: bool) -> tuple[Task, tuple[Certificate, ...]]:
    """The task as its seed makes it today.

    Args:
        task: a task of the benchmark.
        solve: whether the budget comes from the expert again, or is taken over.

    Raises:
        RuntimeError: when the expert does not solve it any more.
    """
    fresh = sample_task(task.seed, task.room, task.family, "benchmark")
    if not solve:
        return replace(fresh, step_budget=task.step_budget), ()
    solved = _solved(fresh)
    if solved is None:
        raise RuntimeError(f"{task.id}: the expert does not solve it any more")
    return solved


def _rebuild_star(arguments: tuple[Task, bool]) -> tuple[Task, tuple[Certificate, ...]]:
    return rebuild(*arguments)


def _certificates_text(certificates: Sequence[Certificate]) -> str:
    return "".join(json.dumps(certificate.to_json()) + "\n" for certificate in certificates)


def _check(solve: bool) -> Mapping[str, str]:
    """Differences between the files and what their seeds make, by file name."""
    tasks = load_benchmark()
    with ProcessPoolExecutor(2, mp_context=multiprocessing.get_context("spawn")) as pool:
        rebuilt = list(pool.map(_rebuild_star, [(task, solve) for task in tasks]))
    problems: dict[str, str] = {}
    if tasks_text([task for task, _ in rebuilt]) != BENCHMARK_PATH.read_text(encoding="utf-8"):
        changed = [old.id for old, (new, _) in zip(tasks, rebuilt, strict=True) if old != new]
        problems[BENCHMARK_PATH.name] = f"differs for {', '.join(changed) or 'its formatting'}"
    if solve:
        text = _certificates_text([proof for _, proofs in rebuilt for proof in proofs])
        if text != CERTIFICATES_PATH.read_text(encoding="utf-8"):
            problems[CERTIFICATES_PATH.name] = "differs"
    return problems


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit code."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    if words in (["--check"], ["--check-fast"]):
        problems = _check(solve=words == ["--check"])
        for name, problem in problems.items():
            sys.stderr.write(f"{name}: {problem}\n")
        return int(bool(problems))
    if words:
        sys.stderr.write(f"unknown arguments {words}; allowed: --check, --check-fast\n")
        return 2
    tasks, certificates = generate()
    write_tasks(tasks, BENCHMARK_PATH)
    write_text(CERTIFICATES_PATH, _certificates_text(certificates))
    sys.stdout.write(f"{len(tasks)} tasks, {len(certificates)} certificates\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
