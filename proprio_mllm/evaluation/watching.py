"""`eval.py watch=true`: the episodes of a run in the browser while they go on, and their steps in the terminal."""

from __future__ import annotations

from tqdm import tqdm

from proprio_mllm.evaluation.episode import RunnableSession
from proprio_mllm.evaluation.sessions import SimSession
from proprio_mllm.evaluation.worker import EpisodeJob, WorkerSetup, open_simulator
from proprio_mllm.planners.protocol import Planner
from sim.play.live import LiveView
from sim.session.session import Session
from sim.world.world import World

#: Simulated seconds per second.
_SPEED = 2.0


class Watching:
    """Opens sessions as a run does and shows them, one after the other; an `Opener`."""

    def __init__(self) -> None:
        self._view: LiveView | None = None
        self._watched: Session | None = None
        self._task = self._text = ""

    def __call__(self, setup: WorkerSetup, job: EpisodeJob, planner: Planner) -> RunnableSession:
        """The episode's session."""
        opened = open_simulator(setup, job, planner)
        assert isinstance(opened, SimSession)
        self._task, self._text = job.task.instruction, ""
        if opened.session is not self._watched:
            self._watched = opened.session
            opened.session.watchers.append(self._tick)
        return opened

    def close(self) -> None:
        """Closes the view; sessions outlive a run."""
        if self._watched is not None:
            self._watched.watchers.remove(self._tick)
        if self._view is not None:
            self._view.close()

    def _tick(self, world: World, text: str) -> None:
        del world
        assert self._watched is not None
        if self._view is None:
            self._view = LiveView(self._watched, speed=_SPEED)
            tqdm.write(f"watch: {self._view.url}")
        if not self._text:
            tqdm.write(self._task)
        if text != self._text:
            tqdm.write(f"  {text}")
        self._text = text
