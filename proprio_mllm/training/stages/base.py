"""Stage `base`: the language model of `practice` learns to see; stands in for the pretraining of Qwen2.5-VL."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from configs.schema.model import ModelConfig
from proprio_mllm.model.building import build_model, build_processor, load_model
from proprio_mllm.model.dense import DenseHead
from proprio_mllm.model.groups import train_only
from proprio_mllm.model.modeling import ProprioMLLM
from proprio_mllm.model.word_tokens import add_word_tokens, known_words, tokens_of
from proprio_mllm.model.wording import name_words
from proprio_mllm.training.base import DenseObjective, JointObjective, grounding_accuracy
from proprio_mllm.training.pipeline import Metrics, Pipeline, base_model_config, seeded
from proprio_mllm.training.sources import BODY_RELATIVE, GROUNDING, Clips, Views
from proprio_mllm.training.stages.inputs import episodes_in_words, lessons_of, turns_of
from proprio_mllm.training.text import adopt, corpus, order_places, start_from_words, whole_words
from proprio_mllm.training.turns import turn_accuracy
from proprio_mllm.training.words import held_out_metrics


class BaseStage:
    """Dense grounding of the tower first, then grounding and planning together, all weights training."""

    name = "base"
    needs = ("practice",)
    shards = ("views", "lessons", "clips")
    recipe = 12

    def settings(self, pipeline: Pipeline) -> Mapping[str, Any]:
        """Of the tokenizer only the words: no stage before it, and no motion in its prompts."""
        model = pipeline.cfg.model
        plain = dataclasses.asdict(base_model_config(model)) | {"motion": model.motion.vocabulary}
        return {"base": dataclasses.asdict(pipeline.cfg.base), "model": plain}

    def run(self, pipeline: Pipeline, folder: Path, key: str) -> Metrics:
        """Trains and stores the base model, and measures it; nothing to do where pretrained weights are given."""
        if pipeline.needs_no(self.name):
            return {}
        cfg, plain = pipeline.cfg, dataclasses.replace(base_model_config(pipeline.cfg.model), sees=True)
        views, clips = Views(pipeline.paths.shards("views"), plain), Clips(pipeline.paths.shards("clips"))
        given = pipeline.given(self.name)
        model = _untrained(pipeline, plain, views, clips) if given is None else _released(pipeline, plain, given)
        demos = lessons_of(pipeline, plain)
        turns = turns_of(pipeline, model, demos)
        if given is None:
            words = tokens_of(model.processor.tokenizer)
            head = seeded(lambda: DenseHead([words.tokens(name_words(name)) for name in views.type_names]), cfg.seed)
            dense = DenseObjective(model, head, views, cfg.base, f"{key}/dense")
            chosen = {id(p) for p in train_only(model, ("vision", "merger"))} | {id(p) for p in head.parameters()}
            for parameter in dense.module.parameters():
                parameter.requires_grad_(id(parameter) in chosen)
            pipeline.loop(dense, cfg.base.dense, folder / "dense")
            model.requires_grad_(True)
            episodes = episodes_in_words(pipeline, model, f"{key}/words")
            joint = JointObjective(model, head, views, turns, demos, clips, episodes, cfg.base, f"{key}/joint")
            pipeline.loop(joint, cfg.base.joint, folder / "joint")
        pipeline.store("base", model)
        asked = grounding_accuracy(model, views, (*GROUNDING, *BODY_RELATIVE))
        return {**asked, **turn_accuracy(model, turns), **held_out_metrics(model, {"": pipeline.lessons.episode})}


def _untrained(pipeline: Pipeline, plain: ModelConfig, views: Views, clips: Clips) -> ProprioMLLM:
    """The language model of `practice` with a vision tower that has learnt nothing."""
    seed = pipeline.cfg.seed
    processor = build_processor(plain, corpus(plain, views, clips, seed), whole_words(views))
    add_word_tokens(processor.tokenizer, pipeline.lessons.words())
    model = build_model(plain, processor, seed)
    adopt(model, load_model(pipeline.paths.model("practice")))
    start_from_words(model, views.type_names)
    order_places(model, seed)
    return model


def _released(pipeline: Pipeline, plain: ModelConfig, given: Path) -> ProprioMLLM:
    """The released base model, if it is one of this configuration and knows the words of the lessons."""
    model = load_model(given)
    unknown = set(pipeline.lessons.words()) - set(known_words(model.processor.tokenizer))
    pipeline.fits(given, (model.cfg, f"without {sorted(unknown)[:3]}"), (plain, "without []"))
    return model
