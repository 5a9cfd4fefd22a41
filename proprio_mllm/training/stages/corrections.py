"""Stage `corrections`: DAgger. The base model acts, the teacher corrects it, in the simulator and in text."""

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
from proprio_mllm.training.rollouts import CorrectionRequest
from proprio_mllm.training.stages.inputs import correction_keys

__all__ = ["CorrectionsStage"]

logger = logging.getLogger(__name__)


class CorrectionsStage:
    """What the base model does wrong, each step with the teacher's."""

    name = "corrections"
    needs = ("base",)
    shards = ()
    recipe = 0

    def settings(self, pipeline: Pipeline) -> Mapping[str, Any]:
        """Keys of the folders that are asked for."""
        return correction_keys(pipeline)

    def run(self, pipeline: Pipeline, folder: Path, key: str) -> Metrics:
        """Collects both kinds of corrections and counts how often the model agreed with the teacher."""
        del folder, key
        keys = correction_keys(pipeline)
        if not keys:
            logger.info("corrections: none asked for, or no base model of this project's own")
            return {}
        cfg, metrics = pipeline.cfg.corrections, Metrics()
        if "corrections" in keys:
            reader = _corrected(pipeline, "corrections", "demos", cfg.episodes)
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
        if "corrections_in_words" in keys:
            reader = _corrected(pipeline, "corrections_in_words", "exercises", cfg.exercises)
            metrics |= {"exercises": float(cfg.exercises), "exercise_steps": float(len(reader))}
        return metrics


def _corrected(pipeline: Pipeline, name: str, kind: Literal["demos", "exercises"], episodes: int) -> ShardReader:
    """The shards of one folder of corrections, written by the collector where they are missing."""
    if pipeline.collect_corrections is None:
        raise ValueError("stage 'corrections' needs the simulator: no collector was given")
    cfg, shards = pipeline.cfg.corrections, pipeline.paths.shards(name)
    if pipeline.cfg.overwrite:  # the base model may be another one under the same key
        shutil.rmtree(shards, ignore_errors=True)
    written = config_hash({"key": correction_keys(pipeline)[name]})
    size, seed = pipeline.cfg.model.image_size, pipeline.cfg.seed
    request = CorrectionRequest(pipeline.paths.model("base"), shards, kind, episodes, seed, cfg.expert_share, size, written)
    pipeline.collect_corrections(request, workers=cfg.workers)
    return ShardReader(shards, kind)
