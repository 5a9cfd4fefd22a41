"""The stages of training, one file each, in the order in which `stage=all` runs them.

A new stage is a file here, a line in `STAGES`, and its name and settings in `configs/schema/train.py`.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

from configs.schema.model import ModelConfig
from proprio_mllm.training.pipeline import Stage
from proprio_mllm.training.stages.alignment import AlignmentStage, EpisodeAlignmentStage
from proprio_mllm.training.stages.base import BaseStage, EpisodeBaseStage
from proprio_mllm.training.stages.dagger import DaggerStage
from proprio_mllm.training.stages.pointmap import PointMapStage
from proprio_mllm.training.stages.practice import PracticeStage
from proprio_mllm.training.stages.selu import SeluStage
from proprio_mllm.training.stages.tokenizer import TokenizerStage
from proprio_mllm.training.stages.words import WordsStage

__all__ = ["STAGES", "stages_of"]

STAGES: Final[Mapping[str, Stage]] = {
    "words": WordsStage(),
    "practice": PracticeStage(),
    "base": BaseStage(),
    "dagger": DaggerStage(),
    "pointmap": PointMapStage(),
    "tokenizer": TokenizerStage(),
    "alignment": AlignmentStage(),
    "selu": SeluStage(),
}


def stages_of(model: ModelConfig) -> Mapping[str, Stage]:
    """The stages of a model: with `episodes`, those that read whole episodes, and no `dagger`, whose place `practice` takes."""
    if not model.episodes:
        return STAGES
    found: dict[str, Stage] = {**STAGES, "base": EpisodeBaseStage(), "alignment": EpisodeAlignmentStage()}
    del found["dagger"]
    return found
