"""Who runs the episodes of an evaluation: this process, a process pool, or Ray; and where the model lives.

Paper: none (engineering).
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Generator, Sequence

from configs.schema.eval import EvalConfig
from data.cluster import ray_instance
from proprio_mllm.evaluation.pool import run_jobs, run_side_by_side
from proprio_mllm.evaluation.ray_pool import ray_model, run_ray_jobs
from proprio_mllm.evaluation.serving import model_process
from proprio_mllm.evaluation.worker import EpisodeJob, EpisodeResult, EpisodeWorker, Opener, WorkerSetup, lost_episode

__all__ = ["scheduled"]


def scheduled(
    cfg: EvalConfig,
    setup: WorkerSetup,
    jobs: Sequence[EpisodeJob],
    failed: Callable[[EpisodeResult], bool],
    opener: Opener | None = None,
) -> Generator[EpisodeResult]:
    """Results of episodes in the order they end, every attempt's; what `workers`, `scheduler`, `threads`, `batch` say decides.

    Args:
        cfg: the evaluation.
        setup: what the episodes share.
        jobs: episodes, in the order they are started.
        failed: whether a result is worth another attempt.
        opener: opens sessions; the simulator's by default.
    """

    def make(own: WorkerSetup) -> functools.partial[EpisodeWorker]:
        return functools.partial(EpisodeWorker, own) if opener is None else functools.partial(EpisodeWorker, own, opener)

    if not jobs:
        return
    if cfg.scheduler == "ray":
        with ray_instance(cfg.workers, cfg.ray_address) as ray:
            if cfg.batch > 1:
                setup = dataclasses.replace(setup, server=ray_model(ray, setup.planner, cfg.batch))
            yield from run_ray_jobs(ray, make(setup), jobs, cfg.workers, failed, lost_episode, cfg.retries)
    elif cfg.threads > 1:
        yield from run_side_by_side(make(setup)().in_threads, jobs, cfg.threads, failed, lambda job: job.fields, cfg.retries)
    elif cfg.batch == 1:
        yield from run_jobs(make(setup), jobs, cfg.workers, failed, lost_episode, cfg.retries)
    elif cfg.workers == 0:
        yield from run_side_by_side(make(setup)().side_by_side, jobs, cfg.batch, failed, lambda job: job.fields, cfg.retries)
    else:
        with model_process(setup.planner, cfg.batch) as model:
            own = make(dataclasses.replace(setup, server=model.server))
            for result in run_jobs(own, jobs, cfg.workers, failed, lost_episode, cfg.retries):
                model.ensure()
                yield result
