"""Sanity: the expert has to solve its tasks, what breaks is a fault, and nothing is left behind."""

from __future__ import annotations

import tempfile
from pathlib import Path

import pytest

from proprio_mllm.evaluation import sanity as room
from proprio_mllm.evaluation.sanity import Verdict, sanity


def test_a_healthy_machine_passes_and_keeps_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    found = list(sanity(("expert", "words"), ("h1",)))
    assert [(one.planner, one.tasks, one.good) for one in found] == [("expert", 2, True), ("words", 2, True)]
    assert found[0].solved == 2
    assert not list(tmp_path.iterdir())


def test_what_breaks_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_: object, **__: object) -> None:
        raise RuntimeError("no world today")

    monkeypatch.setattr("sim.session.session.Session.reset", broken)
    (one,) = sanity(("scripted",), ("x1",))
    assert not one.good
    assert "no world today" in one.to_text()


@pytest.mark.parametrize(("planner", "solved", "good"), [("expert", 1, False), ("expert", 2, True), ("words", 0, True)])
def test_only_the_expert_has_to_solve_all(planner: str, solved: int, good: bool) -> None:
    assert room.PLANNERS[0] == "expert"
    assert Verdict(planner, "h1", solved, 2, "", 1.0).good is good
