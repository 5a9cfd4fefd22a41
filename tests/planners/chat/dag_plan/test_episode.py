"""A fixed graph in the real simulator: both arms at once need fewer steps and less time than one node after the other."""

from __future__ import annotations

import pytest

from configs.schema.robot import RobotConfig
from interface.episode import EpisodeRecord, Outcome
from proprio_mllm.evaluation.episode import EpisodeKeyFields, Limits, run_episode
from proprio_mllm.evaluation.sessions import open_session
from proprio_mllm.planners.chat.dag_plan.planner import DagPlanner
from proprio_mllm.planners.chat.options import ChatOptions
from sim.tasks.sample import sample_task
from sim.tasks.task import Task
from tests.planners.chat.dag_plan.graphs import carried, node, reply
from tests.planners.chat.script import Script

#: Budget that suffices one arm.
STEPS = 20


@pytest.fixture(scope="module")
def task() -> Task:
    """Sponge and tomato are taken out of a drawer and put on a counter."""
    return sample_task(22801, "kitchen_1", "fetch_two", "benchmark")


def episode(task: Task, parallel: bool) -> EpisodeRecord:
    nodes = [*carried("DishSponge_1", "Drawer_1", "CounterTop_1"), *carried("Tomato_1", "Drawer_1", "CounterTop_1")]
    picks = [one.model_copy(update={"after": ["open"]}) if one.item is None else one for one in nodes]
    planner = DagPlanner(
        Script([reply(node("open", "Open(Drawer_1)"), *picks)]), ChatOptions(image_size=64, reflection=False, parallel=parallel)
    )
    fields = EpisodeKeyFields("dag_plan", "h1", task.id, task.category, "easy", 0, 0, "c")

    def session() -> object:
        return open_session(RobotConfig("h1"), "easy", "fixed", task, 0, planner)

    return run_episode(session, planner, fields, task.instruction, Limits(STEPS, STEPS), 0)  # type: ignore[arg-type]


def test_both_arms_need_fewer_steps_and_less_time_in_the_simulator(task: Task) -> None:
    both, one = episode(task, parallel=True), episode(task, parallel=False)
    for record in (both, one):
        assert record.outcome is Outcome.SUCCESS, record.message or record.trace
        assert (record.planner_calls, record.invalid_output, record.reflections) == (1, 0, 0)
    assert both.steps < one.steps
    assert both.makespan_s < one.makespan_s
    assert both.arm_utilisation > one.arm_utilisation
    assert any("&" in str(entry["step"]) for entry in both.trace)
    assert not any("&" in str(entry["step"]) for entry in one.trace)
