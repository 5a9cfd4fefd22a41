"""Stage `words`: the language model learns to plan from whole episodes in words, before it sees or feels anything."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from configs.schema.model import ModelConfig
from proprio_mllm.model.building import build_model, build_processor, load_model
from proprio_mllm.model.word_tokens import add_word_tokens
from proprio_mllm.training.pipeline import Metrics, Pipeline, base_model_config
from proprio_mllm.training.words import WordsObjective, held_out_metrics, mixed


class WordsStage:
    """One loop over episodes that are made as they are needed, and some that the simulator wrote."""

    name = "words"
    needs = ()
    shards = ("lessons",)
    recipe = 3

    def settings(self, pipeline: Pipeline) -> Mapping[str, Any]:
        """The loop and the plain backbone."""
        return {"words": dataclasses.asdict(pipeline.cfg.words), "model": dataclasses.asdict(_plain(pipeline.cfg.model))}

    def run(self, pipeline: Pipeline, folder: Path, key: str) -> Metrics:
        """Trains and stores the model; measures it on episodes that it was not trained on.

        Pretrained weights need none of it.
        """
        if pipeline.needs_no(self.name):
            return {}
        lessons, cfg = pipeline.lessons, _plain(pipeline.cfg.model)
        logged = lessons.logged(pipeline.paths.shards("lessons"))
        if (given := pipeline.given(self.name)) is not None:
            model = load_model(given)
            pipeline.fits(given, model.cfg.text, cfg.text)
        else:
            words = lessons.words()
            processor = build_processor(cfg, [" ".join(words)] * 2)
            add_word_tokens(processor.tokenizer, words)
            model = build_model(cfg, processor, pipeline.cfg.seed)
            model.requires_grad_(False)
            model.core.model.language_model.requires_grad_(True)
            episode = mixed(lessons.episode, (pipeline.cfg.words.logged, logged))
            objective = WordsObjective(model, episode, key, pipeline.cfg.words.reading)
            pipeline.loop(objective, pipeline.cfg.words.loop, folder / "loop")
        pipeline.store("words", model)
        return held_out_metrics(model, {"": lessons.episode, "_logged": logged})


def _plain(model: ModelConfig) -> ModelConfig:
    return dataclasses.replace(base_model_config(model), sees=False)
