"""A model small enough for every test, and examples for it."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
import pytest
import torch

from configs.schema.model import (
    CseConfig,
    LoraConfig,
    ModelConfig,
    MotionTokenizerConfig,
    MpeConfig,
    PointMapConfig,
    TinyTextConfig,
    TinyVisionConfig,
)
from interface.observation import Camera
from proprio_mllm.model.batch import Collator, Example, View
from proprio_mllm.model.building import build_model, build_processor
from proprio_mllm.model.modeling import ProprioMLLM
from proprio_mllm.model.processor import ProprioProcessor
from proprio_mllm.model.prompts import self_ask_prompt, with_answer

TYPES = ("Mug", "Fridge", "CoffeeMachine", "Pan", "Pancake")
TEXTS = [
    "h1 1/8 put the mug into the fridge",
    "see Mug_1Pan_2",
    "Pick(left, Mug_1) & Place(right, Fridge_1)",
    "system\nplan",
] * 3


@pytest.fixture(autouse=True)
def one_thread() -> None:
    torch.set_num_threads(1)


def small() -> ModelConfig:
    return ModelConfig(
        name="test",
        vocab_size=380,
        text=TinyTextConfig(hidden=64, layers=2, heads=2, kv_heads=1, intermediate=96),
        vision=TinyVisionConfig(hidden=32, depth=2, heads=2, intermediate=48),
        lora=LoraConfig(rank=4, alpha=8),
        mpe=MpeConfig(mode="rope_sign"),
        cse=CseConfig(enabled=True),
        point_map=PointMapConfig(encoder="sim", width=32, depth=1),
        motion=MotionTokenizerConfig(features=6, window=16, codes=16, code_dim=8, width=8, depth=1),
    )


@pytest.fixture
def cfg() -> ModelConfig:
    return small()


@pytest.fixture(scope="session")
def processor() -> ProprioProcessor:
    cfg = ModelConfig(name="test", vocab_size=380, motion=MotionTokenizerConfig(codes=16))
    return build_processor(cfg, TEXTS, TYPES)


@pytest.fixture
def switch() -> Callable[..., ModelConfig]:
    """Changes the MPE mode and CSE of a configuration."""

    def change(cfg: ModelConfig, mode: str = "rope_sign", cse: bool = True, **fields: object) -> ModelConfig:
        return dataclasses.replace(
            cfg,
            mpe=dataclasses.replace(cfg.mpe, mode=mode),
            cse=dataclasses.replace(cfg.cse, enabled=cse),
            **fields,
        )

    return change


def make_view(rng: np.random.Generator) -> View:
    pose = np.eye(4)
    pose[:3, :3] = [[0, 0, 1], [-1, 0, 0], [0, -1, 0]]
    pose[:3, 3] = [0.1, 0.0, 0.6]
    camera = Camera(np.array([[60.0, 0, 56], [0, 60, 56], [0, 0, 1]]), pose, 112, 112)
    return View(rng.integers(0, 256, (112, 112, 3), dtype=np.uint8), camera, rng.normal(size=(14, 3)) * 0.3)


def make_example(rng: np.random.Generator, known: int = 3, answer: str = "Pick(left, Mug_1)", felt: bool = True) -> Example:
    names = [f"Pan_{n}" for n in range(1, known + 1)]
    motion = [int(code) for code in rng.integers(0, 16, 4)]
    prompt = self_ask_prompt("open", names, [], motion if felt else None)
    return Example(with_answer(prompt, answer), (make_view(rng),))


@pytest.fixture
def examples() -> list[Example]:
    rng = np.random.default_rng(7)
    return [make_example(rng, known=1), make_example(rng, known=4, answer="GoTo(Fridge_1)"), make_example(rng, known=2)]


@pytest.fixture
def plain() -> list[Example]:
    """Without motion, as Qwen reads them."""
    return [make_example(np.random.default_rng(number), known=number, felt=False) for number in (1, 4, 2)]


@pytest.fixture
def build(processor: ProprioProcessor) -> Callable[[ModelConfig], tuple[ProprioMLLM, Collator]]:
    def make(cfg: ModelConfig) -> tuple[ProprioMLLM, Collator]:
        return build_model(cfg, processor).eval(), Collator(processor, cfg)

    return make


def randomise(model: ProprioMLLM, seed: int = 3) -> None:
    """Moves zero-initialised heads off zero, so that switching them matters."""
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for name, parameter in model.named_parameters():
            if name.startswith(("cse.", "mpe.")) or "lora_B" in name or "trainable_tokens_" in name:
                parameter.add_(torch.randn(parameter.shape, generator=generator) * 0.1)


@pytest.fixture
def shake() -> Callable[[ProprioMLLM], None]:
    return randomise
