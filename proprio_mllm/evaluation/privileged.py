"""The expert as a planner. It looks into the session, so it is made here, where the simulator may be imported, and marked."""

from __future__ import annotations

import time
from typing import Protocol, runtime_checkable

import numpy as np

from interface.feedback import Feedback
from interface.observation import Observation
from proprio_mllm.planners.protocol import PlannerReply, TaskInfo
from sim.expert.expert import Expert
from sim.session.session import Session


@runtime_checkable
class PrivilegedPlanner(Protocol):
    """A planner that is given the session of the coming episode."""

    def attach(self, session: Session) -> None:
        """Takes the session."""
        ...


class ExpertPlanner:
    """Plans from the simulator's own state; every table marks it as privileged.

    Args:
        image_size: side of the head view it is shown and ignores, pixels.
    """

    privileged = True

    def __init__(self, image_size: int = 112) -> None:
        self.image_size = image_size
        self._expert: Expert | None = None

    def attach(self, session: Session) -> None:
        """Takes the session of the coming episode."""
        self._expert = Expert(session)

    def reset(self, task: TaskInfo, rng: np.random.Generator) -> None:
        """Forgets the last episode.

        Raises:
            RuntimeError: when no session was attached.
        """
        if self._expert is None:
            raise RuntimeError("the expert plans from a session: attach(session) before reset, got none")
        self._expert.reset()

    def step(self, observation: Observation, feedback: Feedback | None) -> PlannerReply:
        """The next step from the simulator's state."""
        started = time.perf_counter()
        assert self._expert is not None
        step = self._expert.next_step()
        return PlannerReply(step.to_text(), step, latency_s=time.perf_counter() - started)
