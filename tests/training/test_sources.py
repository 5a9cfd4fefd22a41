"""Questions about views speak the model's prompt style."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from configs.schema.model import ModelConfig
from data.motion import HAND_OPENING, OPEN_HAND
from proprio_mllm.model.questions import ask
from proprio_mllm.training.sources import BODY_RELATIVE, GROUNDING, Demos, Views, grips_of


@pytest.mark.parametrize(
    ("style", "wanted"), [("terse", ("side  lamp  _1", "see?")), ("full", ("Is Lamp_1 to the left", "do you see"))]
)
def test_views_ask_in_the_models_style(shards: Path, cfg: ModelConfig, style: str, wanted: tuple[str, ...]) -> None:
    views = Views(shards / "views", dataclasses.replace(cfg, prompt=style))
    row = next(row for row in map(views.row, views.split.train) if any(obj["id"] == "Lamp_1" for obj in row.objects))
    asked = [one.question for one in views.asked(row, ("side",), 100, np.random.default_rng(0))]
    text = "\n".join([*asked, views.listing(row)[0]])
    for part in wanted:
        assert part in text


def test_each_thing_is_asked_about_once_and_every_kind_comes_up(shards: Path, cfg: ModelConfig) -> None:
    views, rng, kinds = Views(shards / "views", cfg), np.random.default_rng(0), (*GROUNDING, *BODY_RELATIVE)
    questions: set[str] = set()
    for row in map(views.row, views.split.train):
        asked = views.asked(row, kinds, 100, rng)
        assert sorted(one.thing["id"] for one in asked) == sorted(thing["id"] for thing in row.objects)
        questions |= {one.question.split()[0] for one in asked}
        assert len(views.asked(row, kinds, 2, rng)) == 2
    assert questions == {ask(kind).strip() for kind in kinds}


def test_grips_are_rows_of_one_robot_with_the_same_hands_open(shards: Path, cfg: ModelConfig) -> None:
    demos = Demos(shards / "lessons", cfg)
    rng = np.random.default_rng(0)
    demos.motions[:, -1, HAND_OPENING] = rng.choice((0.2, 1.0), (len(demos.motions), 2))
    grips, robots = grips_of(demos), demos.reader.column("robot")
    assert len(grips) == 4
    assert sorted(row for rows in grips for row in rows) == demos.split.train.tolist()
    for rows in grips:
        opened = demos.motions[rows, -1, HAND_OPENING] >= OPEN_HAND
        assert len({(robots[row], *hands) for row, hands in zip(rows, opened.tolist(), strict=True)}) == 1
