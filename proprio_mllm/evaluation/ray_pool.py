"""Episodes on a Ray instance: actors with a simulator each, and on request one with the model.

Without an address Ray is started for the run on this machine, on the loopback interface, with as many CPUs as there are
workers, without dashboard and usage reports. With one, the same code runs on a cluster, where this project has to be installed
on every node. An actor that dies is replaced and its episode run again; after `retries` further attempts it becomes an
infrastructure error.

Paper: none (engineering).
"""

from __future__ import annotations

import contextlib
import logging
import os
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from typing import Any, Final, TypeVar

import numpy as np

from configs.schema.eval import PlannerConfig
from data.records import Observation
from proprio_mllm.evaluation.batching import AskingPlanner, Batcher, batch_planner
from proprio_mllm.evaluation.pool import Worker
from proprio_mllm.planners.protocol import Planner, PlannerReply, TaskInfo

__all__ = ["RayServer", "import_ray", "ray_instance", "ray_model", "run_ray_jobs"]

logger = logging.getLogger(__name__)

J = TypeVar("J")
R = TypeVar("R")

#: One thread per worker, drawing without a screen, nothing from a hub.
_ENVIRONMENT: Final = {
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "MUJOCO_GL": os.environ.get("MUJOCO_GL", "egl"),
    "HF_HUB_OFFLINE": "1",
}
#: Ray's own settings: it reports nothing, and workers without a GPU of their own see the machine's, as in a process pool.
_QUIET: Final = {
    "RAY_USAGE_STATS_ENABLED": "0",
    "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0",
    "RAY_ENABLE_METRICS_COLLECTION": "0",
}
#: The name is the one that Ray has for it; where it is 0, its own address is 127.0.0.1 on every system.
_LOOPBACK: Final = "RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER"
_OBJECT_STORE_BYTES: Final = 200_000_000


def import_ray(address: str | None = None) -> Any:
    """The module `ray`.

    Args:
        address: of a cluster; without one Ray is told, before it is first imported, to keep to the loopback interface.

    Raises:
        ValueError: when it is not installed; the message names the extra.
    """
    os.environ.update(_QUIET)
    if address is None:
        os.environ[_LOOPBACK] = "0"
    try:
        import ray
    except ImportError as error:
        raise ValueError("scheduler=ray needs Ray, which is not installed: pip install 'proprio-mllm[ray]'") from error
    return ray


@contextlib.contextmanager
def ray_instance(workers: int, address: str | None) -> Iterator[Any]:
    """Ray, started or connected for the time of the block; one that this process already uses is used and left as it is.

    Args:
        workers: CPUs of an instance started here.
        address: of a running cluster.

    Raises:
        ValueError: when there is no cluster at the address.
    """
    ray = import_ray(address)
    if ray.is_initialized():
        yield ray
        return
    quiet = {"include_dashboard": False, "log_to_driver": False, "logging_level": logging.ERROR}
    if address is None:
        before = {name: os.environ.get(name) for name in _ENVIRONMENT}
        os.environ.update(_ENVIRONMENT)  # its processes take over the environment of this moment
        try:
            ray.init("local", num_cpus=workers, object_store_memory=_OBJECT_STORE_BYTES, _node_ip_address="127.0.0.1", **quiet)
        finally:
            for name, value in before.items():
                os.environ.pop(name) if value is None else os.environ.__setitem__(name, value)
    else:
        del quiet["include_dashboard"]
        try:
            ray.init(address, runtime_env={"env_vars": _ENVIRONMENT | _QUIET}, **quiet)
        except (ConnectionError, ValueError) as error:
            raise ValueError(f"ray_address={address!r}: no cluster answers there ({error})") from error
    try:
        yield ray
    finally:
        ray.shutdown()


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
        self._batcher = Batcher(batch_planner(planner), batch)

    def image_size(self) -> int:
        """Side of the image that the planner wants to see."""
        return self._batcher.image_size

    def begin(self, caller: str, task: TaskInfo, rng: np.random.Generator) -> None:
        """Starts an episode of a caller."""
        self._batcher.begin(caller, task, rng)

    def step(self, caller: str, observation: Observation) -> PlannerReply:
        """The next step of a caller's episode."""
        return self._batcher.step(caller, observation)


class RayServer:
    """The actor with the model; can be sent to workers.

    Args:
        actor: its handle.
    """

    def __init__(self, actor: Any) -> None:
        self._actor = actor

    def connect(self) -> Planner:
        """A planner that asks the actor."""
        ray, actor = import_ray(), self._actor
        caller = str(ray.get_runtime_context().get_actor_id())

        def ask(method: str, *arguments: Any) -> Any:
            return ray.get(getattr(actor, method).remote(caller, *arguments))

        return AskingPlanner(ray.get(actor.image_size.remote()), ask)


def ray_model(ray: Any, planner: PlannerConfig, batch: int) -> RayServer:
    """Starts the actor with the model, on a GPU where the instance has one; Ray starts it again when it dies."""
    gpus = 1 if ray.cluster_resources().get("GPU", 0) >= 1 else 0
    # Twice as many threads as a batch has rows: while one batch is answered the next one gathers.
    options = {"num_cpus": 0, "num_gpus": gpus, "max_concurrency": 2 * batch, "max_restarts": -1}
    return RayServer(ray.remote(_ModelActor).options(**options).remote(planner, batch))


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
