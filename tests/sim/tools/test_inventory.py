"""`python -m sim catalogue`: what it lists is what exists."""

from __future__ import annotations

import json

import pytest

from configs.assets import ASSETS_VARIABLE
from interface.actions import ACTIONS
from sim.tools.catalogue import main


def test_json_lists_everything_with_counts(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["json=true"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["counts"]["types"] == 68 and found["counts"]["rooms"] == 10
    assert [row["name"] for row in found["robots"]] == ["h1", "x1"]
    assert {row["name"] for row in found["actions"]} == set(ACTIONS)
    assert all(found["counts"][name] == len(rows) for name, rows in found.items() if name != "counts")
    pick = next(row for row in found["actions"] if row["name"] == "Pick")
    assert pick["aliases"] == ["pickupobject"] and pick["kind"] == "arm"
    kitchen = next(row for row in found["rooms"] if row["name"] == "kitchen_1")
    assert kitchen["objects"]["Mug_1"] == "CounterTop_1"


def test_table_names_every_type(capsys: pytest.CaptureFixture[str]) -> None:
    assert main([]) == 0
    text = capsys.readouterr().out
    for word in ("types (68)", "LaundryHamper", "bathroom_2", "BodyTooHigh", "cameras (8): head, front"):
        assert word in text


def test_bad_assets_are_one_line(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(ASSETS_VARIABLE, "/nowhere/at/all")
    assert main([]) == 2
    assert "is not a folder" in capsys.readouterr().err
