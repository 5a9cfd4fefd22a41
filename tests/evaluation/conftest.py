"""A session without a simulator: one mug, one table, rules of a few lines."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from interface.failures import FailureCategory
from interface.feedback import ActionOutcome, Feedback
from interface.observation import Camera, Observation, Proprioception
from interface.steps import Action, PlanStep
from proprio_mllm.evaluation.episode import EpisodeKeyFields, GoalReport, Stats
from proprio_mllm.planners.protocol import PlannerReply, TaskInfo, parse_reply
from sim.tasks.predicates import Predicate
from sim.tasks.task import Placement, Start, Task


class FakeSession:
    """Pick works near the mug, but for the first `unlucky` times; the goal is that it is held. `broken` raises at that step;
    `drift` is how far each step takes it."""

    def __init__(self, robot: str = "h1", broken: int | None = None, unlucky: int = 0, drift: float = 0.0) -> None:
        self.robot, self.broken, self.unlucky, self.drift = robot, broken, unlucky, drift
        self.near = self.low = self.held = False
        self.count = 0

    def reset(self, seed: int) -> Observation:
        self.near = self.low = self.held = False
        self.count = 0
        self.noise = np.random.default_rng(seed)
        return self.observation()

    def observation(self) -> Observation:
        image = self.noise.integers(0, 255, (28, 28, 3), dtype=np.uint8)
        body = Proprioception(np.zeros((64, 48), np.float32), 20.0, np.zeros(3), np.zeros((14, 3)))
        camera = Camera(np.eye(3), np.eye(4), 28, 28)
        return Observation("pick up the mug", self.robot, image, camera, ("Mug_1",), ("Mug_1", "Table_1"), body, (), 99, 99)

    def step(self, step: PlanStep) -> tuple[Observation, Feedback]:
        self.count += 1
        if self.count == self.broken:
            raise RuntimeError("the physics exploded")
        return self.observation(), Feedback(tuple(self._act(action) for action in step.actions), 1.5)

    def _act(self, action: Action) -> ActionOutcome:
        if action.name == "GoTo":
            self.near = True
        elif action.name == "MoveDown":
            self.low = True
        elif action.name == "Pick":
            if not self.near:
                return ActionOutcome(action, False, "TooFar", FailureCategory.NAVIGATION, {"reach_m": 0.4})
            if not self.low:
                return ActionOutcome(action, False, "BodyTooHigh", FailureCategory.BODY_ADJUSTMENT, {"height_m": -0.2})
            if self.unlucky:
                self.unlucky -= 1
                return ActionOutcome(action, False, "Slipped", FailureCategory.LOGICAL, contingency="slipped")
            self.held = True
        elif action.name == "Place" and not self.held:
            return ActionOutcome(action, False, "HandEmpty", FailureCategory.LOGICAL)
        return ActionOutcome(action, True)

    def goals(self) -> GoalReport:
        return GoalReport((self.held,), frozenset() if self.held else frozenset({"Mug_1"}))

    def stats(self) -> Stats:
        return Stats(1.0 * self.count, 1.5 * self.count, 0.25)

    def stance(self) -> tuple[float, float, float, float]:
        return 1.0 * self.near + self.drift * self.count, 0.0, 0.0, 1.0 - 0.1 * self.low

    def relations(self) -> dict[str, list[str]]:
        return {"held": ["Mug_1"] if self.held else []}


class ScriptedPlanner:
    """Says what it was told to say, then `Done()`."""

    privileged = False
    image_size = 28

    def __init__(self, *texts: str) -> None:
        self.texts = texts
        self.seen: list[Observation] = []
        self.heard: list[Feedback | None] = []

    def reset(self, task: TaskInfo, rng: np.random.Generator) -> None:
        self.seen.clear()
        self.heard.clear()

    def step(self, observation: Observation, feedback: Feedback | None) -> PlannerReply:
        self.seen.append(observation)
        self.heard.append(feedback)
        number = len(self.seen) - 1
        return parse_reply(self.texts[number] if number < len(self.texts) else "Done()", tokens=10, latency_s=0.001)


def make_task(name: str = "a", category: str = "single", budget: int = 6, split: str = "seen") -> Task:
    return Task(
        id=name,
        room="kitchen_1",
        category=category,  # type: ignore[arg-type]
        family="pick",
        instruction="pick up the mug",
        start=Start(0.0, 0.0, 0.0, {"h1": 1.0}),
        placements=(Placement("Mug_1", "Mug", "Table_1"),),
        goals=(Predicate("held", "Mug_1"),),
        time_limit=budget,
        split=split,  # type: ignore[arg-type]
        seed=1,
    )


@pytest.fixture
def session() -> type[FakeSession]:
    return FakeSession


@pytest.fixture
def scripted() -> type[ScriptedPlanner]:
    return ScriptedPlanner


@pytest.fixture
def task() -> Callable[..., Task]:
    return make_task


@pytest.fixture
def fields() -> EpisodeKeyFields:
    return EpisodeKeyFields("scripted", "h1", "a", "single", "easy", 0, 0, "abc")
