"""Planner calls of several episodes answered together.

`answer_all` asks once for a known set of episodes. A `Batcher` collects the calls of many threads: whenever the model is free
it takes what is waiting, up to a limit, so nobody waits for a batch to fill. Which calls meet there depends on timing; a row's
answer does not depend on the other rows, up to the rounding of sums.

Paper: none (engineering).
"""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from typing import Any

import numpy as np

from configs.schema.eval import PlannerConfig
from data.interface.feedback import Feedback
from data.interface.observation import Observation
from proprio_mllm.planners.protocol import BatchPlanner, PlannerReply, TaskInfo
from proprio_mllm.planners.registry import make_planner

__all__ = ["AskingPlanner", "Batcher", "answer_all", "batch_planner"]


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


class Batcher:
    """Answers calls from many threads with one planner, in one thread of its own.

    Args:
        planner: who answers.
        limit: most calls answered together.
    """

    def __init__(self, planner: BatchPlanner, limit: int) -> None:
        if limit < 1:
            raise ValueError(f"limit {limit} must be positive")
        self.image_size = planner.image_size
        self._planner = planner
        self._limit = limit
        self._states: dict[str, Any] = {}
        self._waiting: queue.SimpleQueue[tuple[Observation, Any, Future[PlannerReply]]] = queue.SimpleQueue()
        #: Calls answered, and batches they came in.
        self.calls = self.batches = 0
        threading.Thread(target=self._serve, daemon=True).start()

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
        future: Future[PlannerReply] = Future()
        self._waiting.put((observation, self._states[caller], future))
        return future.result()

    def _serve(self) -> None:
        while True:
            taken = [self._waiting.get()]
            while len(taken) < self._limit and not self._waiting.empty():
                taken.append(self._waiting.get())
            self.calls, self.batches = self.calls + len(taken), self.batches + 1
            answers = answer_all(self._planner, [one for one, _, _ in taken], [state for _, state, _ in taken])
            for (_, _, future), answer in zip(taken, answers, strict=True):
                if isinstance(answer, Exception):
                    future.set_exception(answer)
                else:
                    future.set_result(answer)


class AskingPlanner:
    """A planner that hands its calls to a `Batcher` in another process.

    Args:
        image_size: side of the image that the planner there wants to see.
        ask: calls a method of the batcher, `begin` or `step`, with its arguments but the caller.
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
