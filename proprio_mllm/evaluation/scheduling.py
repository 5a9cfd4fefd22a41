"""Who runs the episodes of an evaluation: this process, a process pool, or Ray; with batched calls of the model or without.

Paper: none (engineering).
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
from collections.abc import Callable, Generator, Sequence

from configs.schema.execution import Execution
from data.cluster import ray_instance
from proprio_mllm.evaluation.pool import run_here, run_jobs
from proprio_mllm.evaluation.ray_pool import ray_model, run_ray_jobs
from proprio_mllm.evaluation.serving import model_processes
from proprio_mllm.evaluation.worker import EpisodeJob, EpisodeResult, EpisodeWorker, Opener, WorkerSetup, lost_episode


def scheduled(
    cfg: Execution,
    setup: WorkerSetup,
    jobs: Sequence[EpisodeJob],
    failed: Callable[[EpisodeResult], bool],
    opener: Opener | None = None,
    threads: int = 1,
) -> Generator[EpisodeResult]:
    """Results of episodes in the order they end, every attempt's.

    Args:
        cfg: who runs them.
        setup: what the episodes share.
        jobs: episodes, in the order they are started.
        failed: whether a result is worth another attempt.
        opener: opens sessions; the simulator's by default.
        threads: see `EvalConfig.threads`.
    """

    def make(own: WorkerSetup) -> functools.partial[EpisodeWorker]:
        return functools.partial(EpisodeWorker, own) if opener is None else functools.partial(EpisodeWorker, own, opener)

    if not jobs:
        return
    retried = (failed, lost_episode, cfg.retries)
    if cfg.scheduler == "ray":
        with ray_instance(cfg.workers, cfg.ray_address) as ray:
            server = ray_model(ray, setup.planner, cfg.batch) if cfg.batch > 1 else None
            yield from run_ray_jobs(ray, make(dataclasses.replace(setup, server=server)), jobs, cfg.workers, *retried)
    elif cfg.workers == 0 or threads > 1:
        count = max(cfg.batch, threads)
        yield from run_here(make(setup)().run, jobs, count, failed, lambda job: job.fields, cfg.retries)
    else:
        with model_processes(setup.planner, cfg.batch) if cfg.batch > 1 else contextlib.nullcontext() as model:
            own = setup if model is None else dataclasses.replace(setup, server=model.server)
            for result in run_jobs(make(own), jobs, cfg.workers, *retried):
                if model is not None:
                    model.ensure()
                yield result
