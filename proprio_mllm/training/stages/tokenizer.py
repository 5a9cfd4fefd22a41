"""Stage `tokenizer` (paper, stage 1): the motion VQ-VAE learns on clips and on the robot's own recorded motion."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from data.shards import ShardReader, decode_motion
from proprio_mllm.model.motion_tokenizer import MotionTokenizer
from proprio_mllm.training.motion_stage import FEATURE_BIAS, MotionObjective, MotionWindows, tokenizer_metrics
from proprio_mllm.training.pipeline import Metrics, Pipeline, seeded
from proprio_mllm.training.processes import first_alone
from proprio_mllm.training.reconstruction import render
from proprio_mllm.training.sources import Clips


class TokenizerStage:
    """Motion windows to discrete codes."""

    name = "tokenizer"
    needs = ()
    shards = ("clips", "views", "lessons")
    recipe = 3

    def settings(self, pipeline: Pipeline) -> Mapping[str, Any]:
        """The loop, the codec and the weights of its features."""
        cfg = pipeline.cfg
        motion = dataclasses.asdict(cfg.model.motion)
        return {"loop": dataclasses.asdict(cfg.tokenizer), "motion": motion, "bias": FEATURE_BIAS.tolist()}

    def run(self, pipeline: Pipeline, folder: Path, key: str) -> Metrics:
        """Trains and stores the tokenizer, draws reconstructions, and measures it."""
        motion = pipeline.cfg.model.motion
        clips = Clips(pipeline.paths.shards("clips"))
        recorded = []
        for name, kind in (("views", "views"), ("lessons", "demos")):
            reader = ShardReader(pipeline.paths.shards(name), kind)
            rows = [decode_motion(row)[-motion.window :] for row in reader.column("motion")]
            recorded.append(np.stack(rows) if rows else np.zeros((0, motion.window, motion.features), dtype=np.float32))
        windows = MotionWindows(clips, recorded, motion.window)
        if (given := pipeline.given(self.name)) is not None:
            tokenizer = MotionTokenizer.load(given)
            pipeline.fits(given, tokenizer.cfg, motion)
        else:
            tokenizer = seeded(lambda: MotionTokenizer(motion), pipeline.cfg.seed)
            tokenizer.set_normalisation(*windows.statistics())
            pipeline.loop(MotionObjective(tokenizer, windows, key), pipeline.cfg.tokenizer, folder)
        first_alone(lambda: tokenizer.eval().save(pipeline.paths.model("tokenizer")))
        first_alone(lambda: render(tokenizer, clips, folder / "pictures"))
        return tokenizer_metrics(tokenizer, windows)
