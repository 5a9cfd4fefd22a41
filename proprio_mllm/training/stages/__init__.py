"""The stages of training, one file each, in the order in which `stage=all` runs them.

A new stage is a file here, a line in `STAGES`, and its name and settings in `configs/schema/train.py`.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

from proprio_mllm.training.pipeline import Stage
from proprio_mllm.training.stages.alignment import AlignmentStage
from proprio_mllm.training.stages.base import BaseStage
from proprio_mllm.training.stages.pointmap import PointMapStage
from proprio_mllm.training.stages.practice import PracticeStage
from proprio_mllm.training.stages.selu import SeluStage
from proprio_mllm.training.stages.tokenizer import TokenizerStage
from proprio_mllm.training.stages.words import WordsStage

STAGES: Final[Mapping[str, Stage]] = {
    "words": WordsStage(),
    "practice": PracticeStage(),
    "base": BaseStage(),
    "pointmap": PointMapStage(),
    "tokenizer": TokenizerStage(),
    "alignment": AlignmentStage(),
    "selu": SeluStage(),
}
