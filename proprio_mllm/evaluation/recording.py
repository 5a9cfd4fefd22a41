"""Keeps what a planner saw, for SELU: one row of `rollouts` shards per episode (format: `proprio_mllm.training.rollouts`).

The simulator's verdict and its relations at the end go into the audit columns; losses and prompts must not read them unless the
configuration says so. Paper: SELU's trajectories.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from interface.episode import EpisodeRecord, Outcome
from interface.feedback import Feedback
from interface.observation import Observation
from proprio_mllm.planners.protocol import PlannerReply
from proprio_mllm.training.rollouts import rollout_row
from sim.tasks.task import Task


class RolloutRecorder:
    """Collects one episode; `watch` is given to the episode runner."""

    def __init__(self) -> None:
        self._seen: list[Observation] = []
        self._steps: list[tuple[str, str, bool]] = []

    def watch(self, observation: Observation, reply: PlannerReply | None, feedback: Feedback | None) -> None:
        """Notes an observation and what led to it."""
        self._seen.append(observation)
        if reply is not None:
            said = observation.history[-1]
            self._steps.append((said.step, said.feedback, feedback is not None and feedback.success))

    def row(self, task: Task, record: EpisodeRecord, relations: Mapping[str, Sequence[str]] | None = None) -> dict[str, Any]:
        """The episode as a row.

        Args:
            task: its task.
            record: how it ended.
            relations: what the simulator says holds at the end, for audits.
        """
        return rollout_row(
            episode=f"{record.task}/{record.robot}/{record.seed}/{record.trial}",
            task=task.id,
            category=task.category,
            room=task.room,
            seed=record.seed,
            difficulty=record.difficulty,
            observations=self._seen,
            steps=self._steps,
            success=record.outcome is Outcome.SUCCESS,
            relations=relations,
            split=task.split,
        )
