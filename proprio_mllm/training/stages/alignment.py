"""Stage `alignment` (paper, stage 2): motion joins images and text, first alone, then all together, through LoRA."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from configs.schema.model import ModelConfig
from proprio_mllm.model.building import (
    add_adapter,
    build_model,
    build_processor,
    go_back,
    load_model,
    stored_config,
)
from proprio_mllm.model.groups import train_only
from proprio_mllm.model.modeling import ProprioMLLM
from proprio_mllm.model.motion_tokenizer import MotionTokenizer
from proprio_mllm.training.alignment import PHASES, AlignmentData, AlignmentObjective, body_state_accuracy, groups_of
from proprio_mllm.training.base import grounding_accuracy
from proprio_mllm.training.pipeline import Metrics, Pipeline, seeded, variant_model
from proprio_mllm.training.sources import Clips, Views, asked_by
from proprio_mllm.training.stages.inputs import episodes_in_words, lessons_of, point_map_of, turns_of
from proprio_mllm.training.turns import turn_accuracy
from proprio_mllm.training.words import held_out_metrics


class AlignmentStage:
    """The phases of `PHASES`, each a loop over its own parameter groups."""

    name = "alignment"
    needs = ("base", "practice", "pointmap", "tokenizer")
    shards = ("lessons",)
    recipe = 21

    def settings(self, pipeline: Pipeline) -> Mapping[str, Any]:
        """The phases, the variant's model, and whether it goes on from a released one."""
        cfg = pipeline.cfg
        model = dataclasses.asdict(variant_model(cfg.model, cfg.variant))
        continued = {"continued": True} if pipeline.continues(self.name) else {}
        return {"alignment": dataclasses.asdict(cfg.alignment), "model": model} | continued

    def run(self, pipeline: Pipeline, folder: Path, key: str) -> Metrics:
        """Trains and stores the variant's model, and measures grounding, body state and planning.

        A released one is stored as it is and not measured again, or goes through the last phase once more: the variant's own,
        or the full model's without the variant's parts.
        """
        given, phases = pipeline.given(self.name), tuple(PHASES)
        if given is None:
            model = start(pipeline)
        else:
            owner = "full" if given.name == "full" else pipeline.cfg.variant
            pipeline.fits(given, stored_config(given), _config(pipeline, owner))
            model, phases = load_model(given, cfg=_config(pipeline, pipeline.cfg.variant)), ("joint",)
            if not pipeline.continues(self.name):
                pipeline.store("alignment", model, MotionTokenizer.load(given / "motion") if model.cfg.proprioception else None)
                return {}
        tokenizer = MotionTokenizer.load(pipeline.paths.model("tokenizer"))
        views, clips = Views(pipeline.paths.shards("views"), model.cfg), Clips(pipeline.paths.shards("clips"))
        read = tokenizer if model.cfg.proprioception else None
        demos = lessons_of(pipeline, model.cfg)
        turns = turns_of(pipeline, model, demos, read)
        words = episodes_in_words(pipeline, model, f"{key}/words", turns)
        data = AlignmentData(model, tokenizer, clips, views, demos, turns, words, pipeline.cfg.alignment)
        for phase in phases:
            train_only(model, groups_of(phase, pipeline.cfg.alignment))
            objective = AlignmentObjective(model, data, phase, pipeline.cfg.alignment, f"{key}/{phase}")
            pipeline.loop(objective, getattr(pipeline.cfg.alignment, phase), folder / phase)
        if given is None and (share := pipeline.cfg.alignment.go_back):
            before = load_model(pipeline.paths.model("practice")) if model.cfg.weights is None else None
            go_back(model, before, share)
        pipeline.store("alignment", model, read)
        asked = grounding_accuracy(model, views, asked_by(model.cfg), tokens=read)
        felt = {} if turns.codes is None else body_state_accuracy(model, demos, turns.codes)
        told = held_out_metrics(model, {"": pipeline.lessons.episode})
        return {**asked, **felt, **turn_accuracy(model, turns), **told}


def start(pipeline: Pipeline) -> ProprioMLLM:
    """The base model with this variant's MPE and CSE and the trained point map."""
    cfg = _config(pipeline, pipeline.cfg.variant)
    point_map = point_map_of(pipeline, cfg) if cfg.cse.enabled else None
    if cfg.weights is None:
        base = load_model(pipeline.paths.model("base"))
        local = dataclasses.replace(cfg, weights=str(pipeline.paths.model("base") / "vlm"))
        model = build_model(local, base.processor, pipeline.cfg.seed, point_map)
        model.cfg = cfg
    else:
        model = build_model(cfg, build_processor(cfg), pipeline.cfg.seed, point_map)
    seeded(lambda: add_adapter(model), pipeline.cfg.seed)
    return model


def _config(pipeline: Pipeline, variant: str) -> ModelConfig:
    """A variant's."""
    return dataclasses.replace(variant_model(pipeline.cfg.model, variant), sees=True)
