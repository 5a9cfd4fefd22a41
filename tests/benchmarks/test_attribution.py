"""Agreement, matrix, flags and exit codes of the validation, on made-up results."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from benchmarks import attribution as validation
from benchmarks.attribution import main, validate
from benchmarks.fault_episodes import Scripted, ScriptedResult
from interface.episode import EpisodeRecord, Outcome
from interface.failures import FailureCategory

NAVIGATION, BODY, LOGICAL = FailureCategory


def result(
    cause: str,
    given: FailureCategory | None,
    *,
    robot: str = "h1",
    mattered: bool = True,
    invalid: int = 0,
    done: bool = False,
    exhausted: bool | None = None,
    slip: str | None = None,
) -> ScriptedResult:
    episode = Scripted("t", "pick", robot, cause, done, slip, False, 0, 0)
    outcome = Outcome.SUCCESS if given is None else Outcome.FAILURE
    ran_out = (not done) if exhausted is None else exhausted
    trace = ({"step": "Done()" if done else "MoveAhead(5)", "outcomes": []},)
    record = EpisodeRecord(
        "scripted",
        robot,
        "t",
        "single",
        "easy",
        0,
        0,
        cause,
        outcome,
        given,
        invalid,
        ran_out,
        0,
        1,
        1,
        1,
        1,
        1,
        0,
        0,
        1,
        trace,
    )
    return ScriptedResult(episode, record, mattered, slip is not None, ())


GOOD = [
    result("steps back", NAVIGATION),
    result("crouches", BODY, robot="x1", done=True),
    result("babbles", LOGICAL, invalid=2),
    result("stops early", LOGICAL, done=True, slip="stammers", invalid=1),
]


def test_counts() -> None:
    found = validate(
        [*GOOD, result("crouches", NAVIGATION), result("one hand", None), result("one hand", LOGICAL, mattered=False)]
    )
    assert (found.agreed, found.episodes) == (4, 5)
    assert found.matrix[BODY, NAVIGATION] == 1 and found.matrix[LOGICAL, LOGICAL] == 2
    assert (found.robots, found.families, found.causes) == (2, 1, 4)
    assert found.left_out == {
        "the task was solved all the same": 1,
        "the mistake was not made where it matters": 1,
    }
    assert found.flags_agree
    assert not found.passed and validate(GOOD * 5 + [result("crouches", NAVIGATION)]).passed


@pytest.mark.parametrize(
    "wrong",
    [
        result("steps back", NAVIGATION, invalid=1),
        result("babbles", LOGICAL),
        result("steps back", NAVIGATION, exhausted=False),
        result("steps back", NAVIGATION, done=True, exhausted=True),
    ],
)
def test_a_wrong_flag_is_noticed(wrong: ScriptedResult) -> None:
    assert not validate([*GOOD, wrong]).flags_agree


def _main(monkeypatch, tmp_path: Path, results: list[ScriptedResult], *more: str) -> int:
    monkeypatch.setattr(validation, "run_cells", lambda *_: results)
    return main([f"out={tmp_path}", "workers=0", *more])


def test_command_writes_and_judges(monkeypatch, tmp_path: Path, capsys) -> None:
    assert _main(monkeypatch, tmp_path, GOOD * 15) == 0
    text = (tmp_path / "validation.md").read_text()
    assert "agreement 100.0 [94.0, 100.0] 60/60" in text
    stored = json.loads((tmp_path / "validation.json").read_text())
    assert stored["schema_version"] == 1 and stored["matrix"]["logical"]["logical"] == 30 and len(stored["runs"]) == 60
    assert _main(monkeypatch, tmp_path, GOOD) == 1, "too few"
    assert _main(monkeypatch, tmp_path, GOOD, "robot=h1") == 0
    capsys.readouterr()
    assert _main(monkeypatch, tmp_path, [*GOOD, result("one hand", BODY)] * 15) == 1
    assert "one hand on h1, t: body_adjustment, not logical" in capsys.readouterr().out
    assert _main(monkeypatch, tmp_path, [result("one hand", None)]) == 1
    assert "no episode counts of 1" in capsys.readouterr().err


@pytest.mark.parametrize("wrong", ["robot=r2", "workers=-1", "per_cause=0", "nothing=1"])
def test_wrong_arguments(wrong: str, capsys) -> None:
    assert main([wrong]) == 2
    assert wrong.split("=")[1].lstrip("-") in capsys.readouterr().err or wrong.startswith("nothing")
