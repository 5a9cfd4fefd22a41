"""Demonstrations and text rows of stages 2 and 3: the teacher's own, and its corrections of the base model."""

from __future__ import annotations

from collections.abc import Mapping

from configs.schema.model import ModelConfig
from proprio_mllm.training.paths import stage_key
from proprio_mllm.training.pipeline import Pipeline
from proprio_mllm.training.sources import Demos, Exercises

__all__ = ["correction_keys", "demonstrations", "text_rows"]


def correction_keys(pipeline: Pipeline) -> Mapping[str, str]:
    """Key of each folder of corrections; none without a base model of this configuration's own to correct."""
    cfg = pipeline.cfg.corrections
    if pipeline.cfg.model.weights is not None:
        return {}
    counts = {"corrections": {"episodes": cfg.episodes}, "corrections_in_words": {"exercises": cfg.exercises}}
    inputs = {"base": pipeline.key("base")}
    return {
        name: stage_key({**count, "expert_share": cfg.expert_share}, pipeline.cfg.seed, inputs)
        for name, count in counts.items()
        if all(count.values())
    }


def demonstrations(pipeline: Pipeline, model: ModelConfig) -> Demos:
    """Demonstrations, and the corrections after them where there are any."""
    kind = "corrections"
    more = [pipeline.paths.shards(kind)] if kind in correction_keys(pipeline) else []
    return Demos(pipeline.paths.shards("demos"), model, more)


def text_rows(pipeline: Pipeline, model: ModelConfig, demos: Demos) -> Exercises:
    """Text-planning rows, with the corrections in text among them where there are any."""
    kind = "corrections_in_words"
    corrected = pipeline.paths.shards(kind) if kind in correction_keys(pipeline) else None
    return Exercises(pipeline.paths.shards("exercises"), model, demos, corrected)
