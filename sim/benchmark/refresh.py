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
    """Tasks and certificates with the present physics, and what was replaced; those that have it already stand.

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
    stale = {proof.task for proof in certificates if proof.stale}
    chosen = [task for task in tasks if task.id in stale and family in (None, task.family)]
    again = dict(zip((task.id for task in chosen), solve_again(chosen, certificates, robots, workers, kept), strict=True))
    solved = {name: now for name, now in again.items() if not isinstance(now, str)}
    refused = [task for task in chosen if task.id not in solved]
    standing = [solved[task.id][0] if task.id in solved else task for task in tasks if task not in refused]
    with worker_pool(workers) as pool:
        found = pool.map(_stand_in, refused, [tuple(standing)] * len(refused))
        for task, drawn in tqdm(zip(refused, found, strict=True), total=len(refused), desc="stand-ins", unit="task"):
            if drawn is not None and not _new(drawn[0], standing):  # it stands in for another one already
                drawn = _stand_in(task, standing, drawn[0])
            if drawn is None:
                raise RuntimeError(f"{task.id} is solved no more, and no seed of {task.family} stands in for it")
            _keep(kept, task, robots, drawn)
            standing.append(drawn[0])
            solved[task.id] = drawn
    old = {task.id: (task, tuple(proof for proof in certificates if proof.task == task.id)) for task in tasks}
    now = [solved.get(task.id, old[task.id]) for task in tasks]
    replaced = [
        f"{task.id}: {why if isinstance(why := again[task.id], str) else 'solved no more'}; {made.id} stands in"
        for task, (made, _) in zip(tasks, now, strict=True)
        if made.id != task.id  # perhaps found before the refresh was stopped
    ]
    return [made for made, _ in now], [proof for _, proofs in now for proof in proofs], replaced


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


def _stand_in(task: Task, others: Sequence[Task], after: Task | None = None) -> tuple[Task, tuple[Certificate, ...]] | None:
    """The first draw, or the first after a given one, that may take a task's place beside others, with its certificates."""
    draws = [draw for draw in more_seeds(task) if draw[1] != task.seed]
    for room, seed in draws if after is None else draws[draws.index((after.room, after.seed)) + 1 :]:
        try:
            fresh = sample_task(seed, room, task.family, "benchmark")
            if _new(fresh, others):
                return certified(fresh)
        except (ValueError, WorldError):
            continue
    return None


def _new(task: Task, others: Sequence[Task]) -> bool:
    """Whether a task is none of the others and makes them more varied."""
    slot = [other for other in others if (other.family, other.room) == (task.family, task.room)]
    return task.seed not in {other.seed for other in others} and fits(task, slot, len(slot) + 1)


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
