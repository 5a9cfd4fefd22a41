"""What a training is said to cost is what it costs, at the size that fits here."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import torch
from torch.nn.attention import SDPBackend, sdpa_kernel
from torch.utils.flop_counter import FlopCounterMode

from configs.compose import compose
from configs.schema.train import TrainConfig
from configs.validate import build
from proprio_mllm.model.building import add_adapter, build_model, build_processor
from proprio_mllm.model.groups import parameter_groups
from proprio_mllm.model.modeling import ProprioMLLM
from proprio_mllm.training.footprint import footprint
from tests.training.kept import kept_bytes


def config(*words: str) -> TrainConfig:
    return build(TrainConfig, compose("train", ["logger.wandb=disabled", *words]))


@pytest.fixture(scope="module")
def tiny() -> ProprioMLLM:
    cfg = config().model
    model = build_model(cfg, build_processor(cfg, ["put the mug into the fridge"]))
    add_adapter(model)
    return model


def test_parameters_are_those_of_the_model(tiny: ProprioMLLM) -> None:
    parts = footprint(config()).parts
    sizes = {name: sum(one.numel() for one in group.values()) for name, group in parameter_groups(tiny).items()}
    assert parts["LoRA"].trained == sizes["lora"]
    assert parts["rows of motion tokens"].trained == sizes["rows"]
    assert parts["merger"].trained == sizes["merger"]
    assert parts["cross-spatial encoder"].trained == sizes["cse"]
    assert parts["point map"].parameters == sizes["point_map"] and parts["point map"].trained == 0
    assert parts["vision tower"].parameters == sizes["vision"]
    norm = tiny.core.model.language_model.norm.weight.numel()
    assert parts["language model's layers"].parameters == sizes["lm"] - norm


@pytest.mark.parametrize("recompute", [False, True])
def test_flop_and_activations_are_those_of_a_pass(tiny: ProprioMLLM, recompute: bool) -> None:
    """Counted on the real language model, with the plain attention kernel; the vision tower is left out on both sides."""
    told = footprint(config(f"recompute={recompute}", "alignment.joint.batch=1"))
    core: Any = tiny.core.train()
    if recompute:
        core.activation_checkpointing_enable({"use_reentrant": False})
    length, language = sum(told.tokens), core.model.language_model
    inputs = torch.randn(1, length, tiny.hidden_size, requires_grad=True)
    with FlopCounterMode(display=False) as counter, sdpa_kernel(SDPBackend.MATH):
        with kept_bytes(core) as kept:
            out = language(inputs_embeds=inputs, position_ids=torch.zeros(3, 1, length, dtype=torch.long), use_cache=False)[0]
        held = kept()
        out.sum().backward()
    core.activation_checkpointing_disable()
    assert counter.get_total_flops() == pytest.approx(told.reading, rel=0.03)
    layers = tiny.cfg.text.layers
    ends = layers * length * tiny.hidden_size * 4  # and while one layer is computed again, all that it keeps
    plain = footprint(config("alignment.joint.batch=1")).activations
    assert told.activations == pytest.approx(ends + plain / layers if recompute else plain)
    assert held == pytest.approx(ends if recompute else plain, rel=0.25)


def test_the_papers_model_is_as_large_as_it_is() -> None:
    told = footprint(config("model=qwen2_5_vl_7b", "budget=gpu", "recompute=true", "shard=true"))
    backbone = ("language model's layers", "vision tower", "merger", "tables and last norm")
    assert sum(told.parts[name].parameters for name in backbone) == 8_292_166_656  # of the released weights
    assert 8 < told.gigabytes(8) < 12 < 20 < told.gigabytes(1) < 24
    assert told.steps_per_hour(8, 400) == pytest.approx(8 * told.steps_per_hour(1, 400))


def test_the_command(tmp_path: Path) -> None:
    words = [sys.executable, "train.py", "footprint=400", "model=qwen2_5_vl_7b", "budget=gpu", f"output={tmp_path / 'none'}"]
    done = subprocess.run(words, cwd=Path(__file__).parents[2], capture_output=True, text=True, check=True)
    assert "6,525,618,176" in done.stdout and "steps/h" in done.stdout and not (tmp_path / "none").exists()
    words[3:4] = ["model.weights=nobody/nothing", "model.point_map.encoder=sim", "model.places=false"]
    done = subprocess.run(words, cwd=Path(__file__).parents[2], capture_output=True, text=True, check=False)
    assert done.returncode == 1 and "names whose shape is known: Qwen/Qwen2.5-VL-3B-Instruct" in done.stderr
