"""One robot in one room with one task: reset, step, observe, judge, save and restore.

A session is what planners are run against and what the Gymnasium environment and the AI2-THOR-style controller wrap. It owns
the world, the trial's contingencies, what the robot has seen so far, the history and the running statistics. Everything that a
later step depends on is part of `snapshot()`, so restoring and repeating gives bit-equal results.

Paper: problem formulation (observation, dual-arm action, feedback), undo and redo of DualTHOR.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Final, Protocol

import numpy as np

from interface.actions import ActionKind
from interface.bodies import Arm
from interface.episode import STEP_LIMIT
from interface.facts import ObjectFacts
from interface.feedback import ActionOutcome, Feedback
from interface.observation import HistoryItem, Observation
from interface.steps import Action, PlanStep
from robots.build_solver import robot_kit
from robots.spec import load_robot
from sim.scene.objects import Placement
from sim.session.contingency import Contingency, load_contingency, subject_of
from sim.session.observation import observe
from sim.skills.body.body import Body
from sim.skills.body.ready import ready_posture
from sim.skills.failures import SkillFailure
from sim.skills.registry import assess_action, skills_for
from sim.skills.runner import CONTROL_DT_S, Skill, run_skills
from sim.world.facts import world_facts
from sim.world.snapshot import WorldSnapshot
from sim.world.world import World

#: How long things may come to rest before goals are read that seem to hold.
_SETTLE_S: Final = 1.0


class GoalLike(Protocol):
    """A condition on a world; `sim.tasks.predicates.Predicate` is one."""

    def holds(self, objects: Mapping[str, ObjectFacts]) -> bool:
        """Whether it is true of the world's objects, by id."""
        ...


class StartLike(Protocol):
    """Start pose of the robot; `sim.tasks.task.Start` has this shape."""

    @property
    def x_m(self) -> float: ...
    @property
    def y_m(self) -> float: ...
    @property
    def yaw_deg(self) -> float: ...
    @property
    def pelvis_height_m(self) -> Mapping[str, float]: ...


class TaskLike(Protocol):
    """What a session needs of a task; `sim.tasks.task.Task` has this shape."""

    @property
    def room(self) -> str: ...
    @property
    def instruction(self) -> str: ...
    @property
    def start(self) -> StartLike | None: ...
    @property
    def placements(self) -> Sequence[Placement] | None: ...
    @property
    def states(self) -> Mapping[str, Mapping[str, bool | float | str]]: ...
    @property
    def goals(self) -> Sequence[GoalLike]: ...
    @property
    def time_limit(self) -> int: ...
    @property
    def seed(self) -> int: ...


@dataclass(frozen=True, slots=True)
class FreePlay:
    """A room without a goal, as it is by default.

    Attributes:
        room: room name.
        instruction, start, placements, states, goals, time_limit, seed: as in `TaskLike`.
    """

    room: str
    instruction: str = "Look around."
    start: StartLike | None = None
    placements: Sequence[Placement] | None = None
    states: Mapping[str, Mapping[str, bool | float | str]] = field(default_factory=dict)
    goals: tuple[GoalLike, ...] = ()
    time_limit: int = STEP_LIMIT
    seed: int = 0


@dataclass(frozen=True, slots=True)
class SessionStats:
    """Running sums of an episode.

    Attributes:
        steps: plan steps taken.
        struck: those of them that a contingency spoiled.
        path_length_m: length of the base's path.
        makespan_s: simulated seconds.
        arm_steps: arm actions executed, a two-arm action counts twice.
    """

    steps: int = 0
    struck: int = 0
    path_length_m: float = 0.0
    makespan_s: float = 0.0
    arm_steps: int = 0

    @property
    def charged(self) -> int:
        """Steps that count towards the limits: these bound what is planned, not contingencies, so struck ones do not."""
        return self.steps - self.struck

    @property
    def arm_utilisation(self) -> float:
        """Mean fraction of arm-steps in which an arm acted, in [0, 1]."""
        return self.arm_steps / (2 * self.steps) if self.steps else 0.0


@dataclass(frozen=True, slots=True)
class SessionSnapshot:
    """Everything that the future of a session depends on."""

    world: WorldSnapshot
    seen: tuple[str, ...]
    history: tuple[HistoryItem, ...]
    stats: SessionStats
    ended: bool


class Session:
    """Runs tasks with one robot.

    Args:
        robot: robot name.
        difficulty: easy, medium, hard or natural.
        image_size: side of the planner's picture, pixels; 0 draws none.
        contingency: name of the outcome distributions in `configs/contingency`.
        step_limit: steps after which an episode is `finished`.
        all_known: whether actions may name any object, seen or not; not how planners are evaluated.

    Attributes:
        step_limit: see above.
        world, body, task, stats: of the running episode; only after `reset`.
        watchers: called with the world and the text of the running step after every control tick; they must change nothing.
    """

    world: World
    body: Body
    task: TaskLike

    def __init__(
        self,
        robot: str,
        difficulty: str = "easy",
        image_size: int = 112,
        contingency: str = "default",
        *,
        step_limit: int = STEP_LIMIT,
        all_known: bool = False,
    ) -> None:
        self.robot = load_robot(robot)
        self._all_known = all_known
        self.step_limit = step_limit
        self.image_size = image_size
        self._config = load_contingency(contingency)
        self._contingency = Contingency(self._config, difficulty, 0)
        self.stats = SessionStats()
        self.watchers: list[Callable[[World, str], None]] = []
        self._seen: set[str] = set()
        self._history: list[HistoryItem] = []
        self._ended = False
        self._opened = False
        self._certain = False

    # ---- episode

    def reset(self, task: TaskLike, seed: int) -> Observation:
        """Starts a task.

        Args:
            task: what is to be done and where.
            seed: key of the trial's contingencies; the scene itself follows from the task.
        """
        self.close()
        joints: dict[str, float] = {}
        for arm in Arm:
            posture = ready_posture(robot_kit(self.robot), arm)
            joints |= dict(zip(self.robot.arms[arm.value].joints, map(float, posture), strict=True))
        start, height = None, None
        if task.start is not None:
            start = (task.start.x_m, task.start.y_m, float(np.deg2rad(task.start.yaw_deg)))
            height = task.start.pelvis_height_m.get(self.robot.name)
        if height is not None:
            legs = robot_kit(self.robot).crouches.legs(height)
            joints |= dict(zip(self.robot.leg_joints, map(float, legs), strict=True))
        self.world = World(
            self.robot,
            task.room,
            task.placements,
            states=task.states,
            start=start,
            pelvis_height_m=height,
            joint_positions=joints,
            seed=task.seed,
        )
        self.body = Body(self.world)
        self.task = task
        self._contingency = dataclasses.replace(self._contingency, seed=seed)
        self.stats = SessionStats()
        self._seen, self._history, self._ended, self._opened = set(), [], False, True
        return self.observation()

    def step(self, step: PlanStep, diagnose: bool = True) -> tuple[Observation, Feedback]:
        """Acts a plan step out in physics and looks around.

        Args:
            step: what is done.
            diagnose: whether a refusal says what is wrong, see `Hypothesis`.

        Raises:
            RuntimeError: before `reset`, or after Done.
        """
        feedback = self.act(step, diagnose)
        return self.observation(), feedback

    def act(self, step: PlanStep, diagnose: bool = True) -> Feedback:
        """As `step`, without looking around afterwards; what came into view meanwhile stays unknown.

        Raises:
            RuntimeError: before `reset`, or after Done.
        """
        if not self._opened or self._ended:
            raise RuntimeError("the episode is over: reset first" if self._opened else "no episode: reset first")
        if step.actions[0].spec.kind is ActionKind.EPISODE:
            self._ended = True
            outcomes: tuple[ActionOutcome, ...] = tuple(ActionOutcome(action, True) for action in step.actions)
            feedback = Feedback(outcomes, 0.0)
        else:
            feedback = self._run(step, diagnose)
        if self._ended or self.succeeded:
            self._settle(step.to_text())
        arms = sum(2 if a.spec.kind is ActionKind.TWO_ARM else int(a.spec.kind is ActionKind.ARM) for a in step.actions)
        self.stats = dataclasses.replace(
            self.stats,
            steps=self.stats.steps + 1,
            struck=self.stats.struck + feedback.struck,
            makespan_s=self.stats.makespan_s + feedback.duration_s,
            arm_steps=self.stats.arm_steps + arms,
        )
        self._history.append(HistoryItem(step.to_text(), feedback.to_text()))
        return feedback

    def _settle(self, text: str) -> None:
        """Lets things come to rest before the goals are read: what is about to fall is not where it should be."""
        for _ in range(round(_SETTLE_S / CONTROL_DT_S)):
            self._tick(text)

    def _tick(self, text: str) -> None:
        """Lets physics run for one control tick and shows it to the watchers."""
        self.world.advance(CONTROL_DT_S)
        for watch in self.watchers:
            watch(self.world, text)

    def _run(self, step: PlanStep, diagnose: bool) -> Feedback:
        known = frozenset(self.known_objects)
        return self.perform(skills_for(self.body.assuming(diagnose=diagnose), step, known, self.draw), step.to_text())

    def perform(self, skills: Sequence[tuple[Action, Skill]], text: str) -> Feedback:
        """Runs skills together. By themselves they are no step of a plan: privileged, for front ends with motions of their own.

        Args:
            skills: coroutines, each with the action that it counts as.
            text: what watchers are told.
        """
        started = self.world.time_s
        place = self.body.base.measured().position
        path = 0.0

        def advance() -> None:
            nonlocal place, path
            self._tick(text)
            now = self.body.base.measured().position
            path += float(np.linalg.norm(now - place))
            place = now

        outcomes = run_skills(skills, advance)
        if path > 0.01:  # less is the servos' tremor
            self.stats = dataclasses.replace(self.stats, path_length_m=self.stats.path_length_m + path)
        return Feedback(outcomes, self.world.time_s - started)

    @contextmanager
    def imagining(self) -> Iterator[None]:
        """Steps taken inside are undone at its end, nobody watches them, and no contingency strikes; for the expert."""
        before, watchers = self.snapshot(), self.watchers
        self.watchers, self._certain = [], True
        try:
            yield
        finally:
            self.restore(before)
            self.watchers, self._certain = watchers, False

    def draw(self, action: Action) -> str:
        """The contingency of an action at the present step."""
        if self._certain:
            return "success"
        hands = self.body.hands
        object_id = subject_of(action, hands.lifted if action.arm is None else hands.held[action.arm])
        obj = self.world.objects[object_id]
        state = {name: getattr(obj.state, name) for name in ("isFilledWithLiquid", "isToggled", "isDirty", "isBroken")}
        return self._contingency.draw(self.stats.steps, action.name, object_id, obj.type.name, state)

    def assess(self, action: Action, diagnose: bool = True, pelvis_height_m: float | None = None) -> SkillFailure | None:
        """Why an action would be refused right now, None when it would be tried. Moves nothing; for the privileged expert.

        Args:
            action: what is asked about.
            diagnose: whether a refusal says what is wrong, see `Hypothesis`.
            pelvis_height_m: an assumed pelvis height; as it is when None.
        """
        there = self.body.assuming(pelvis_height_m=pelvis_height_m, diagnose=diagnose)
        return assess_action(there, action, frozenset(self.known_objects))

    def teleport(self, x_m: float, y_m: float, yaw_rad: float, pelvis_height_m: float | None = None) -> None:
        """Puts the base somewhere at once, and what the hands hold with it; the pelvis height stays when it is None.

        Privileged; not an action of the grammar, and no part of any planner's episode.
        """
        self.world.grasps.put_base(x_m, y_m, yaw_rad, pelvis_height_m)

    # ---- views

    def observation(self) -> Observation:
        """What the robot sees now; objects in view become known."""
        seen = observe(
            self.world,
            self.task.instruction,
            self.image_size,
            self.known_objects,
            self._history,
            self.stats.charged,
            self.task.time_limit,
            self.step_limit,
        )
        self._seen.update(seen.visible_objects)
        return seen

    @property
    def known_objects(self) -> tuple[str, ...]:
        """Ids that actions may name: fixed furniture, and everything seen so far in the episode."""
        known = self.world.objects.items()
        return tuple(name for name, obj in known if self._all_known or not obj.movable or name in self._seen)

    def goal_status(self) -> tuple[bool, ...]:
        """Whether each of the task's goals holds."""
        objects = world_facts(self.world).objects
        return tuple(goal.holds(objects) for goal in self.task.goals)

    @property
    def succeeded(self) -> bool:
        """Whether there are goals and all of them hold."""
        return bool(self.task.goals) and all(self.goal_status())

    @property
    def ended(self) -> bool:
        """Whether the planner has said Done."""
        return self._ended

    @property
    def finished(self) -> bool:
        """Whether the episode is over: Done, all goals hold, or the step limit is reached."""
        return self._ended or self.stats.charged >= self.step_limit or self.succeeded

    @property
    def history(self) -> tuple[HistoryItem, ...]:
        """Steps so far with their feedback."""
        return tuple(self._history)

    # ---- snapshots

    def snapshot(self) -> SessionSnapshot:
        """An exact copy of the episode's state."""
        return SessionSnapshot(self.world.save(), tuple(sorted(self._seen)), tuple(self._history), self.stats, self._ended)

    def restore(self, snapshot: SessionSnapshot) -> None:
        """Returns to a snapshot of the same episode."""
        self.world.restore(snapshot.world)
        self._seen = set(snapshot.seen)
        self._history = list(snapshot.history)
        self.stats = snapshot.stats
        self._ended = snapshot.ended

    def close(self) -> None:
        """Frees the drawing contexts of the running episode."""
        if self._opened:
            self.world.cameras.close()
