"""Planning exercises in text alone."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from configs.schema.model import ModelConfig
from proprio_mllm.training.exercises import GROUPS, Exchange, is_symbolic
from proprio_mllm.training.sources import Demos, Exercises
from sim.tasks.instructions import natural_name

ROW = {
    "instruction": "Take the soap bottle from the second side table and put the bottle next to the TV stand on the desk.",
    "visible": ["SoapBottle_1", "SideTable_2", "Bottle_1"],
    "known": ["TVStand_1", "Desk_1", "SideTable_1"],
    "history": [{"step": "GoTo(SideTable_2)", "feedback": "GoTo(SideTable_2) ok"}],
    "target": "Pick(right, SoapBottle_1) & Pick(left, Bottle_1)",
    "image": b"",
}


def test_words_are_those_of_the_instructions() -> None:
    for group in GROUPS:
        for name, word in group.items():
            assert natural_name(name) == word


def test_names_change_everywhere_alike() -> None:
    small = {"SoapBottle": "Mug", "Bottle": "SoapBottle", "Mug": "Bottle"}
    exchange = Exchange(small | {"SideTable": "Desk", "Desk": "SideTable"})
    row = exchange.row(ROW)
    assert row["instruction"] == (
        "Take the mug from the second desk and put the soap bottle next to the TV stand on the side table."
    )
    assert row["visible"] == ["Mug_1", "Desk_2", "SoapBottle_1"]
    assert row["known"] == ["TVStand_1", "SideTable_1", "Desk_1"]
    assert row["history"] == [{"step": "GoTo(Desk_2)", "feedback": "GoTo(Desk_2) ok"}]
    assert row["target"] == "Pick(right, Mug_1) & Pick(left, SoapBottle_1)"
    assert ROW["visible"][0] == "SoapBottle_1"


def test_a_drawn_exchange_is_one_to_one() -> None:
    exchange = Exchange.draw(np.random.default_rng(3))
    names = [f"{name}_1" for group in GROUPS for name in group]
    changed = [exchange.ids(name) for name in names]
    assert sorted(changed) == sorted(names)
    assert changed != names
    words = [word for group in GROUPS for word in group.values()]
    assert sorted(exchange.words(word) for word in words) == sorted(words)
    text = exchange.row(ROW)["instruction"]
    assert re.search(r"the TV stand", text)


@pytest.mark.parametrize(
    ("step", "symbolic"),
    [
        ("GoTo(Mug_1)", True),
        ("Pick(left, Mug_1) & Open(right, Fridge_1)", True),
        ("Done()", True),
        ("MoveDown(0.1)", False),
        ("RotateLeft(30)", False),
        ("GoTo(Mug_1, auto, -20)", False),
        ("GoTo(Mug_1, 0.5)", False),
    ],
)
def test_steps_that_depend_on_the_scene_are_left_out(step: str, symbolic: bool) -> None:
    assert is_symbolic(step) is symbolic


def test_exercises_in_words_ask_for_steps_names_and_states(shards: Path, cfg: ModelConfig) -> None:
    exercises = Exercises(shards / "exercises", cfg, Demos(shards / "demos", cfg))
    rng = np.random.default_rng(0)
    drawn = [exercises.draw(rng) for _ in range(120)]
    assert not any(example.views for example in drawn)
    endings = [example.messages[-2].text.splitlines()[-1].split(" ")[0] for example in drawn]
    assert 10 < endings.count("named?") < 40
    assert 3 < endings.count("which") < 30
    named = next(example for example, ending in zip(drawn, endings, strict=True) if ending == "named?")
    assert named.messages[-1].text.endswith("_1")
