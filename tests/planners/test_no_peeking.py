"""A planner sees observations only: with everything else of the simulator scrambled, what it asks and answers is the same.

An episode is run and what the planner was shown is kept. In a second one the planner is shown the same, while the simulator
behind it has every object and joint somewhere else, other goals and other contingencies. The expert, which looks, is caught.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
import pytest

from configs.schema.planner import ModelPlanner
from interface.feedback import Feedback
from interface.observation import Observation
from interface.steps import PlanStep
from proprio_mllm.backends.protocol import ChatRequest
from proprio_mllm.evaluation.episode import EpisodeKeyFields, GoalReport, Limits, RunnableSession, Stats, run_episode
from proprio_mllm.evaluation.privileged import ExpertPlanner
from proprio_mllm.evaluation.sessions import SimSession
from proprio_mllm.planners.chat.dag_plan.planner import DagPlanner
from proprio_mllm.planners.chat.options import ChatOptions
from proprio_mllm.planners.chat.plain import PlainPlanner
from proprio_mllm.planners.protocol import Planner
from proprio_mllm.planners.random_planner import RandomPlanner
from proprio_mllm.planners.registry import make_planner
from proprio_mllm.planners.scripted.planner import ScriptedPlanner
from sim.session.session import Session
from sim.tasks.predicates import Predicate
from sim.tasks.task import Placement, Start, Task
from tests.planners.chat.dag_plan.graphs import node, reply
from tests.planners.chat.script import Script, plan, thought

TASK = Task(
    id="mug",
    room="kitchen_1",
    category="single",
    family="pick",
    instruction="Pick up the mug from the counter.",
    start=Start(0.0, 0.0, 0.0, {"h1": 0.95, "x1": 0.58}),
    placements=(Placement("Mug_1", "Mug", "CounterTop_1"), Placement("Apple_1", "Apple", "DiningTable_1")),
    goals=(Predicate("held", "Mug_1"),),
    time_limit=5,
    split="seen",
    seed=4,
)
WEIGHTS = Path(__file__).resolve().parents[2] / "weights/tiny/full"


class Kept:
    """A session that keeps what the planner is shown."""

    def __init__(self, inner: RunnableSession) -> None:
        self.inner = inner
        self.shown: list[tuple[Observation, Feedback | None]] = []

    def reset(self, seed: int) -> Observation:
        self.shown = [(self.inner.reset(seed), None)]
        return self.shown[0][0]

    def step(self, step: PlanStep) -> tuple[Observation, Feedback]:
        seen, feedback = self.inner.step(step)
        self.shown.append((seen, feedback))
        return seen, feedback

    def goals(self) -> GoalReport:
        return GoalReport((False,), frozenset())

    def stats(self) -> Stats:
        return self.inner.stats()

    def stance(self) -> tuple[float, float, float, float]:
        return self.inner.stance()

    def relations(self) -> Mapping[str, Sequence[str]]:
        return {}


class Scrambled(Kept):
    """Shows what another session has shown, and has a world of its own in which nothing is where it was."""

    def __init__(self, session: Session, shown: Sequence[tuple[Observation, Feedback | None]]) -> None:
        other = dataclasses.replace(TASK, goals=(Predicate("open", "Fridge_1"),), seed=9)
        super().__init__(SimSession(session, other))
        self.session, self.replayed = session, list(shown)
        self.rng = np.random.default_rng(0)

    def scramble(self) -> None:
        world = self.session.world
        world.data.qpos[:] += self.rng.normal(size=world.data.qpos.shape)
        world.data.qvel[:] = self.rng.normal(size=world.data.qvel.shape)
        world.model.body_mass[:] *= 2.0

    def reset(self, seed: int) -> Observation:
        self.inner.reset(seed + 1)
        self.scramble()
        return self.replayed.pop(0)[0]

    def step(self, step: PlanStep) -> tuple[Observation, Feedback]:
        self.scramble()
        seen, feedback = self.replayed.pop(0)
        assert feedback is not None
        return seen, feedback


def episode(planner: Planner, session: RunnableSession) -> list[str]:
    """Steps that the planner took."""
    fields = EpisodeKeyFields("p", "h1", "mug", "single", "easy", 0, 0, "c")
    record = run_episode(lambda: session, planner, fields, TASK.instruction, Limits.of(TASK.time_limit, "task"), 3)
    assert not record.message, record.message
    return [str(entry["step"]) for entry in record.trace]


def steps_of(request: ChatRequest) -> str:
    """A reply that depends on all of the prompt, so that a change anywhere in it shows."""
    number = sum(len(message.text) for message in request.messages) % 2
    step = ("GoTo(CounterTop_1)", "RotateLeft(45)")[number]
    return (thought if request.purpose == "reflection" else plan)(step)


def graph_of(request: ChatRequest) -> str:
    """A graph that depends on all of the prompt; its first node fails, so that there is something to reflect on."""
    number = sum(len(message.text) for message in request.messages) % 2
    nodes = (node("a", "ToggleOn(CounterTop_1)"), node("b", ("Open(Fridge_1)", "RotateLeft(45)")[number]))
    return reply(*nodes, cause="no switch", change="none")


def planners() -> dict[str, Callable[[list[Script]], Planner]]:
    def chat(
        kind: Callable[..., Planner], answer: Callable[[ChatRequest], str] = steps_of, **options
    ) -> Callable[[list[Script]], Planner]:
        def make(scripts: list[Script]) -> Planner:
            scripts.append(Script(answer))
            return kind(scripts[-1], ChatOptions(image_size=112, **options))

        return make

    return {
        "random": lambda scripts: RandomPlanner(112),
        "scripted": lambda scripts: ScriptedPlanner(112),
        "mllm": lambda scripts: make_planner(ModelPlanner("m", "mllm", "M", str(WEIGHTS))),
        "plain": chat(PlainPlanner, body=True),
        "dag_plan": chat(DagPlanner, graph_of),
    }


@pytest.fixture(scope="module")
def sessions() -> tuple[Session, Session]:
    return Session("h1", "easy", 112), Session("h1", "easy", 112)


@pytest.mark.parametrize("kind", sorted(planners()))
def test_calls_do_not_depend_on_what_is_not_shown(kind: str, sessions: tuple[Session, Session]) -> None:
    make, scripts = planners()[kind], list[Script]()
    kept = Kept(SimSession(sessions[0], TASK))
    first = episode(make(scripts), kept)
    second = episode(make(scripts), Scrambled(sessions[1], kept.shown))
    assert first == second
    assert len(first) == TASK.time_limit or first[-1] == "Done()"
    if scripts:
        assert scripts[0].requests == scripts[1].requests
        assert scripts[0].requests


def test_a_planner_that_looks_is_caught(sessions: tuple[Session, Session]) -> None:
    kept = Kept(SimSession(sessions[0], TASK))
    expert = ExpertPlanner(112)
    expert.attach(sessions[0])
    first = episode(expert, kept)
    expert.attach(sessions[1])
    scrambled = Scrambled(sessions[1], [*kept.shown, *kept.shown[-1:] * TASK.time_limit])
    fields = EpisodeKeyFields("p", "h1", "mug", "single", "easy", 0, 0, "c")
    record = run_episode(lambda: scrambled, expert, fields, TASK.instruction, Limits.of(TASK.time_limit, "task"), 3)
    assert [str(entry["step"]) for entry in record.trace] != first
