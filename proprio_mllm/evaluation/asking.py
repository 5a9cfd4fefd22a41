"""How episodes ask a planner that answers several at once: all of a known set, or at a desk in another process.

`answer_all` asks once for a known set of episodes; a `ModelDesk` serves the calls of many threads with the project's batcher.
Paper: none (engineering).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from configs.schema.planner import PlannerConfig
from interface.feedback import Feedback
from interface.observation import Observation
from proprio_mllm.backends.batching import Batcher
from proprio_mllm.planners.protocol import BatchPlanner, PlannerReply, TaskInfo
from proprio_mllm.planners.registry import make_planner


def answer_all(
    planner: BatchPlanner, observations: Sequence[Observation], states: Sequence[Any]
) -> list[PlannerReply | Exception]:
    """One reply per observation, or the error that this observation causes.

    A batch that breaks is asked again row by row, so that one episode's error does not become the others'.
    """
    if not observations:
        return []
    try:
        replies: list[PlannerReply | Exception] = list(planner.step_batch(observations, states))
        if len(replies) != len(observations):
            raise ValueError(f"step_batch gave {len(replies)} replies to {len(observations)} observations")
    except Exception as error:  # noqa: BLE001  # handed to the episode that it belongs to, which records it
        if len(observations) == 1:
            return [error]
        return [answer_all(planner, [one], [state])[0] for one, state in zip(observations, states, strict=True)]
    return replies


class ModelDesk:
    """One planner for the episodes of many callers, several of which are answered together.

    Args:
        planner: who answers.
        limit: most calls answered together.

    Raises:
        ValueError: when the limit is not positive.
    """

    def __init__(self, planner: BatchPlanner, limit: int) -> None:
        self.image_size = planner.image_size
        self._planner = planner
        self._states: dict[str, Any] = {}
        self._batcher: Batcher[tuple[Observation, Any], PlannerReply] = Batcher(self._answer, limit)

    @property
    def calls(self) -> int:
        """Calls answered so far."""
        return self._batcher.questions

    @property
    def batches(self) -> int:
        """Batches that they came in."""
        return self._batcher.batches

    def begin(self, caller: str, task: TaskInfo, rng: np.random.Generator) -> None:
        """Starts an episode of a caller; its last one is forgotten."""
        self._states[caller] = self._planner.begin(task, rng)

    def step(self, caller: str, observation: Observation) -> PlannerReply:
        """The next step of a caller's episode; blocks until it is there.

        Raises:
            KeyError: when the caller has begun no episode here, as after a restart.
        """
        if caller not in self._states:
            raise KeyError(f"caller {caller!r} has begun no episode here")
        return self._batcher.ask((observation, self._states[caller]))

    def _answer(self, asked: Sequence[tuple[Observation, Any]]) -> list[PlannerReply | Exception]:
        return answer_all(self._planner, [observation for observation, _ in asked], [state for _, state in asked])


class AskingPlanner:
    """A planner that hands its calls to a `ModelDesk` in another process.

    Args:
        image_size: side of the image that the planner there wants to see.
        ask: calls a method of the desk, `begin` or `step`, with its arguments but the caller.
    """

    privileged = False

    def __init__(self, image_size: int, ask: Callable[..., Any]) -> None:
        self.image_size = image_size
        self._ask = ask

    def reset(self, task: TaskInfo, rng: np.random.Generator) -> None:
        """Begins an episode over there."""
        self._ask("begin", task, rng)

    def step(self, observation: Observation, feedback: Feedback | None) -> PlannerReply:
        """The next step, from over there; earlier feedback is in the observation's history."""
        return self._ask("step", observation)


def batch_planner(cfg: PlannerConfig) -> BatchPlanner:
    """The configured planner, one thread for its sums, as in every worker.

    Raises:
        ValueError: when it answers one episode at a time.
    """
    if cfg.kind == "mllm":
        import torch

        torch.set_num_threads(1)
    planner = make_planner(cfg)
    if not isinstance(planner, BatchPlanner):
        raise ValueError(f"planner {cfg.name!r} answers one episode at a time: it has no begin and step_batch")
    return planner
