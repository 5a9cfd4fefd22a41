"""Stage `dagger`: DAgger. The base model acts, the teacher corrects it, in the simulator and in text."""

from __future__ import annotations

import json
import logging
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import numpy as np

from data.shards import ShardReader, config_hash
from proprio_mllm.training.pipeline import Metrics, Pipeline
from proprio_mllm.training.rollouts import DaggerRequest
from proprio_mllm.training.stages.inputs import dagger_keys

__all__ = ["DaggerStage"]

logger = logging.getLogger(__name__)


class DaggerStage:
    """What the base model does wrong, each step with the teacher's."""

    name = "dagger"
    needs = ("base",)
    shards = ()
    recipe = 0

    def settings(self, pipeline: Pipeline) -> Mapping[str, Any]:
        """Keys of the folders that are asked for."""
        return dagger_keys(pipeline)

    def run(self, pipeline: Pipeline, folder: Path, key: str) -> Metrics:
        """Collects both kinds of corrections and counts how often the model agreed with the teacher."""
        del folder, key
        keys = dagger_keys(pipeline)
        if not keys:
            logger.info("dagger: nothing asked for, or no base model of this project's own")
            return {}
        cfg, metrics = pipeline.cfg.dagger, Metrics()
        if "dagger" in keys:
            reader = _corrected(pipeline, "dagger", "demos", cfg.episodes)
            notes = [json.loads(text) for text in reader.column("privileged")]
            acted = zip(notes, reader.column("target"), strict=True)
            own = [note["executed"] == target for note, target in acted if note["origin"] == "student"]
            metrics |= {
                "episodes": float(cfg.episodes),
                "kept_episodes": float(len(set(reader.column("episode")))),
                "steps": float(len(notes)),
                "student_steps": float(len(own)),
                "student_as_expert": float(np.mean(own)) if own else 0.0,
            }
        if "dagger_in_text" in keys:
            reader = _corrected(pipeline, "dagger_in_text", "text_planning", cfg.text_planning)
            metrics |= {"text_planning": float(cfg.text_planning), "text_steps": float(len(reader))}
        return metrics


def _corrected(pipeline: Pipeline, name: str, kind: Literal["demos", "text_planning"], episodes: int) -> ShardReader:
    """The shards of one folder of corrections, written by the collector where they are missing."""
    if pipeline.collect_dagger is None:
        raise ValueError("stage 'dagger' needs the simulator: no collector was given")
    cfg, shards = pipeline.cfg.dagger, pipeline.paths.shards(name)
    if pipeline.cfg.overwrite:  # the base model may be another one under the same key
        shutil.rmtree(shards, ignore_errors=True)
    written = config_hash({"key": dagger_keys(pipeline)[name]})
    size, seed = pipeline.cfg.model.image_size, pipeline.cfg.seed
    request = DaggerRequest(pipeline.paths.model("base"), shards, kind, episodes, seed, cfg.expert_share, size, written)
    pipeline.collect_dagger(request, workers=cfg.workers)
    return ShardReader(shards, kind)
