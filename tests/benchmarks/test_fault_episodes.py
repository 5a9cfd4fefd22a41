"""Episodes with a known mistake: how they are drawn, what faulty planners do, and a few acted out in the simulator."""

from __future__ import annotations

import dataclasses
from collections import Counter

import numpy as np
import pytest

from benchmarks.attribution import validate
from benchmarks.fault_episodes import Cell, CellRunner, cells, drawn, read_plans
from benchmarks.fault_injection import CAUSES, LATE_SLIPS, SLIPS, FaultyPlanner
from interface.actions import ActionKind
from interface.episode import Outcome
from interface.failures import FailureCategory
from interface.steps import PlanStep
from proprio_mllm.evaluation.privileged import PrivilegedPlanner
from proprio_mllm.planners.protocol import Planner, TaskInfo
from sim.tasks.task import load_benchmark

TASKS = load_benchmark()
PLANS = read_plans()

#: A few quick ones with the family they are acted out in: every type on both robots.
QUICK = (
    ("stops short", "x1", "pick"),
    ("walks blindly", "h1", "lift"),
    ("stretches", "h1", "open"),
    ("crouches", "x1", "open"),
    ("never bends", "h1", "lift"),
    ("stops early", "x1", "place"),
    ("opposite action", "h1", "toggle_off"),
    ("babbles", "x1", "lift"),
)


def test_every_type_has_causes_and_a_default_validation_is_large_enough() -> None:
    kinds = Counter(cause.category for cause in CAUSES.values())
    assert set(kinds) == set(FailureCategory) and min(kinds.values()) >= 5
    assert set(LATE_SLIPS) < set(SLIPS)
    wanted = cells(("h1", "x1"), 1)
    assert {cell.cause for cell in wanted} == set(CAUSES)
    assert sum(cell.count for cell in wanted) >= 72
    by_kind = Counter[FailureCategory]()
    for cell in wanted:
        by_kind[CAUSES[cell.cause].category] += cell.count
    assert min(by_kind.values()) >= 30


@pytest.mark.parametrize("robot", ["h1", "x1"])
@pytest.mark.parametrize("cause", CAUSES)
def test_drawing_follows_the_seed_and_changes_family(cause: str, robot: str) -> None:
    found = drawn(Cell(cause, robot, 2, 3), TASKS, PLANS)
    assert found == drawn(Cell(cause, robot, 2, 3), TASKS, PLANS)
    assert found, "some task of the benchmark can meet every fault"
    assert len({episode.task for episode in found}) == len(found)
    families = {task.family for task in TASKS if task.id in {episode.task for episode in found}}
    first = [episode.family for episode in found[: len(families)]]
    assert len(set(first)) == len(first), "no family comes twice before every one has come"
    assert all(episode.slip in SLIPS or episode.slip is None for episode in found)
    assert all(episode.slip in LATE_SLIPS for episode in found if episode.late)


def test_drawing_needs_no_particular_tasks() -> None:
    renamed = [dataclasses.replace(task, id=f"other_{number}") for number, task in enumerate(TASKS)]
    plans = {(new.id, robot): PLANS[old.id, robot] for new, old in zip(renamed, TASKS, strict=True) for robot in ("h1", "x1")}
    cell = Cell("steps back", "h1", 3, 0)
    assert [one.family for one in drawn(cell, renamed, plans)] == [one.family for one in drawn(cell, TASKS, PLANS)]
    assert drawn(cell, TASKS, {}) == []


def test_mistaken_goals_differ_from_the_tasks_and_can_be_judged() -> None:
    rng = np.random.default_rng(0)
    met = Counter[str]()
    for name, cause in CAUSES.items():
        if cause.believes is None:
            continue
        for task in TASKS:
            goals = cause.believes(task, rng)
            if goals is None:
                continue
            met[name] += 1
            assert goals and goals != task.goals
            named = {each for goal in goals for each in goal.object_ids()}
            placed = {placement.object_id for placement in task.placements}
            known = placed | {placement.receptacle for placement in task.placements}
            own = {each for goal in task.goals for each in goal.object_ids()}
            assert named <= known | own
    assert set(met) == {"wrong object", "wrong receptacle", "forgets a goal"}
    assert min(met.values()) >= 5


def test_a_faulty_planner_is_a_privileged_planner_that_needs_a_session() -> None:
    planner = FaultyPlanner(TASKS[0], "steps back")
    assert isinstance(planner, Planner) and isinstance(planner, PrivilegedPlanner)
    with pytest.raises(RuntimeError, match="attach"):
        planner.reset(TaskInfo("x", "h1", 1), np.random.default_rng(0))


@pytest.mark.slow
def test_known_mistakes_get_their_type() -> None:
    results = [
        result
        for cause, robot, family in QUICK
        for result in CellRunner([task for task in TASKS if task.family == family])(Cell(cause, robot, 1, 2))
    ]
    assert not [result.record.message for result in results if result.record.outcome is Outcome.INFRASTRUCTURE_ERROR]
    found = validate(results)
    assert found.episodes >= len(QUICK) - 1  # a small family may not meet a fault
    assert {true for true, _ in found.matrix} == set(FailureCategory)
    assert found.agreed == found.episodes
    assert found.flags_agree
    for result in results:  # the mistakes were made, not merely recorded
        steps = [str(step["step"]) for step in result.record.trace]
        if result.counts and result.episode.cause == "babbles":
            assert result.record.invalid_output >= 1
        if result.counts and result.episode.cause == "walks blindly":
            assert steps.count("MoveAhead(5)") >= 2
        if result.counts and result.episode.cause == "stops early":
            assert steps[-1] == "Done()"
            kinds = {action.spec.kind for step in steps[:-1] if "(" in step for action in PlanStep.parse(step).actions}
            assert kinds & {ActionKind.ARM, ActionKind.TWO_ARM}
