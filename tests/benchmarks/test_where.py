"""The look-up by position ids: what it can know, and what it must not."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from benchmarks.where import Options, Seen, ids_of, main, told_by_ids, told_by_points
from interface.bodies import KEY_BODIES
from interface.observation import Camera
from tests.training.conftest import write_views


def thing(column: int, side: str, test: bool, robot: str = "h1") -> Seen:
    return Seen(robot, test, {"mrope": (0, column), "blind": (0, 0)}, {"side": side})


def test_ids_answer_what_they_decide_and_the_commonest_answer_the_rest() -> None:
    known = [thing(0, "left", False), thing(1, "right", False), thing(0, "left", False)]
    asked = [thing(0, "left", True), thing(1, "right", True), thing(2, "left", True)]
    assert told_by_ids([*known, *asked], "mrope", "side") == (3, 3)
    assert told_by_ids([*known, *asked], "blind", "side") == (2, 3)
    assert told_by_ids([*known, *asked], "", "side") == (2, 3)


def test_robots_have_tables_of_their_own_and_held_out_views_are_in_none() -> None:
    known = [thing(0, "left", False), thing(0, "right", False, "x1")]
    assert told_by_ids([*known, thing(0, "right", True, "x1"), thing(0, "left", True)], "mrope", "side") == (2, 2)
    assert told_by_ids([*known, thing(0, "ahead", True)], "mrope", "side") == (0, 1)


def test_a_token_left_of_and_below_the_robots_place_has_those_signs() -> None:
    ahead = np.array([[0.0, 0.0, 1.0, 0.0], [-1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
    camera = Camera(np.array([[100.0, 0.0, 100.0], [0.0, 100.0, 100.0], [0.0, 0.0, 1.0]]), ahead, 200, 200)
    bodies = np.zeros((len(KEY_BODIES), 3))
    bodies[:, 0] = 1.0  # everything lies in the middle of the picture
    found = ids_of((7, 1), 8, camera, bodies)
    assert found["mrope"] == (7, 1)
    assert found["rope_sign, body"] == (1, -1) and found["rope_radial, body"] == (4, -3)
    assert found["rope_sign, hands"] == (1, -1, 1, -1)


def test_the_table_is_made_from_shards(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_views(tmp_path / "views", 60)
    assert main([f"views={tmp_path / 'views'}"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert "asked about" in lines[0] and lines[1].split() == ["known", "side", "arm", "distance", "height", "reach", "shift"]
    assert [line[:24].strip() for line in lines[2:5]] == ["robot alone", "mrope", "rope_radial, reach"]


def test_points_answer_by_themselves(tmp_path: Path) -> None:
    write_views(tmp_path / "views", 200)
    found = told_by_points(Options(str(tmp_path / "views"), model=str(Path(__file__).parents[2] / "weights/tiny/full")))
    shares = {source: {question: right / count for question, (right, count) in one.items()} for source, one in found.items()}
    assert set(shares) == {"true points", "the point map's points"}
    assert shares["true points"]["side"] > 0.8 and shares["true points"]["height"] > 0.8, shares
    assert all(0.0 <= share <= 1.0 for share in shares["the point map's points"].values())
