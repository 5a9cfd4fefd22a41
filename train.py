"""Trains Proprio-MLLM: `python train.py stage=all model=tiny` (paper, three stages; `stage=base` stands in for pretraining).

Stages: data (motions to clips shards), collect (views, lessons), words (whole episodes in words), practice (more, from
acting), base, pointmap, tokenizer, alignment, selu; `all` runs them in order and skips what is current. Options:
configs/schema/train.py.
"""

from __future__ import annotations

import dataclasses
import logging
import os
import sys
import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, Literal

from configs.app import run_app
from configs.schema.train import TrainConfig

logger = logging.getLogger("train")


def make_data(cfg: TrainConfig) -> None:
    """Motions: generate or load, retarget to both robots, filter, replay with head-camera frames, write `clips` shards."""
    from data.pipeline import build_clips
    from proprio_mllm.training.paths import StagePaths
    from sim.collection.replay import replay_clip

    size = dataclasses.replace(cfg.data.replay, image_size=cfg.model.image_size)
    motions = dataclasses.replace(cfg.data, seed=cfg.seed, replay=size)
    done = build_clips(motions, StagePaths(cfg).shards("clips"), replay_clip, _progress("clips"), overwrite=cfg.overwrite)
    summary = done.metadata["summary"]
    logger.info("clips: %d kept, %d dropped %s", summary["rows"], summary["dropped"], summary["reasons"] or "")


def make_shards(cfg: TrainConfig) -> None:
    """Posed views, and the rules' lessons on training tasks."""
    from configs.schema.collect import CollectConfig as ShardConfig
    from proprio_mllm.evaluation.dagger import collect_lessons
    from proprio_mllm.training.paths import StagePaths
    from sim.collection.collect import collect

    kinds: tuple[tuple[str, Literal["views", "demos"], int, int], ...]
    kinds = (("views", "views", cfg.collect.views, 240), ("lessons", "demos", cfg.collect.lessons, 10))
    for name, kind, count, part in kinds:
        shards = ShardConfig(
            kind=kind, out=str(StagePaths(cfg).shards(name)), count=count, seed=cfg.seed, image_size=cfg.model.image_size,
            part_size=part, workers=cfg.collect.workers, robots=cfg.data.robots,
            foreseen=cfg.collect.foreseen and name == "lessons",
        )  # fmt: skip
        write = collect_lessons if name == "lessons" else collect
        write(shards, overwrite=cfg.overwrite, progress=_progress(name))


def _progress(name: str) -> Callable[[int, int], None]:
    """Reports finished parts with an estimate of the time left."""
    began = time.monotonic()
    first: list[int] = []

    def report(done: int, total: int) -> None:
        first.append(done)
        fresh = done - first[0]
        left = (time.monotonic() - began) / fresh * (total - done) / 60.0 if fresh else float("nan")
        logger.info("%s: %d of %d parts%s", name, done, total, f", {left:.1f} min left" if fresh else "")

    return report


def run(cfg: TrainConfig) -> dict[str, Any]:
    """Runs the asked stages; returns the metrics of those that ran."""
    from proprio_mllm.training.processes import first_alone

    if cfg.footprint is not None:
        from proprio_mllm.training.footprint import footprint
        from proprio_mllm.training.pipeline import StageError

        try:
            sys.stdout.write(footprint(cfg).text(cfg.footprint))
        except ValueError as error:
            raise StageError(str(error)) from error
        return {}
    if cfg.stage in ("all", "data"):
        first_alone(lambda: make_data(cfg))
    if cfg.stage in ("all", "collect"):
        first_alone(lambda: make_shards(cfg))
    if cfg.stage in ("data", "collect"):
        return {}
    import torch

    from proprio_mllm.evaluation.lessons import Lessons
    from proprio_mllm.training.pipeline import Pipeline, StageError
    from proprio_mllm.training.stages import STAGES

    if cfg.threads:
        torch.set_num_threads(cfg.threads)
    command = " ".join(["python train.py", *sys.argv[1:]])
    robots = cfg.data.robots
    pipeline = Pipeline(
        STAGES, cfg, partial(_rollouts, robots=robots), command, partial(_dagger, robots=robots), Lessons(robots)
    )
    wanted = tuple(STAGES) if cfg.stage == "all" else (cfg.stage,)
    metrics = {name: pipeline.run(name) for name in wanted}
    release = cfg.release
    if release is not None:
        from proprio_mllm.training.release import export

        try:
            first_alone(lambda: export(pipeline, release))
        except ValueError as error:
            raise StageError(str(error)) from error
    return metrics


def _rollouts(*args: Any, **kwargs: Any) -> Any:
    """SELU's rollouts: the evaluation runs the actor in the simulator; training reads the shards it writes."""
    from proprio_mllm.evaluation.rollouts import collect_rollouts

    return collect_rollouts(*args, **kwargs)


def _dagger(*args: Any, **kwargs: Any) -> Any:
    """The words model acts in the simulator and its teacher corrects it; training reads the shards."""
    from proprio_mllm.evaluation.dagger import collect_dagger

    return collect_dagger(*args, **kwargs)


def job(cfg: TrainConfig) -> int:
    """Runs one configuration; 0 on success, 1 when an input is missing or damaged, or nothing can be written."""
    level = logging.INFO if os.environ.get("RANK", "0") == "0" else logging.WARNING
    logging.basicConfig(level=level, format="%(asctime)s %(name)s: %(message)s", datefmt="%H:%M:%S")
    for noisy in ("httpx", "datasets", "filelock", "OpenGL"):
        logging.getLogger(noisy).setLevel(logging.WARNING)
    from data.files import DamagedFileError
    from data.humanml3d import DatasetError
    from data.shards import ShardError
    from proprio_mllm.training.pipeline import StageError

    try:
        run(cfg)
    except (DamagedFileError, DatasetError, OSError, ShardError, StageError) as error:
        sys.stderr.write(f"train.py: {error}\n")
        return 1
    return 0


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line of Hydra; returns the exit code, see `job`, or 2 on a wrong key or value."""
    return run_app("train", TrainConfig, job, __doc__ or "", arguments)


if __name__ == "__main__":
    os.environ.setdefault("MUJOCO_GL", "egl")
    os.environ.setdefault("HF_HUB_OFFLINE", "1")
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # spinning threads double the cost where cores are shared
    sys.exit(main())
