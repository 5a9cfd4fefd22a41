"""An episode that a person plays: what the page shows, and what its buttons do.

Everything of the simulator, drawing included, happens in one thread of its own; requests are answered from the last status.
"""

from __future__ import annotations

import io
import logging
import threading
from collections.abc import Callable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, Final

import imageio.v3 as iio

from configs.validate import allowed_values
from interface.actions import ACTIONS, ActionKind, first_refusal
from interface.bodies import DEFAULT_ROBOT, Arm
from interface.steps import Action, PlanStep
from robots.spec import available_robots
from sim.play.live import LiveView
from sim.scene.rooms import room_names
from sim.session.contingency import DIFFICULTIES
from sim.session.session import FreePlay, Session, TaskLike
from sim.session.undo import UndoHistory
from sim.tasks.task import Task, load_benchmark
from sim.world.facts import world_facts

_LOG = logging.getLogger(__name__)
_UNDO: Final = 50
_HEAD_PX: Final = 320
#: What the body can do without an object, in the order of its buttons.
_MOVES: Final = tuple(name for name, spec in ACTIONS.items() if spec.kind is ActionKind.BODY and not spec.takes_object)


class BusyError(RuntimeError):
    """The robot is still acting."""


@dataclass(frozen=True)
class PlayConfig:
    """What is played, and where the page is.

    Attributes:
        robot: robot name.
        room: room name; ignored with a task.
        task: id of a benchmark task; None plays freely in the room.
        difficulty: easy, medium, hard or natural.
        seed: key of the trial's contingencies.
        port: of the page, on this machine alone; 0 takes a free one.
        speed: simulated seconds per second while the robot acts.
        browser: whether to open the page.
    """

    robot: str = DEFAULT_ROBOT
    room: str = "kitchen_1"
    task: str | None = None
    difficulty: str = "easy"
    seed: int = 0
    port: int = 8266
    speed: float = 2.0
    browser: bool = True

    def __post_init__(self) -> None:
        if not 0 <= self.port <= 65535:
            raise ValueError(f"port {self.port} outside 0..65535")
        if not 0.1 <= self.speed <= 100.0:
            raise ValueError(f"speed {self.speed} outside 0.1..100")


class Game:
    """One episode at a time.

    Args:
        config: what to start with.

    Raises:
        ValueError: on an unknown robot, room, task or difficulty.
    """

    def __init__(self, config: PlayConfig) -> None:
        self._config = config
        self._tasks: dict[str, Task] = {task.id: task for task in load_benchmark()}
        self._past = UndoHistory(_UNDO)
        self._pool = ThreadPoolExecutor(1, "simulator")
        self._lock = threading.Lock()
        self._session: Session | None = None
        self._view: LiveView | None = None
        self._status: dict[str, Any] = {}
        self._head = b""
        self._doing, self._version = "", 0
        first = (config.robot, config.room, config.task, config.difficulty)
        self._check(*first)
        try:
            self._pool.submit(self._begin, *first, config.seed).result()
        except BaseException:
            self._pool.shutdown()
            raise

    # ---- from any thread

    @property
    def choices(self) -> dict[str, Any]:
        """What can be chosen: robots, rooms, difficulties, tasks with their instructions, and the actions."""
        return {
            "robots": list(available_robots()),
            "rooms": list(room_names()),
            "difficulties": list(DIFFICULTIES),
            "tasks": {task.id: task.instruction for task in self._tasks.values()},
            "moves": list(_MOVES),
            "actions": {
                name: {"arm": spec.kind is ActionKind.ARM, "object": spec.takes_object, "meaning": spec.meaning}
                for name, spec in ACTIONS.items()
            },
        }

    @property
    def status(self) -> dict[str, Any]:
        """The episode as it stands; `doing` is what the robot is at, empty when it waits."""
        with self._lock:
            return self._status | {"doing": self._doing, "version": self._version}

    @property
    def head(self) -> bytes:
        """What the head's camera sees, PNG."""
        return self._head

    def act(self, text: str) -> None:
        """Starts a plan step.

        Raises:
            ActionError: on a step outside the grammar.
            ValueError: on something that is not in the room.
            BusyError: while another one runs.
        """
        step = PlanStep.parse(text)
        names = [one["id"] for one in self._status["objects"]]
        for action in step.actions:
            if action.object_id is not None and action.object_id not in names:
                raise ValueError(f"no {action.object_id} in this room; {allowed_values(action.object_id, names)}")
        self._start(step.to_text(), self._act, step)

    def undo(self) -> None:
        """Takes the last step back."""
        self._start("undo", self._travel, self._past.undo)

    def redo(self) -> None:
        """Takes it again."""
        self._start("redo", self._travel, self._past.redo)

    def begin(self, robot: str, room: str, task: str | None, difficulty: str, seed: int) -> None:
        """Starts another episode.

        Raises:
            ValueError: on an unknown name.
            BusyError: while a step runs.
        """
        self._check(robot, room, task, difficulty)
        self._start("a new episode", self._begin, robot, room, task, difficulty, seed)

    def close(self) -> None:
        """Ends it, after the step that runs."""
        self._pool.submit(self._end).result()
        self._pool.shutdown()

    def _check(self, robot: str, room: str, task: str | None, difficulty: str) -> None:
        for kind, name, names in (
            ("robot", robot, available_robots()),
            ("room", room, room_names()),
            ("task", task, tuple(self._tasks)),
            ("difficulty", difficulty, DIFFICULTIES),
        ):
            if name is not None and name not in names:
                raise ValueError(f"unknown {kind} {name!r}; {allowed_values(name, names)}")

    def _start(self, doing: str, work: Callable[..., None], *arguments: Any) -> None:
        with self._lock:
            if self._doing:
                raise BusyError(f"the robot is at {self._doing}; wait")
            self._doing = doing
            self._version += 1
        self._pool.submit(work, *arguments).add_done_callback(self._finished)

    def _finished(self, future: Future[None]) -> None:
        error = future.exception()
        with self._lock:
            self._doing = ""
            self._version += 1
            if error is not None:
                _LOG.error("play", exc_info=error)
                self._status |= {"error": f"{type(error).__name__}: {error}"}

    # ---- in the simulator's thread

    def _begin(self, robot: str, room: str, task: str | None, difficulty: str, seed: int) -> None:
        wanted: TaskLike = FreePlay(room) if task is None else self._tasks[task]
        session = Session(robot, difficulty, image_size=0, all_known=True)
        session.reset(wanted, seed)
        if self._view is None:
            self._view = LiveView(session, 0, self._config.speed)
        else:
            self._view.follow(session)
            self._running().close()
        self._session = session
        self._goals = [] if task is None else [goal.to_text() for goal in self._tasks[task].goals]
        self._past.clear()
        self._chosen = {"robot": robot, "room": wanted.room, "task": task, "difficulty": difficulty, "seed": seed}
        self._look()

    def _end(self) -> None:
        if self._view is not None:
            self._view.close()
            self._running().close()

    def _act(self, step: PlanStep) -> None:
        session = self._running()
        before = session.snapshot()
        session.act(step)
        self._past.add(before)
        self._look()

    def _travel(self, way: Callable[[Session], bool]) -> None:
        if way(self._running()):
            self._look()

    def _running(self) -> Session:
        assert self._session is not None
        return self._session

    def _look(self) -> None:
        session = self._running()
        assert self._view is not None
        self._view.show()
        world, hands = session.world, session.body.hands
        picture = io.BytesIO()
        iio.imwrite(picture, world.cameras.render("head", _HEAD_PX, _HEAD_PX, pretty=True).rgb, extension=".png")
        visible = set(world.cameras.visible_objects(1.0))
        met = session.goal_status()
        status: dict[str, Any] = self._chosen | {
            "view": self._view.url,
            "instruction": session.task.instruction,
            "goals": [{"text": text, "met": holds} for text, holds in zip(self._goals, met, strict=True)],
            "done": bool(met) and all(met),
            "ended": session.ended,
            "steps": session.stats.charged,
            "limit": session.task.time_limit if met else 0,
            "hands": {arm.value: held for arm, held in hands.held.items()},
            "lifted": hands.lifted,
            "height_m": round(float(session.body.posture.pelvis_height_m), 2),
            "objects": [{"id": name, "visible": name in visible, "can": can} for name, can in self._possible().items()],
            "history": [{"step": one.step, "feedback": one.feedback} for one in session.history],
            "undo": len(self._past.past),
            "redo": len(self._past.future),
            "error": "",
        }
        with self._lock:
            self._status, self._head = status, picture.getvalue()

    def _possible(self) -> Mapping[str, list[str]]:
        """Per object the actions that nothing but reach and room to move may refuse now."""
        session = self._running()
        facts = world_facts(session.world)
        found: dict[str, list[str]] = {name: [] for name in session.known_objects}
        for name, spec in ACTIONS.items():
            if not spec.takes_object:
                continue
            arms: tuple[Arm | None, ...] = tuple(Arm) if spec.kind is ActionKind.ARM else (None,)
            for object_id, can in found.items():
                calls = [Action(name, arm, object_id) for arm in arms]
                can += [call.to_text() for call in calls if first_refusal(call, facts) is None]
        return found
