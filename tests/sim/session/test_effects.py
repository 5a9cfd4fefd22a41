"""What the table of actions promises is what physics does: states folded from a log against the simulated world."""

from __future__ import annotations

import pytest

from interface.bodies import Arm
from interface.effects import Condition
from interface.symbolic import SymbolicState
from sim.expert.expert import Expert
from sim.session.session import Session
from sim.tasks.sample import TRAIN_SEEDS, sample_task
from sim.tasks.task import Task, load_benchmark

#: Families with tools, liquids, two-handed loads and doors that fall shut, and seeds of tasks that the expert solves.
FAMILIES = ("slice_steady", "store_ajar", "carry", "clean", "use_up", "fetch_two", "pick_and_toggle_on")
SAMPLED = ("fill", "pour_hold")


def check(state: SymbolicState, session: Session) -> None:
    """Every fact that the log tells holds in the world."""
    world, hands = session.world, session.body.hands
    assert state.lifted == hands.lifted
    if hands.lifted is None:
        assert {arm: state.held[arm] for arm in Arm} == dict(hands.held)
    for name, carrier in state.at.items():
        assert carrier in world.containment.parents(name)
    truth = {
        Condition.OPEN: lambda obj: obj.is_open,
        Condition.ON: lambda obj: obj.is_toggled,
        Condition.SLICED: lambda obj: obj.state.isSliced,
        Condition.DIRTY: lambda obj: obj.state.isDirty,
        Condition.USED_UP: lambda obj: obj.state.isUsedUp,
        Condition.FILLED: lambda obj: obj.state.isFilledWithLiquid,
    }
    for condition, known in state.conditions.items():
        for name, value in known.items():
            assert truth[condition](world.objects[name]) is value, (condition, name)


@pytest.mark.parametrize("family", FAMILIES)
def test_effects_of_the_table_hold_in_physics(family: str) -> None:
    assert acted(next(task for task in load_benchmark() if task.id.startswith(f"benchmark_{family}_")))


@pytest.mark.parametrize("family", SAMPLED)
def test_effects_hold_in_families_of_training_too(family: str) -> None:
    tasks = (sample_task(TRAIN_SEEDS.start + seed, family=family, robots=("h1",)) for seed in range(6))
    assert any(acted(task) for task in tasks)


def acted(task: Task) -> bool:
    """Acts a task out with the expert and compares after every step; whether the goals held at the end."""
    session = Session("h1", image_size=0)
    session.reset(task, seed=task.seed)
    expert = Expert(session)
    expert.reset()
    shutting = {name for name, obj in session.world.objects.items() if obj.self_closing}
    state = SymbolicState(self_closing=shutting)
    while not session.finished:
        step = expert.next_step()
        if step.actions[0].name == "Done":
            break
        _, feedback = session.step(step)
        for outcome in feedback.outcomes:
            if outcome.success:
                state.succeed(outcome.action)
        if feedback.success:
            check(state, session)
    session.close()
    return session.succeeded
