"""Corrections: shards of the demonstrations' kind, the same after an interruption."""

from __future__ import annotations

from pathlib import Path

import pytest

from data.records import Observation, PlanStep
from data.shards import ShardReader
from proprio_mllm.evaluation import corrections
from proprio_mllm.evaluation.corrections import collect_corrections
from proprio_mllm.training.rollouts import CorrectionRequest


@pytest.fixture
def request_(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> CorrectionRequest:
    def student(observation: Observation) -> PlanStep | None:
        return PlanStep.parse(f"GoTo({observation.known_objects[-1]})")

    monkeypatch.setattr(corrections, "_student", lambda model: student)
    monkeypatch.setattr(corrections, "_PER_PART", 2)
    return CorrectionRequest(tmp_path / "model", tmp_path / "corrections", 4, 0, 0.5, 56, "hash")


def test_an_interrupted_run_continues_to_the_same_rows(
    request_: CorrectionRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = CorrectionRequest(request_.model, tmp_path / "whole", 4, 0, 0.5, 56, "hash")
    collect_corrections(whole, workers=1)
    part, calls = corrections._part, []

    def dies(config, number, model):
        calls.append(number)
        if len(calls) == 2:
            raise KeyboardInterrupt
        return part(config, number, model)

    monkeypatch.setattr(corrections, "_part", dies)
    with pytest.raises(KeyboardInterrupt):
        collect_corrections(request_, workers=1)
    collect_corrections(request_, workers=1)
    assert calls == [0, 1, 1]
    collect_corrections(request_, workers=1)
    assert len(calls) == 3
    one, other = ShardReader(whole.folder, "demos"), ShardReader(request_.folder, "demos")
    assert len(one) > 0
    assert one.column("target") == other.column("target")
    assert one.column("image") == other.column("image")
    assert {"h1"} <= set(one.column("robot")) <= {"h1", "x1"}
    assert one.manifest.metadata["expert_share"] == 0.5
