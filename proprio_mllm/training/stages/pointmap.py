"""Stage `pointmap`: the small point-map encoder learns from the simulator's own depth; other encoders come trained."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from proprio_mllm.model.building import build_point_map
from proprio_mllm.training.geometry_stage import PointMapObjective, point_map_error
from proprio_mllm.training.pipeline import Metrics, Pipeline, seeded
from proprio_mllm.training.sources import Views


class PointMapStage:
    """Metric points from single views."""

    name = "pointmap"
    needs = ()
    shards = ("views",)
    recipe = 0

    def settings(self, pipeline: Pipeline) -> Mapping[str, Any]:
        """The loop and the encoder."""
        cfg = pipeline.cfg
        return {"loop": dataclasses.asdict(cfg.pointmap), "map": dataclasses.asdict(cfg.model.point_map)}

    def run(self, pipeline: Pipeline, folder: Path, key: str) -> Metrics:
        """Trains the encoder and measures it on held-out views."""
        encoder = seeded(lambda: build_point_map(pipeline.cfg.model), pipeline.cfg.seed)
        if encoder is None or not list(encoder.parameters()):
            return {}
        views = Views(pipeline.paths.shards("views"), pipeline.cfg.model)
        if pipeline.cfg.model.point_map.encoder == "sim":
            encoder.requires_grad_(True)
            pipeline.loop(PointMapObjective(encoder, views, key), pipeline.cfg.pointmap, folder)
        return point_map_error(encoder, views)
