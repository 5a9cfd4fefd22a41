"""Checkpoints of a running loop: safetensors and JSON, renamed into place, so that a kill leaves the last complete one.

Batches depend on (seed, step) alone, so weights, optimiser state and the step number are the whole state of a run.
"""

from __future__ import annotations

import json
from pathlib import Path

import torch
from torch import Tensor, nn

from data.files import new_folder, read_json
from proprio_mllm.model.tensors import check_files, file_hashes, read_tensors, write_tensors


def save_checkpoint(
    folder: Path, step: int, module: nn.Module, optimizer: torch.optim.Optimizer, key: str, seconds: float = 0.0
) -> None:
    """Writes a checkpoint atomically.

    Args:
        folder: replaced as a whole.
        step: steps taken.
        module: its trainable parameters and all buffers are stored.
        optimizer: over those parameters.
        key: identifies the run; a checkpoint of another key is not loaded.
        seconds: time spent so far.
    """
    with new_folder(folder) as work:
        write_tensors({name: tensor.contiguous() for name, tensor in _trained(module).items()}, work / "model.safetensors")
        state = optimizer.state_dict()["state"]
        entries = [(f"{index}.{name}", value) for index, entry in state.items() for name, value in entry.items()]
        flat = {name: torch.as_tensor(value).contiguous() for name, value in entries}
        write_tensors(flat, work / "optimizer.safetensors")
        told = {"step": step, "key": key, "seconds": seconds, "files": file_hashes(work)}
        (work / "state.json").write_text(json.dumps(told), encoding="utf-8")


def load_checkpoint(folder: Path, module: nn.Module, optimizer: torch.optim.Optimizer, key: str) -> tuple[int, float]:
    """Restores a checkpoint and returns its step and seconds spent; zeros when there is none, or it is of another run.

    Raises:
        DamagedFileError: when a file of it is not what was written.
        ValueError: when the checkpoint holds other tensors than the module trains.
    """
    if not (folder / "state.json").is_file():
        folder = folder.with_name(folder.name + ".old")
    if not (folder / "state.json").is_file():
        return 0, 0.0
    state = read_json(folder / "state.json")
    if state.get("key") != key:
        return 0, 0.0
    check_files(folder, state.get("files", {}))
    tensors = read_tensors(folder / "model.safetensors")
    own = _trained(module)
    if set(own) != set(tensors):
        raise ValueError(f"{folder}: checkpoint holds other tensors than the model: {sorted(set(own) ^ set(tensors))[:4]}")
    with torch.no_grad():
        for name, tensor in own.items():
            tensor.copy_(tensors[name])
    entries: dict[int, dict[str, Tensor]] = {}
    for name, tensor in read_tensors(folder / "optimizer.safetensors").items():
        index, _, field = name.partition(".")
        entries.setdefault(int(index), {})[field] = tensor
    optimizer.load_state_dict({"state": entries, "param_groups": optimizer.state_dict()["param_groups"]})
    return int(state["step"]), float(state["seconds"])


def _trained(module: nn.Module) -> dict[str, Tensor]:
    """What trains and the buffers, themselves and not copies, in whatever memory format."""
    tensors: dict[str, Tensor] = {}
    seen: set[int] = set()
    for name, parameter in module.named_parameters():
        if parameter.requires_grad and id(parameter) not in seen:
            seen.add(id(parameter))
            tensors[name] = parameter.data
    for name, buffer in module.named_buffers():
        if id(buffer) not in seen:
            seen.add(id(buffer))
            tensors[name] = buffer
    return tensors
