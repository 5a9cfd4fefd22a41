"""A stored model as a planner, with a model small enough for tests."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch

from configs.schema.model import (
    ModelConfig,
    MotionTokenizerConfig,
    PointMapConfig,
    TinyTextConfig,
    TinyVisionConfig,
)
from data.interface.observation import Camera, HistoryItem, Observation, Proprioception
from proprio_mllm.model.building import build_model, build_processor, save_model
from proprio_mllm.model.motion_tokenizer import MotionTokenizer
from proprio_mllm.planners.mllm import MllmPlanner
from proprio_mllm.planners.protocol import BatchPlanner, Planner, TaskInfo

INFO = TaskInfo("put the mug into the fridge", "h1", 9)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    torch.set_num_threads(1)
    cfg = ModelConfig(
        name="test",
        image_size=56,
        vocab_size=420,
        text=TinyTextConfig(hidden=64, layers=1, heads=2, kv_heads=1, intermediate=64),
        vision=TinyVisionConfig(hidden=32, depth=1, heads=2, intermediate=48),
        point_map=PointMapConfig(encoder="sim", width=32, depth=1),
        motion=MotionTokenizerConfig(codes=16, code_dim=8, width=8, depth=1),
    )
    processor = build_processor(cfg, ["h1 1/8 put the mug into the fridge", "Pick(left, Mug_1)"] * 3, ("Mug", "Fridge"))
    path = tmp_path_factory.mktemp("model") / "full"
    save_model(build_model(cfg, processor), path, MotionTokenizer(cfg.motion))
    return path


def observation(seed: int, history: tuple[HistoryItem, ...] = ()) -> Observation:
    rng = np.random.default_rng(seed)
    body = Proprioception(rng.normal(size=(64, 48)).astype(np.float32), 20.0, np.zeros(3), rng.normal(size=(14, 3)))
    camera = Camera(np.array([[60.0, 0, 28], [0, 60, 28], [0, 0, 1]]), np.eye(4), 56, 56)
    image = rng.integers(0, 255, (56, 56, 3), dtype=np.uint8)
    return Observation(INFO.instruction, "h1", image, camera, ("Mug_1",), ("Mug_1", "Fridge_1"), body, history, len(history), 9)


def test_replies_are_deterministic_counted_and_never_crash(folder: Path) -> None:
    planner = MllmPlanner.load(folder, max_new_tokens=6)
    assert isinstance(planner, Planner)
    assert isinstance(planner, BatchPlanner)
    assert planner.image_size == 56
    planner.reset(INFO, np.random.default_rng(0))
    first, second = planner.step(observation(1), None), planner.step(observation(1), None)
    assert first.text == second.text
    assert first.tokens > 20
    assert first.latency_s > 0
    assert (first.step is None) == bool(first.error)


def test_a_batch_answers_like_its_rows(folder: Path) -> None:
    planner = MllmPlanner.load(folder, max_new_tokens=6)
    seen = [observation(1), observation(2, (HistoryItem("GoTo(Mug_1)", "GoTo(Mug_1) ok"),)), observation(3)]
    texts = [reply.text for reply in planner.step_batch(seen)]
    assert texts == [planner.step(one, None).text for one in seen]


def test_draws_follow_the_episodes_generator(folder: Path) -> None:
    planner = MllmPlanner.load(folder, temperature=2.0, max_new_tokens=8)

    def say(seed: int) -> str:
        planner.reset(INFO, np.random.default_rng(seed))
        return planner.step(observation(1), None).text

    assert say(1) == say(1)
    assert len({say(seed) for seed in range(4)}) > 1


def test_motion_tokens_need_their_tokenizer(folder: Path) -> None:
    planner = MllmPlanner.load(folder)
    with pytest.raises(ValueError, match="'test' reads motion tokens"):
        MllmPlanner(planner.model, None)
    planner.model.cfg = dataclasses.replace(planner.model.cfg, proprioception=False)
    assert MllmPlanner(planner.model, None).step(observation(1), None).tokens > 0
