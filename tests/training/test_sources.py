"""Questions about views speak the model's prompt style."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from configs.schema.model import ModelConfig
from proprio_mllm.training.sources import BODY_RELATIVE, GROUNDING, Views


@pytest.mark.parametrize(
    ("style", "wanted"), [("terse", ("side Lamp_1", "see?")), ("full", ("Is Lamp_1 to the left", "do you see"))]
)
def test_views_ask_in_the_models_style(shards: Path, cfg: ModelConfig, style: str, wanted: tuple[str, ...]) -> None:
    views = Views(shards / "views", dataclasses.replace(cfg, prompt=style))
    row = next(row for row in map(views.row, views.split.train) if any(obj["id"] == "Lamp_1" for obj in row.objects))
    asked = [question for question, _ in views.pairs(row, (*GROUNDING, *BODY_RELATIVE), 100, np.random.default_rng(0))]
    text = "\n".join([*asked, views.listing(row)[0]])
    for part in wanted:
        assert part in text
