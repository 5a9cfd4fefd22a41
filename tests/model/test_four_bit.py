"""Released weights whose frozen layers are held in 4 bits, where bitsandbytes is installed; the message where it is not."""

from __future__ import annotations

import dataclasses
import importlib.util
from pathlib import Path

import pytest
import torch

from configs.compose import compose
from configs.schema.model import ModelConfig
from configs.schema.train import TrainConfig
from configs.validate import build
from proprio_mllm.model.batch import Collator, Example
from proprio_mllm.model.building import add_adapter, build_model, build_processor, load_model, save_model
from proprio_mllm.model.groups import train_only
from proprio_mllm.model.modeling import ProprioMLLM
from proprio_mllm.model.prompts import described_motion
from proprio_mllm.training.footprint import footprint
from tests.model.conftest import TEXTS, TYPES, small
from tests.training.sharded import given

INSTALLED = importlib.util.find_spec("bitsandbytes") is not None
needs_bitsandbytes = pytest.mark.skipif(
    not INSTALLED, reason="bitsandbytes is not installed; pip install 'proprio-mllm[four-bit]'"
)


@pytest.fixture
def cfg(tmp_path: Path) -> ModelConfig:
    plain = small()
    wide = dataclasses.replace(plain, text=dataclasses.replace(plain.text, intermediate=128))  # whole blocks of 64, as on CPUs
    return dataclasses.replace(wide, weights=str(given(tmp_path / "given", wide)))


def made(cfg: ModelConfig) -> ProprioMLLM:
    model = build_model(cfg, build_processor(cfg, TEXTS, TYPES))
    torch.manual_seed(0)
    add_adapter(model)
    train_only(model, ("rows", "lora", "merger"))
    return model


@needs_bitsandbytes
def test_layers_are_small_and_what_trains_is_not(cfg: ModelConfig, tmp_path: Path) -> None:
    quantised, whole = made(dataclasses.replace(cfg, four_bit=True)), made(cfg)
    layer = quantised.core.model.language_model.layers[0].mlp.gate_proj.base_layer
    assert layer.weight.dtype == torch.uint8 and quantised.core.model.visual.merger.mlp[0].weight.dtype == torch.float32
    batch = Collator(quantised.processor, cfg)([Example(described_motion([1, 2, 3, 0], "put the mug", style="terse"))])
    losses = [float(model.eval()(batch.to(model.device)).loss.detach()) for model in (quantised, whole)]
    assert losses[0] != losses[1] and losses[0] == pytest.approx(losses[1], rel=0.1)
    quantised(batch.to(quantised.device)).loss.backward()
    gradients = {name: one.grad for name, one in quantised.named_parameters() if one.grad is not None}
    assert any("lora_" in name for name in gradients) and all(bool(one.isfinite().all()) for one in gradients.values())
    with torch.no_grad():
        for one in quantised.parameters():
            if one.grad is not None:
                one -= 0.1 * one.grad
    save_model(quantised.eval(), tmp_path / "stored")
    stored = load_model(tmp_path / "stored")
    assert not (tmp_path / "stored" / "vlm").exists()
    told, moved = (float(one(batch.to(one.device)).loss.detach()) for one in (stored, quantised))
    assert told == pytest.approx(moved, rel=5e-4) and abs(moved - losses[0]) > 50 * abs(
        told - moved
    )  # kernels pack weights later


@pytest.mark.skipif(INSTALLED, reason="bitsandbytes is installed")
def test_what_is_missing_is_named(cfg: ModelConfig) -> None:
    with pytest.raises(ValueError, match=r"pip install 'proprio-mllm\[four-bit\]'"):
        made(dataclasses.replace(cfg, four_bit=True))


def test_what_it_goes_with() -> None:
    def config(*words: str) -> TrainConfig:
        return build(TrainConfig, compose("train", ["logger.wandb=disabled", "model.four_bit=true", *words]))

    with pytest.raises(ValueError, match="four_bit is for released weights"):
        config()
    with pytest.raises(ValueError, match="cannot share layers of 4 bits"):
        config("model=qwen2_5_vl_7b", "shard=true")
    with pytest.raises(ValueError, match=r"alignment\.whole=true trains the language model's layers, which .*four_bit=true"):
        config("model=qwen2_5_vl_7b", "alignment.whole=true")
    told = footprint(config("model=qwen2_5_vl_7b", "budget=gpu", "recompute=true", "micro_batches=64"))
    assert 6 < told.gigabytes(1) < 12
