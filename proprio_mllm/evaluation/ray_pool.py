"""Episodes on a Ray instance (`data.cluster`): actors with a simulator each, and on request one with the model for every GPU.

An actor that dies is replaced and its episode run again; after `retries` further attempts it becomes an infrastructure error.

Paper: none (engineering).
"""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from typing import Any, TypeVar

import numpy as np

from configs.schema.planner import PlannerConfig
from data.cluster import import_ray
from interface.observation import Observation
from proprio_mllm.evaluation.asking import AskingPlanner, ModelDesk, batch_planner
from proprio_mllm.evaluation.pool import Worker
from proprio_mllm.planners.protocol import Planner, PlannerReply, TaskInfo

logger = logging.getLogger(__name__)

J = TypeVar("J")
R = TypeVar("R")


class _EpisodeActor:
    """Does jobs with a worker of its own."""

    def __init__(self, make: Callable[[], Worker[Any, Any]]) -> None:
        self._worker = make()

    def do(self, job: Any) -> Any:
        """The result of a job."""
        return self._worker(job)


class _ModelActor:
    """Holds the model; its methods are called from many threads."""

    def __init__(self, planner: PlannerConfig, batch: int) -> None:
        self._desk = ModelDesk(batch_planner(planner), batch)
        self._callers = 0

    def callers(self) -> int:
        """How many workers have connected."""
        return self._callers

    def image_size(self) -> int:
        """Side of the image that the planner wants to see; asked by a worker that connects."""
        self._callers += 1
        return self._desk.image_size

    def begin(self, caller: str, task: TaskInfo, rng: np.random.Generator) -> None:
        """Starts an episode of a caller."""
        self._desk.begin(caller, task, rng)

    def step(self, caller: str, observation: Observation) -> PlannerReply:
        """The next step of a caller's episode."""
        return self._desk.step(caller, observation)


class RayServer:
    """The actors with the model; can be sent to workers.

    Args:
        actors: their handles.
    """

    def __init__(self, actors: Sequence[Any]) -> None:
        self.actors = tuple(actors)

    def connect(self) -> Planner:
        """A planner that asks the actor with fewest callers."""
        ray = import_ray()
        caller = str(ray.get_runtime_context().get_actor_id())
        actor = self.actors[int(np.argmin(ray.get([one.callers.remote() for one in self.actors])))]

        def ask(method: str, *arguments: Any) -> Any:
            return ray.get(getattr(actor, method).remote(caller, *arguments))

        return AskingPlanner(ray.get(actor.image_size.remote()), ask)


def ray_model(ray: Any, planner: PlannerConfig, batch: int) -> RayServer:
    """Starts an actor with the model for every GPU of the cluster, or one; Ray starts it again when it dies."""
    gpus = int(ray.cluster_resources().get("GPU", 0))
    # Twice as many threads as a batch has rows: while one batch is answered the next one gathers.
    options = {"num_cpus": 0, "num_gpus": min(gpus, 1), "max_concurrency": 2 * batch, "max_restarts": -1}
    kind = ray.remote(_ModelActor).options(**options)
    return RayServer([kind.remote(planner, batch) for _ in range(max(gpus, 1))])


def run_ray_jobs(
    ray: Any,
    make: Callable[[], Worker[J, R]],
    jobs: Sequence[J],
    workers: int,
    failed: Callable[[R], bool],
    lost: Callable[[J, str], R],
    retries: int = 1,
) -> Iterator[R]:
    """As `run_jobs`, on actors.

    Args:
        ray: from `ray_instance`.
        make: makes a worker, in each actor.
        jobs: what is to be done, in the order it is started.
        workers: actors.
        failed: whether a result is worth another attempt. Every attempt's result is given out.
        lost: the result of a job whose actor died too often, with the reason.
        retries: further attempts per job.
    """
    queue = deque((job, 1) for job in jobs)
    kind = ray.remote(_EpisodeActor).options(num_cpus=1, max_restarts=0)
    idle = [kind.remote(make) for _ in range(min(workers, len(jobs)))]
    running: dict[Any, tuple[Any, J, int]] = {}
    try:
        while queue or running:
            while queue and idle:
                actor, (job, attempt) = idle.pop(), queue.popleft()
                running[actor.do.remote(job)] = (actor, job, attempt)
            (ready, *_), _ = ray.wait(list(running), num_returns=1)
            actor, job, attempt = running.pop(ready)
            try:
                result = ray.get(ready)
            except ray.exceptions.RayActorError as error:
                logger.warning("a worker died; starting a new one: %s", str(error).splitlines()[0])
                ray.kill(actor)  # it may only be out of reach
                idle.append(kind.remote(make))
                if attempt <= retries:
                    queue.append((job, attempt + 1))
                else:
                    yield lost(job, f"the worker died in {attempt} attempts")
                continue
            idle.append(actor)
            yield result
            if failed(result) and attempt <= retries:
                queue.append((job, attempt + 1))
    finally:
        for actor in [*idle, *(actor for actor, _, _ in running.values())]:
            ray.kill(actor)
