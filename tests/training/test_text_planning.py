"""Planning exercises in text alone."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from configs.schema.model import ModelConfig
from data.interface.observation import HistoryItem
from data.motion import HAND_OPENING
from data.shards import ShardWriter
from proprio_mllm.training.sources import Bodies, Demos, TextPlanning
from proprio_mllm.training.states import open_hands
from proprio_mllm.training.text_planning import GROUPS, Exchange, is_symbolic
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


def _episode(instruction: str, moments: list[tuple[str, str, list[str]]]) -> list[dict[str, object]]:
    """Rows of an episode: the expert's step (empty: not recorded), the step taken and what is known, at each moment."""
    rows: list[dict[str, object]] = []
    log: list[dict[str, str]] = []
    for step, (target, taken, known) in enumerate(moments):
        if target:
            row = {"instruction": instruction, "robot": "h1", "category": "single", "step": step, "time_limit": 20}
            rows.append({**row, "visible": [], "known": known, "history": log[-8:], "named": [], "target": target})
        log.append({"step": taken, "feedback": f"{taken} ok"})
    return rows


def _learnt(text_planning: TextPlanning, index: int) -> list[str]:
    asked = text_planning.example(index, np.random.default_rng(0)).messages[-2]
    return [asked.text[start:end] for start, end in asked.learnt]


def test_steps_of_the_log_that_the_expert_would_have_taken_are_learnt(shards: Path, cfg: ModelConfig, tmp_path: Path) -> None:
    go, pick, place, drawer = "GoTo(Mug_1)", "Pick(left, Mug_1)", "Place(left, Desk_1)", "Open(left, Drawer_1)"
    both = ["Mug_1", "Desk_1"]
    first = _episode("a", [(go, go, both), (pick, place, both), (pick, pick, both), (place, place, [*both, "Cup_1"])])
    hidden = _episode("b", [(drawer, drawer, ["Drawer_1"]), (go, go, ["Drawer_1", "Mug_1"]), (pick, pick, both)])
    unsure = _episode("b", [("", go, both), (pick, pick, both), (place, place, both)])
    ups = [f"MoveUp({n}.5)" for n in range(1, 13)]
    long = _episode("c", [(up, up, both) for up in ups])
    writer = ShardWriter(tmp_path / "text_planning", "text_planning", "test")
    writer.write(0, [*first, *hidden, *unsure, *long])
    writer.finish({})
    text_planning = TextPlanning(tmp_path / "text_planning", cfg, Demos(shards / "demos", cfg))
    # the mistake teaches nothing; the cup, seen last, gives nothing away
    assert [_learnt(text_planning, i) for i in range(4)] == [[], [go], [go], [go, pick]]
    # the mug in the prompt would give away what the drawer held
    assert [_learnt(text_planning, i) for i in range(4, 7)] == [[], [], [go]]
    # an episode of the same task follows; its first step has no answer
    assert [_learnt(text_planning, i) for i in range(7, 9)] == [[], [pick]]
    # of a log that is cut off, the steps that have four others before them
    assert _learnt(text_planning, 9 + 11) == ups[7:11]
    assert text_planning.example(9 + 11, np.random.default_rng(0), answered=False).messages[-1].learnt == ()


def test_exercises_in_words_ask_for_steps_names_and_states(shards: Path, cfg: ModelConfig) -> None:
    text_planning = TextPlanning(shards / "text_planning", cfg, Demos(shards / "demos", cfg))
    rng = np.random.default_rng(0)
    drawn = [text_planning.draw(rng) for _ in range(120)]
    assert not any(example.views for example in drawn)
    endings = [example.messages[-2].text.splitlines()[-1].split(" ")[0] for example in drawn]
    assert 10 < endings.count("named?") < 40
    assert 3 < endings.count("which") < 30
    named = next(example for example, ending in zip(drawn, endings, strict=True) if ending == "named?")
    assert named.messages[-1].text.endswith("_1")


@pytest.mark.parametrize(
    ("feedback", "expected"),
    [
        ((), (True, True)),
        (("GoTo(Mug_1) ok", "Pick(left, Mug_1) ok"), (False, True)),
        (("Pick(left, Mug_1) ok; Pick(right, Cup_1) ok", "Place(left, Shelf_1) ok"), (True, False)),
        (("Pick(left, Mug_1) TooFar", "nonsense ok"), (True, True)),
        (("Lift(Box_1) ok",), (False, False)),
        (("Lift(Box_1) ok", "PlaceBoth(Desk_1) ok"), (True, True)),
    ],
)
def test_a_log_tells_which_hands_are_empty(feedback: tuple[str, ...], expected: tuple[bool, bool]) -> None:
    assert open_hands([HistoryItem(text, text) for text in feedback]) == expected


def test_steps_in_words_get_motion_whose_hands_agree_with_the_log(shards: Path, cfg: ModelConfig) -> None:
    demos = Demos(shards / "demos", cfg)
    left, right = HAND_OPENING.start, HAND_OPENING.start + 1
    demos.motions[:, -1, left], demos.motions[:, -1, right] = 1.0, 0.5
    demos.motions[demos.split.train[0], -1, right] = 1.0
    tokens = np.tile(np.arange(len(demos.motions))[:, None] % 16, (1, 4))
    bodies = Bodies(demos, tokens)
    rng = np.random.default_rng(0)
    robot = demos.reader[int(demos.split.train[0])]["robot"]
    empty = {"robot": robot, "step": 0, "history": []}
    left_full = {"robot": robot, "step": 1, "history": [{"step": "", "feedback": "Pick(left, Mug_1) ok"}]}
    assert bodies.draw(empty, rng) == tokens[demos.split.train[0]].tolist()
    assert bodies.draw(left_full, rng) is None
    assert sum(len(rows) for rows in bodies.grips) == len(demos.split.train)
    text_planning = TextPlanning(shards / "text_planning", cfg, demos)
    shown = [len(re.findall(r"<motion_\d+>", text_planning.draw(rng, bodies).messages[1].text)) for _ in range(40)]
    assert {0, 4} <= set(shown)
    plain = [text_planning.draw(rng).messages[1].text for _ in range(40)]
    assert not any("<motion" in text for text in plain)
    index = next(
        i
        for i in range(len(text_planning.reader))
        if len(text_planning.reader[i]["history"]) == text_planning.reader[i]["step"]
    )
    assert bodies.draw({**text_planning.reader[index], "step": 99}, rng) is None
