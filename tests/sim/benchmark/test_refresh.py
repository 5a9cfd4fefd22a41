"""Certificates follow physics: what drifted is listed, what is kept is not solved again, what is refused is replaced."""

from __future__ import annotations

import dataclasses
import json
import warnings
from pathlib import Path

import pytest

from interface.bodies import PAPER_ROBOTS
from sim.benchmark import commands
from sim.benchmark.certificates import Certificate, load_certificates
from sim.benchmark.commands import main, stale_note
from sim.benchmark.refresh import _new, drift, refresh, solve_again
from sim.scene.compiler import PHYSICS
from sim.tasks.task import Task, load_benchmark

TASKS = tuple(task for task in load_benchmark() if task.family == "pick")
PROOFS = tuple(
    dataclasses.replace(proof, physics=PHYSICS - 1)
    for proof in load_certificates()
    if proof.task in {task.id for task in TASKS}
)


def kept(path: Path, refused: str = "", **change: object) -> Path:
    """A file in which every task is solved as its certificates say, but for one."""
    lines = []
    for task in TASKS:
        own = [proof.to_json() | change for proof in PROOFS if proof.task == task.id]
        result = {"refused": "x1 does not solve it"} if task.id == refused else {"task": task.to_json(), "proofs": own}
        lines.append(json.dumps({"id": task.id, "robots": list(PAPER_ROBOTS)} | result))
    path.write_text("\n".join(lines) + '\n{"id": "cut')
    return path


def test_a_refused_task_makes_room_for_a_fresh_draw_and_the_rest_is_not_solved_again(tmp_path: Path) -> None:
    gone = TASKS[3]
    file = kept(tmp_path / "solved.jsonl", refused=gone.id)
    tasks, proofs, replaced = refresh(TASKS, PROOFS, PAPER_ROBOTS, None, 1, file)
    (index,) = [number for number, (old, new) in enumerate(zip(TASKS, tasks, strict=True)) if old != new]
    fresh = tasks[index]
    assert index == 3 and (fresh.family, fresh.room) == (gone.family, gone.room) and fresh.seed != gone.seed
    assert fresh.instruction not in {task.instruction for task in TASKS}
    assert [(proof.task, proof.robot) for proof in proofs] == [(task.id, robot) for task in tasks for robot in PAPER_ROBOTS]
    assert {proof.physics for proof in proofs if proof.task == fresh.id} == {PHYSICS}
    assert replaced == [f"{gone.id}: x1 does not solve it; {fresh.id} stands in"]


def test_a_draw_that_stands_in_for_one_task_stands_in_for_no_other() -> None:
    first, others = TASKS[0], TASKS[1:]
    assert _new(first, others)
    assert not _new(first, TASKS)
    assert not _new(dataclasses.replace(first, seed=-1), TASKS), "nor does one with the same words"


def test_certificates_of_the_present_physics_stand(tmp_path: Path) -> None:
    present = [dataclasses.replace(proof, physics=PHYSICS) for proof in PROOFS]
    assert refresh(TASKS, present, PAPER_ROBOTS, None, 1, tmp_path / "none.jsonl") == (list(TASKS), present, [])


def test_another_family_stands_as_it_is(tmp_path: Path) -> None:
    assert refresh(TASKS, PROOFS, PAPER_ROBOTS, "lift", 1, tmp_path / "none.jsonl") == (list(TASKS), list(PROOFS), [])


def test_solving_again_gives_the_same_facts(tmp_path: Path) -> None:
    (solved,) = solve_again(TASKS[:1], PROOFS, ("h1",), 1, tmp_path / "solved.jsonl")
    assert not isinstance(solved, str)
    assert not list(drift(TASKS[0], PROOFS[:2], solved))
    assert [proof.robot for proof in solved[1]] == list(PAPER_ROBOTS)
    assert solved[1][0].physics == PHYSICS and solved[1][1].physics == PROOFS[1].physics, "the other robot's certificate stands"
    (again,) = solve_again(TASKS[:1], PROOFS, ("h1",), 1, tmp_path / "solved.jsonl")
    assert not isinstance(again, str)
    assert again[0] == solved[0] and [proof.to_json() for proof in again[1]] == [proof.to_json() for proof in solved[1]]


@pytest.mark.parametrize(
    ("change", "found"),
    [
        ({}, None),
        ({"plan": ("Done()",) * 4}, None),
        ({"plan": ("Done()",) * 6}, "6 steps, certified 3"),
        ({"one_arm_steps": {"left": 5, "right": 3}}, None),
        ({"one_arm_steps": {"left": None, "right": 3}}, "left arm alone None steps, certified 3"),
        ({"one_arm_steps": {"left": 3, "right": 9}}, "right arm alone 9 steps, certified 3"),
    ],
)
def test_facts_drift_and_the_rest_does_not_matter(change: dict[str, object], found: str | None) -> None:
    task: Task = TASKS[0]
    old: Certificate = dataclasses.replace(PROOFS[0], plan=("Done()",) * 3, one_arm_steps={"left": 3, "right": 3})
    values: dict[str, object] = {"makespan_s": 99.0, "path_length_m": 0.0, **change}
    now = dataclasses.replace(old, **values)  # type: ignore[arg-type]
    told = list(drift(task, [old], (task, (now,))))
    assert (not told) if found is None else (len(told) == 1 and found in told[0])


def test_a_task_that_is_refused_has_drifted() -> None:
    assert list(drift(TASKS[0], PROOFS[:2], "x1 does not solve it")) == [f"{TASKS[0].id}: x1 does not solve it"]


def test_certificates_are_of_the_present_physics() -> None:
    """A warning between releases; `make release-check` makes it an error."""
    if note := stale_note(load_certificates()):
        warnings.warn(note, stacklevel=1)


def test_stale_certificates_are_an_error_of_a_release(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(commands, "_check", lambda tasks, workers: [])
    monkeypatch.setattr(commands, "load_certificates", lambda: [dataclasses.replace(proof, physics=0) for proof in PROOFS])
    assert main([]) == 0
    assert main(["release=true"]) == 1
    assert f"28 of 28 certificates were made with physics 0, the present one is {PHYSICS}" in capsys.readouterr().err
    assert main(["family=knit"]) == 2
    assert "family: 'knit' is not allowed; allowed: carry" in capsys.readouterr().err
