"""Solves the benchmark's tasks again: to bring their certificates to the present physics, or to see what drifted.

One-armed steps are solved again only where a plan has changed. A task that a robot no longer solves as its category says makes
room for a fresh draw of its family, in its room where that can be. What has been solved is kept, one line a task, so that it
goes on where it was stopped.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Final

from tqdm import tqdm

from data.workers import worker_pool
from sim.benchmark.certificates import Certificate, certified
from sim.benchmark.generate import fits, more_seeds, read_lines
from sim.tasks.sample import sample_task
from sim.tasks.task import Task
from sim.world.world import WorldError

#: A task with its certificates, or why it is none any more.
Solved = tuple[Task, tuple[Certificate, ...]] | str
#: Steps by which a plan may differ between two processors or versions of the physics: of both arms, of one.
_TOLERANCES: Final = (1, 2)

_Job = tuple[Task, Mapping[str, Certificate], Sequence[str]]


def solve_again(
    tasks: Sequence[Task], certificates: Sequence[Certificate], robots: Sequence[str], workers: int, kept: Path | None = None
) -> list[Solved]:
    """Solves tasks with the present physics.

    Args:
        tasks: what is solved.
        certificates: their certificates, of these and of any other tasks.
        robots: robots that solve them; for others the old certificates stand.
        workers: processes.
        kept: file of what has been solved; None keeps nothing.
    """
    old: dict[str, dict[str, Certificate]] = {}
    for proof in certificates:
        old.setdefault(proof.task, {})[proof.robot] = proof
    known = {} if kept is None else {(line["id"], *line["robots"]): _from_line(line) for line in read_lines(kept)}
    found = {task.id: known[task.id, *robots] for task in tasks if (task.id, *robots) in known}
    jobs: list[_Job] = [(task, old.get(task.id, {}), robots) for task in tasks if task.id not in found]
    with worker_pool(workers) as pool:
        results = zip(jobs, pool.map(_solved, jobs), strict=True)
        for (task, _, _), result in tqdm(results, total=len(tasks), initial=len(found), desc="tasks", unit="task"):
            found[task.id] = result
            if kept is not None:
                _keep(kept, task, robots, result)
    return [found[task.id] for task in tasks]


def refresh(
    tasks: Sequence[Task],
    certificates: Sequence[Certificate],
    robots: Sequence[str],
    family: str | None,
    workers: int,
    kept: Path,
) -> tuple[list[Task], list[Certificate], list[str]]:
    """Tasks and certificates with the present physics, and what was replaced.

    Args:
        tasks: the whole benchmark.
        certificates: of all of them.
        robots: robots that solve again.
        family: tasks that are solved again; all by default.
        workers: processes.
        kept: file of what has been solved.

    Raises:
        RuntimeError: when no seed stands in for a task; the message names it.
    """
    chosen = [task for task in tasks if family in (None, task.family)]
    result = dict(zip((task.id for task in chosen), solve_again(chosen, certificates, robots, workers, kept), strict=True))
    proofs = {task.id: [proof for proof in certificates if proof.task == task.id] for task in tasks}
    standing = [task for task in tasks if not isinstance(result.get(task.id), str)]
    made: list[Task] = []
    replaced: list[str] = []
    for task in tasks:
        now = result.get(task.id)
        if now is None:
            made.append(task)
            continue
        if isinstance(now, str):
            why, now = now, _replacement(task, [*standing, *made])
            _keep(kept, task, robots, now)
            replaced.append(f"{task.id}: {why}; {now[0].id} stands in")
        elif now[0].id != task.id:  # found before the refresh was stopped
            replaced.append(f"{task.id}: {now[0].id} stands in")
        made.append(now[0])
        proofs[now[0].id] = list(now[1])
    return made, [proof for task in made for proof in proofs[task.id]], replaced


def drift(task: Task, old: Sequence[Certificate], now: Solved) -> Iterator[str]:
    """Facts of a task's certificates that differ by more than a tolerance.

    Args:
        task: the task.
        old: its certificates.
        now: what it is when solved again.
    """
    if isinstance(now, str):
        yield f"{task.id}: {now}"
        return
    both, one = _TOLERANCES
    for before, after in zip(old, now[1], strict=True):
        first, second = len(before.plan), len(after.plan)
        if abs(first - second) > both or second > task.time_limit:
            yield f"{task.id} on {before.robot}: {second} steps, certified {first}, time limit {task.time_limit}"
        for arm, steps in before.one_arm_steps.items():
            again = after.one_arm_steps[arm]
            if (steps is None) != (again is None) or (steps is not None and again is not None and abs(steps - again) > one):
                yield f"{task.id} on {before.robot}: {arm} arm alone {again} steps, certified {steps}"


def _replacement(task: Task, others: Sequence[Task]) -> tuple[Task, tuple[Certificate, ...]]:
    used = {other.seed for other in others} | {task.seed}
    for room, seed in more_seeds(task):
        if seed in used:
            continue
        slot = [other for other in others if (other.family, other.room) == (task.family, room)]
        try:
            fresh = sample_task(seed, room, task.family, "benchmark")
            if fits(fresh, slot, len(slot) + 1):
                return certified(fresh)
        except (ValueError, WorldError):
            continue
    raise RuntimeError(f"{task.id} is solved no more, and no seed of {task.family} stands in for it")


def _solved(job: _Job) -> Solved:
    task, old, robots = job
    try:
        return certified(task, old, robots)
    except (ValueError, WorldError) as error:
        return str(error)


def _keep(kept: Path, task: Task, robots: Sequence[str], result: Solved) -> None:
    """Notes what a task has become: solved, refused, or another that stands in for it."""
    kept.parent.mkdir(parents=True, exist_ok=True)
    with kept.open("a", encoding="utf-8") as log:
        log.write(json.dumps({"id": task.id, "robots": list(robots)} | _to_line(result)) + "\n")


def _to_line(result: Solved) -> dict[str, object]:
    if isinstance(result, str):
        return {"refused": result}
    return {"task": result[0].to_json(), "proofs": [proof.to_json() for proof in result[1]]}


def _from_line(line: Mapping[str, object]) -> Solved:
    if "refused" in line:
        return str(line["refused"])
    return Task.from_json(line["task"]), tuple(Certificate.from_json(proof) for proof in line["proofs"])  # type: ignore[arg-type]
