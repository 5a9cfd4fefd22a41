"""Corrections: shards of the demonstrations' kind, the same after an interruption."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from configs.schema.collect import CollectConfig
from data.shards import ShardReader
from interface.observation import Observation
from interface.steps import PlanStep
from proprio_mllm.evaluation import dagger
from proprio_mllm.evaluation.dagger import collect_dagger
from proprio_mllm.training.rollouts import DaggerRequest
from sim.collection.demonstrations import run_lesson


@pytest.fixture
def request_(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> DaggerRequest:
    def student(observation: Observation) -> PlanStep | None:
        return PlanStep.parse(f"GoTo({observation.known_objects[-1]})")

    monkeypatch.setattr(dagger, "_in_words", lambda model: student)
    monkeypatch.setattr(dagger, "_PER_PART", 1)
    return DaggerRequest(tmp_path / "model", tmp_path / "dagger", 2, 0, 0.9, 56, "hash")


def test_an_interrupted_run_continues_to_the_same_rows(
    request_: DaggerRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = DaggerRequest(request_.model, tmp_path / "whole", 2, 0, 0.9, 56, "hash")
    collect_dagger(whole, workers=1)
    part, calls = dagger._lessons, []

    def dies(config, number, student):
        calls.append(number)
        if len(calls) == 2:
            raise KeyboardInterrupt
        return part(config, number, student)

    monkeypatch.setattr(dagger, "_lessons", dies)
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
    assert set(one.column("robot")) <= {"h1", "x1"}
    assert one.manifest.metadata["teacher_share"] == 0.9


def test_training_keeps_its_threads(request_: DaggerRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    threads, seen = torch.get_num_threads(), list[int]()
    lessons = "sim.collection.demonstrations.lessons_of_part"
    monkeypatch.setattr(lessons, lambda *job: (seen.append(torch.get_num_threads()), [])[1])
    try:
        torch.set_num_threads(2)
        collect_dagger(request_, workers=1)
        assert (set(seen), torch.get_num_threads()) == ({1}, 2)
    finally:
        torch.set_num_threads(threads)


def test_lessons_try_what_is_out_of_reach_less_often() -> None:
    refused = dict.fromkeys((False, True), 0)
    for ahead in refused:
        config = CollectConfig("demos", "unused", 20, image_size=56, noise=0.0, chance_share=0.0, foreseen=ahead)
        for index in range(4, 10):
            log = run_lesson(config, index, None, dagger.Rules()).rows[-1]["history"]
            refused[ahead] += sum(item["feedback"].endswith(("BodyTooHigh", "BodyTooLow", "TooFar")) for item in log)
    assert refused[True] < 0.5 * refused[False], refused
