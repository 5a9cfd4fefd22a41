"""Demonstrations and text rows of base and the stages after it: the teacher's own, and its corrections of a model."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from configs.schema.model import ModelConfig
from proprio_mllm.model.modeling import ProprioMLLM
from proprio_mllm.model.motion_tokenizer import MotionTokenizer
from proprio_mllm.training.paths import stage_key
from proprio_mllm.training.pipeline import Pipeline, StageError
from proprio_mllm.training.sources import Demos, TextPlanning
from proprio_mllm.training.turns import Turns
from proprio_mllm.training.words import WordsObjective, mixed

__all__ = ["dagger_keys", "demonstrations", "episodes_in_words", "lessons_of", "text_rows", "turns_of"]


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


def lesson_folders(pipeline: Pipeline) -> list[Path]:
    """Shards of episodes in the simulator: the teacher's, and those in which the words model acted where there is one."""
    names = ("lessons", "practice") if pipeline.cfg.model.weights is None else ("lessons",)
    return [pipeline.paths.shards(name) for name in names]


def lessons_of(pipeline: Pipeline, model: ModelConfig) -> Demos:
    """Their rows."""
    first, *more = lesson_folders(pipeline)
    return Demos(first, model, more, failures=True)


def episodes_in_words(pipeline: Pipeline, model: ProprioMLLM, key: str) -> WordsObjective:
    """Episodes of the text world and of the simulator, in the shares of stage `practice`.

    Raises:
        StageError: without a source of lessons.
    """
    lessons, cfg = pipeline.lessons, pipeline.cfg.practice
    if lessons is None:
        raise StageError("no source of lessons was given; run the stage with `python train.py`")
    shares = zip((cfg.logged, cfg.own_share), map(lessons.logged, lesson_folders(pipeline)), strict=False)
    return WordsObjective(model, mixed(lessons.episode, *shares), key)


def turns_of(pipeline: Pipeline, model: ProprioMLLM, demos: Demos, tokens: MotionTokenizer | None = None) -> Turns:
    """Decisions with pictures of the rows of `lessons_of`.

    Raises:
        StageError: without a source of lessons.
    """
    if pipeline.lessons is None:
        raise StageError("no source of lessons was given; run the stage with `python train.py`")
    return Turns(model, demos, lesson_folders(pipeline), pipeline.lessons.told, tokens)
