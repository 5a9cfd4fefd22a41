"""Lessons as base and the stages after it read them: decisions with pictures, and episodes in words."""

from __future__ import annotations

from pathlib import Path

from configs.schema.model import ModelConfig
from proprio_mllm.model.modeling import ProprioMLLM
from proprio_mllm.model.motion_tokenizer import MotionTokenizer
from proprio_mllm.training.pipeline import Pipeline
from proprio_mllm.training.sources import Demos
from proprio_mllm.training.turns import Turns
from proprio_mllm.training.words import WordsObjective, mixed


def lesson_folders(pipeline: Pipeline) -> list[Path]:
    """Shards of episodes in the simulator: the teacher's, and those in which a model acted where one did."""
    acted = pipeline.cfg.model.weights is None or pipeline.cfg.practice.student is not None
    names = ("lessons", "practice") if acted else ("lessons",)
    return [pipeline.paths.shards(name) for name in names]


def lessons_of(pipeline: Pipeline, model: ModelConfig) -> Demos:
    """Their rows."""
    first, *more = lesson_folders(pipeline)
    return Demos(first, model, more)


def episodes_in_words(pipeline: Pipeline, model: ProprioMLLM, key: str) -> WordsObjective:
    """Episodes of the text world and of the simulator, in the shares of stage `practice`."""
    lessons, cfg = pipeline.lessons, pipeline.cfg.practice
    shares = zip((cfg.logged, cfg.own_share), map(lessons.logged, lesson_folders(pipeline)), strict=False)
    return WordsObjective(model, mixed(lessons.episode, *shares), key)


def turns_of(pipeline: Pipeline, model: ProprioMLLM, demos: Demos, tokens: MotionTokenizer | None = None) -> Turns:
    """Decisions with pictures of the rows of `lessons_of`."""
    return Turns(model, demos, lesson_folders(pipeline), pipeline.lessons.told, tokens)
