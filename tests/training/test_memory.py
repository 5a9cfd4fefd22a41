"""What spares memory changes no result."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file

from proprio_mllm.model.building import load_model
from proprio_mllm.training.memory import is_sharded, spare_memory
from tests.training.kept import kept_bytes
from tests.training.sharded import Mixed, given
from tests.training.test_processes import alike, launched


def test_processes_share_frozen_layers(tmp_path: Path) -> None:
    """Two processes hold half of the layers each, train what one alone trains, store it, and plan with it."""
    weights = str(given(tmp_path / "given"))
    for count in (1, 2):
        assert launched(count, tmp_path / str(count), 2, weights, module="tests.training.sharded") == [0] * count
    stored = load_model(tmp_path / "2" / "model")
    assert isinstance(stored.cfg.weights, str)
    for name, told in load_file(tmp_path / "1" / "weights_0.safetensors").items():
        torch.testing.assert_close(stored.get_parameter(name).detach(), told, atol=2e-5, rtol=2e-4)
    said = [(tmp_path / name).read_text() for name in ("1/said_0", "2/said_0", "2/said_1")]
    assert said[0] and len(set(said)) == 1
    for rank in (0, 1):
        alike(tmp_path / "1" / "weights_0.safetensors", tmp_path / "2" / f"weights_{rank}.safetensors")
    whole, half = (int((tmp_path / name).read_text()) for name in ("1/held_0", "2/held_1"))
    frozen = sum(
        one.numel()
        for name, one in Mixed().module.named_parameters()
        if name.startswith("vlm.") and (".layers." in name or ".blocks." in name) and "lora_" not in name
    )
    assert whole - half == frozen // 2


def saved_bytes(objective: Mixed) -> tuple[int, dict[str, torch.Tensor]]:
    """Bytes that one forward pass keeps besides parameters, and the gradients."""
    objective.module.train()
    (batch,) = objective.collator.in_parts(objective.examples(np.random.default_rng(3), 4, "see"), 1)
    with kept_bytes(objective.module) as kept:
        loss, _ = objective.loss(objective.module, batch, torch.Generator())
    held = kept()
    loss.backward()
    return held, {name: one.grad for name, one in objective.module.named_parameters() if one.grad is not None}


def test_activations_are_computed_again() -> None:
    kept, plain = saved_bytes(Mixed())
    less, again = saved_bytes(Mixed(recompute=True))
    assert less < 0.6 * kept
    assert plain.keys() == again.keys()
    for name, gradient in plain.items():
        torch.testing.assert_close(gradient, again[name], msg=name)


def test_layers_that_train_are_not_shared(monkeypatch: pytest.MonkeyPatch) -> None:
    objective = Mixed(shard=True)  # one process: nothing to share
    assert not is_sharded(objective.module)
    state = type("State", (), {"num_processes": 2, "device": torch.device("cpu")})()
    monkeypatch.setattr("proprio_mllm.training.memory.processes", lambda: state)
    objective.module.requires_grad_(True)
    with pytest.raises(ValueError, match="shard=true shares frozen layers, and this stage trains"):
        spare_memory(objective.module, False, True)
