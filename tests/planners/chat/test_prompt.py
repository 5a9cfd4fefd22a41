"""The shared prompt: role, grammar, codes, scene; nothing that an observation does not hold."""

from __future__ import annotations

import io

import numpy as np
from PIL import Image

from interface.actions import ACTIONS
from interface.failures import FailureCode
from interface.manual import action_manual, code_manual
from interface.observation import HistoryItem
from proprio_mllm.planners.chat.planner import role
from proprio_mllm.planners.chat.view import body_text, encoded, log_text, scene_text
from tests.planners.chat.script import observation


def test_every_action_and_every_code_is_described() -> None:
    manual = action_manual()
    assert all(f"- {name}(" in manual for name in ACTIONS)
    assert "- GoTo(object, [metres 0.2 to 2], [bearing -180 to 180 degrees, left positive]): " in manual
    assert "- Pick(arm, object): " in manual
    assert "- Lift(object): " in manual
    assert all(f"- {code}: " in code_manual() for code in (*FailureCode, "InvalidOutput"))


def test_the_role_tells_the_robot_apart() -> None:
    h1, x1 = role("h1"), role("x1")
    assert "H1" in h1
    assert "0.7 and 1.03 m" in h1
    assert "two-finger gripper" in x1
    assert "0.43 and 0.61 m" in x1


def test_the_scene_has_task_budget_names_and_log() -> None:
    history = (HistoryItem("GoTo(Mug_1)", "GoTo(Mug_1) ok"), HistoryItem("Pick(left, Mug_1)", "Pick(left, Mug_1) TooFar"))
    text = scene_text(observation(history), 20, body=False)
    assert "Task: pick up the mug" in text
    assert "step 3 of at most 50; in time are 9" in text
    assert "Objects in view: Mug_1\nKnown elsewhere: Fridge_1, Table_1" in text
    assert "1. GoTo(Mug_1) ok\n2. Pick(left, Mug_1) TooFar" in text
    assert "pelvis" not in text
    assert "pelvis" in scene_text(observation(), 20, body=True)


def test_a_long_log_says_what_it_leaves_out() -> None:
    history = tuple(HistoryItem(f"MoveAhead({i})", f"MoveAhead({i}) ok") for i in range(1, 6))
    assert log_text(history, 2).splitlines() == ["(3 earlier steps left out)", "4. MoveAhead(4) ok", "5. MoveAhead(5) ok"]
    assert log_text((), 5) == "nothing yet"


def test_the_body_in_words_names_side_and_height() -> None:
    seen = observation()
    motion = seen.proprioception.motion
    motion[-1, 42] = 0.83
    motion[-1, 46:] = (1.0, 0.2)
    text = body_text(seen.proprioception)
    assert "0.83 m above the floor" in text
    assert "left hand is open" in text
    assert "right hand is closed" in text


def test_a_picture_is_sent_as_it_was_seen() -> None:
    image = np.random.default_rng(0).integers(0, 255, (30, 40, 3), dtype=np.uint8)
    sent = encoded(image)
    np.testing.assert_array_equal(np.asarray(Image.open(io.BytesIO(sent.data))), image)
    assert sent == encoded(image)
    assert len(sent.digest) == 64
