"""An episode of a run, step by step in the browser."""

from __future__ import annotations

import io
import json
import shutil
from pathlib import Path

import pytest

from proprio_mllm.report.replay import main
from proprio_mllm.report.stored import load_run


@pytest.mark.parametrize(("typed", "shown"), [("\n" * 50, None), ("\n\nc\n", None), ("", None), ("\nq\n", 1)])
def test_steps_come_when_they_are_asked_for(
    acted_run: Path, typed: str, shown: int | None, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("sys.stdin", io.StringIO(typed))
    assert main([str(acted_run), "plant", "speed=1000"]) == 0
    (record,) = load_run(acted_run).records
    url, instruction, *lines = capsys.readouterr().out.splitlines()
    assert url.startswith("http://127.0.0.1:") and instruction
    told = [line for line in lines if line.startswith("   ")]
    assert len(told) == (len(record.trace) if shown is None else shown)
    assert all(" ".join(str(step["step"]).split())[:80] in line for step, line in zip(record.trace, lines[::2], strict=False))
    assert (lines[-1] == record.outcome.value) == (shown is None)
    assert "differs" not in "".join(told)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [(["{run}"], "expected RUN TASK"), (["{run}", "lamp"], "no episode"), (["{run}", "plant", "speed=0"], "speed 0")],
)
def test_wrong_arguments(acted_run: Path, arguments: list[str], said: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([argument.format(run=acted_run) for argument in arguments]) == 2
    assert said in capsys.readouterr().err


def test_an_option_that_planners_have_no_more_does_not_matter(
    acted_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = shutil.copytree(acted_run, tmp_path / "run")
    meta = json.loads((run / "run.json").read_text())
    meta["config"]["planner"]["gone"] = 48
    (run / "run.json").write_text(json.dumps(meta))
    monkeypatch.setattr("sys.stdin", io.StringIO("c\n"))
    assert main([str(run), "plant", "speed=1000"]) == 0
