"""Corrections: shards of the demonstrations' kind, the same after an interruption."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
import torch

from configs.schema.collect import CollectConfig
from data.interface.observation import Observation
from data.interface.steps import PlanStep
from data.shards import ShardReader
from proprio_mllm.evaluation import dagger
from proprio_mllm.evaluation.dagger import collect_dagger
from proprio_mllm.training.rollouts import DaggerRequest


@pytest.fixture
def request_(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> DaggerRequest:
    def student(observation: Observation) -> PlanStep | None:
        return PlanStep.parse(f"GoTo({observation.known_objects[-1]})")

    monkeypatch.setattr(dagger, "_student", lambda model: student)
    monkeypatch.setattr(dagger, "_PER_PART", {"demos": 1, "text_planning": 2})
    return DaggerRequest(tmp_path / "model", tmp_path / "dagger", "demos", 2, 0, 0.9, 56, "hash")


def test_an_interrupted_run_continues_to_the_same_rows(
    request_: DaggerRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = DaggerRequest(request_.model, tmp_path / "whole", "demos", 2, 0, 0.9, 56, "hash")
    collect_dagger(whole, workers=1)
    part, calls = dagger._part, []

    def dies(config, number, model):
        calls.append(number)
        if len(calls) == 2:
            raise KeyboardInterrupt
        return part(config, number, model)

    monkeypatch.setattr(dagger, "_part", dies)
    with pytest.raises(KeyboardInterrupt):
        collect_dagger(request_, workers=1)
    collect_dagger(request_, workers=1)
    assert calls == [0, 1, 1]
    collect_dagger(request_, workers=1)
    assert len(calls) == 3
    one, other = ShardReader(whole.folder, "demos"), ShardReader(request_.folder, "demos")
    assert len(one) > 0
    assert one.column("target") == other.column("target")
    assert one.column("image") == other.column("image")
    # which of the episodes end in success, and so give rows, differs between processors
    assert set(one.column("robot")) <= {"h1", "x1"}
    assert one.manifest.metadata["expert_share"] == 0.9


@pytest.fixture
def in_words(request_: DaggerRequest, monkeypatch: pytest.MonkeyPatch) -> DaggerRequest:
    def reader(moments: Sequence[Mapping[str, Any]]) -> list[PlanStep | None]:
        return [None if moment["step"] % 3 == 2 else PlanStep.parse(f"Pick(left, {moment['known'][-1]})") for moment in moments]

    monkeypatch.setattr(dagger, "student_in_text", lambda model: reader)
    return dataclasses.replace(request_, kind="text_planning", episodes=30)


def test_corrections_in_words_are_exercises(in_words: DaggerRequest) -> None:
    collect_dagger(in_words, workers=1)
    reader = ShardReader(in_words.folder, "text_planning")
    rows = [reader[i] for i in range(len(reader))]
    logs = [item["step"] for row in rows for item in row["history"]]
    assert any(step.startswith("Pick(left, ") for step in logs)
    assert all(PlanStep.parse(row["target"]).to_text() == row["target"] for row in rows)
    # what has just been refused is done again by the expert alone, where luck was to blame
    for row in rows:
        for before, after in pairwise(row["history"]):
            assert before["feedback"].endswith((" ok", "NothingHappened", "BlockedPath")) or before["step"] != after["step"]


def test_training_keeps_its_threads(in_words: DaggerRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    threads, seen = torch.get_num_threads(), list[int]()
    asked = dagger._part
    monkeypatch.setattr(dagger, "_part", lambda *job, **of: (seen.append(torch.get_num_threads()), asked(*job, **of))[1])
    try:
        torch.set_num_threads(2)
        collect_dagger(in_words, workers=1)
        assert (set(seen), torch.get_num_threads()) == ({1}, 2)
    finally:
        torch.set_num_threads(threads)


def test_the_expert_alone_solves_episodes_in_words(in_words: DaggerRequest) -> None:
    config = CollectConfig("text_planning", "unused", 6, part_size=6, noise=1.0)
    rows = dagger._part(config, 0, "unused")
    assert rows == dagger._part(config, 0, "unused")
    assert not [item for row in rows for item in row["history"] if item["feedback"].endswith(("HandOccupied", "HandEmpty"))]
