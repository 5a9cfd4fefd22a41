"""The simulator's session as the episode runner wants it; reused within a worker for the same settings and slot."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence

from configs.schema.eval import DifficultyName, StartName
from configs.schema.robot import RobotConfig
from interface.feedback import Feedback
from interface.observation import Observation
from interface.steps import PlanStep
from proprio_mllm.evaluation.attribution import unmet_objects
from proprio_mllm.evaluation.episode import GoalReport, RunnableSession, Stats
from proprio_mllm.evaluation.starts import started
from proprio_mllm.planners.protocol import Planner
from sim.session.session import Session
from sim.tasks.task import Task
from sim.world.facts import world_facts

_sessions: dict[tuple[RobotConfig, str, int, str, int], Session] = {}


class SimSession:
    """A session with one task.

    Args:
        session: the simulator's.
        task: what it is reset to.
    """

    def __init__(self, session: Session, task: Task) -> None:
        self.session = session
        self.task = task

    def reset(self, seed: int) -> Observation:
        """Starts the task anew."""
        return self.session.reset(self.task, seed=seed)

    def step(self, step: PlanStep) -> tuple[Observation, Feedback]:
        """Acts a plan step out."""
        return self.session.step(step)

    def goals(self) -> GoalReport:
        """Which goals hold now."""
        met = self.session.goal_status()
        return GoalReport(met, unmet_objects(self.task, met))

    def stats(self) -> Stats:
        """Costs so far."""
        stats = self.session.stats
        return Stats(float(stats.path_length_m), float(stats.makespan_s), float(stats.arm_utilisation))

    def stance(self) -> tuple[float, float, float, float]:
        """x, y (m), yaw (rad) and pelvis height (m) of the robot in the world."""
        x, y, height, yaw = map(float, self.session.world.servos.base_pose[:4])
        return x, y, yaw, height

    def relations(self) -> Mapping[str, Sequence[str]]:
        """What holds of which objects now, as the simulator knows it."""
        found: dict[str, list[str]] = defaultdict(list)
        for name, item in world_facts(self.session.world).objects.items():
            if item.holders:
                found["held"].append(name)
            if len(item.holders) == 2:
                found["lifted"].append(name)
            if item.can.openable:
                found["open" if item.open else "closed"].append(name)
            if item.can.toggleable:
                found["switched on" if item.on else "switched off"].append(name)
            for state, holds in (
                ("sliced", item.sliced), ("clean", not item.dirty), ("filled", item.filled), ("used up", item.used_up),
            ):  # fmt: skip
                if holds:
                    found[state].append(name)
            for carrier in item.carriers:
                found[f"on {carrier}"].append(name)
        return dict(found)


def open_session(
    robot: RobotConfig,
    difficulty: DifficultyName,
    start: StartName,
    task: Task,
    episode_seed: int,
    planner: Planner,
    *,
    contingency: str = "default",
    slot: int = 0,
) -> RunnableSession:
    """A session for an episode; a privileged planner is attached to it.

    Args:
        robot: which robot acts.
        difficulty: success of low-level skills.
        start: see `proprio_mllm.evaluation.starts`.
        task: the benchmark's task.
        episode_seed: the episode's seed.
        planner: who plans.
        contingency: outcome distributions.
        slot: which of the episodes that go side by side in this process; each has a session of its own.
    """
    key = (robot, difficulty, planner.image_size, contingency, slot)
    if key not in _sessions:
        _sessions[key] = Session(_described(robot), difficulty, planner.image_size, contingency)
    session = _sessions[key]
    if planner.privileged:
        from proprio_mllm.evaluation.privileged import PrivilegedPlanner

        assert isinstance(planner, PrivilegedPlanner)
        planner.attach(session)
    return SimSession(session, started(task, start, episode_seed, _described(robot)))


def _described(robot: RobotConfig) -> str:
    return robot.spec or robot.name
