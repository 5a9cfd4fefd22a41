"""Lessons as base and the stages after it read them: decisions with pictures, and episodes in words."""

from __future__ import annotations

from pathlib import Path
from typing import Final

from torch import nn

from configs.schema.model import ModelConfig
from proprio_mllm.model.building import TRAINED_HERE, build_point_map
from proprio_mllm.model.modeling import ProprioMLLM
from proprio_mllm.model.motion_tokenizer import MotionTokenizer
from proprio_mllm.model.named_map import NamedPointMap
from proprio_mllm.model.placing import Placing
from proprio_mllm.model.tensors import read_tensors
from proprio_mllm.training.pipeline import Pipeline, seeded
from proprio_mllm.training.placing import behind_places, placed
from proprio_mllm.training.sources import Demos
from proprio_mllm.training.stages.pointmap import WEIGHTS
from proprio_mllm.training.turns import Turns
from proprio_mllm.training.words import WordsObjective, mixed

#: Share of the simulator's episodes among those in words, where their places are read.
_BEHIND_PLACES: Final = 0.6


def lesson_folders(pipeline: Pipeline) -> list[Path]:
    """Shards of episodes in the simulator: the teacher's, and those in which a model acted where one did."""
    acted = pipeline.cfg.model.weights is None or pipeline.cfg.practice.student is not None
    names = ("lessons", "practice") if acted else ("lessons",)
    return [pipeline.paths.shards(name) for name in names]


def lessons_of(pipeline: Pipeline, model: ModelConfig) -> Demos:
    """Their rows."""
    first, *more = lesson_folders(pipeline)
    return Demos(first, model, more)


def episodes_in_words(pipeline: Pipeline, model: ProprioMLLM, key: str, turns: Turns | None = None) -> WordsObjective:
    """Episodes of the text world and of the simulator, in the shares of stage `practice`.

    For a model whose answers say where things are, those of the simulator are from `turns`, with places read, and more of them.
    """
    lessons, cfg = pipeline.lessons, pipeline.cfg.practice
    if turns is not None and model.cfg.places:
        told = [behind_places(episode) for episode in turns.episodes]
        seen = (_BEHIND_PLACES, lambda seed: told[seed // 1000 % len(told)])
        return WordsObjective(model, mixed(lessons.episode, seen), key)
    shares = zip((cfg.logged, cfg.own_share), map(lessons.logged, lesson_folders(pipeline)), strict=False)
    return WordsObjective(model, mixed(lessons.episode, *shares), key)


def turns_of(pipeline: Pipeline, model: ProprioMLLM, demos: Demos, tokens: MotionTokenizer | None = None) -> Turns:
    """Decisions with pictures of the rows of `lessons_of`; with the places of things where the model says them."""
    episodes = [episode for folder in lesson_folders(pipeline) for episode in pipeline.lessons.told(folder)]
    encoder = point_map_of(pipeline, pipeline.cfg.model) if model.cfg.places else None
    if isinstance(encoder, NamedPointMap):
        episodes = placed(episodes, demos, Placing(model, encoder))
    return Turns(model, demos, episodes, tokens)


def point_map_of(pipeline: Pipeline, cfg: ModelConfig) -> nn.Module | None:
    """The point map as its stage left it, or as it comes trained."""
    encoder = seeded(lambda: build_point_map(cfg), pipeline.cfg.seed)
    if encoder is not None and cfg.point_map.encoder in TRAINED_HERE:
        encoder.load_state_dict(read_tensors(pipeline.paths.model("pointmap") / WEIGHTS))
    return encoder
