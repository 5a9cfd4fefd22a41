"""Demonstrations and text rows of stages 2 and 3: the teacher's own, and its corrections of the base model."""

from __future__ import annotations

from collections.abc import Mapping

from configs.schema.model import ModelConfig
from proprio_mllm.training.paths import stage_key
from proprio_mllm.training.pipeline import Pipeline
from proprio_mllm.training.sources import Demos, TextPlanning

__all__ = ["dagger_keys", "demonstrations", "text_rows"]


def dagger_keys(pipeline: Pipeline) -> Mapping[str, str]:
    """Key of each folder of corrections; none without a base model of this configuration's own to correct."""
    cfg = pipeline.cfg.dagger
    if pipeline.cfg.model.weights is not None:
        return {}
    counts = {"dagger": {"episodes": cfg.episodes}, "dagger_in_text": {"text_planning": cfg.text_planning}}
    inputs = {"base": pipeline.key("base")}
    return {
        name: stage_key({**count, "expert_share": cfg.expert_share}, pipeline.cfg.seed, inputs)
        for name, count in counts.items()
        if all(count.values())
    }


def demonstrations(pipeline: Pipeline, model: ModelConfig) -> Demos:
    """Demonstrations, and the corrections after them where there are any."""
    kind = "dagger"
    more = [pipeline.paths.shards(kind)] if kind in dagger_keys(pipeline) else []
    return Demos(pipeline.paths.shards("demos"), model, more)


def text_rows(pipeline: Pipeline, model: ModelConfig, demos: Demos) -> TextPlanning:
    """Text-planning rows, with the corrections in text among them where there are any."""
    kind = "dagger_in_text"
    corrected = pipeline.paths.shards(kind) if kind in dagger_keys(pipeline) else None
    return TextPlanning(pipeline.paths.shards("text_planning"), model, demos, corrected)
