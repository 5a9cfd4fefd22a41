"""What spares memory where the backbone is large: activations that are computed again, and frozen weights that processes share.

`recompute=true` keeps of each layer only its input and computes the rest again in the backward pass. `shard=true` (FSDP2)
leaves each process with a part of every layer's frozen weights; a layer's are gathered while it works. Adapters, embeddings and
heads stay whole in every process: they are small, and what trains is added up in `proprio_mllm.training.processes`.
"""

from __future__ import annotations

from collections.abc import Iterator

from torch import nn
from torch.distributed.device_mesh import init_device_mesh
from torch.distributed.fsdp import FSDPModule, fully_shard
from transformers import PreTrainedModel

from proprio_mllm.model.groups import adapter_of, group_of
from proprio_mllm.model.modeling import ProprioMLLM
from proprio_mllm.training.processes import processes


def spare_memory(module: nn.Module, recompute: bool, shard: bool) -> None:
    """Applies both before a loop; asked again, it changes nothing.

    Args:
        module: what trains.
        recompute: whether activations are computed again.
        shard: whether frozen layers are shared. Does nothing in a single process.

    Raises:
        ValueError: when layers that train would have to be shared.
    """
    if recompute:
        for part in module.modules():
            if isinstance(part, PreTrainedModel) and part.supports_gradient_checkpointing:
                part.activation_checkpointing_enable({"use_reentrant": False})
    state = processes()
    if not shard or state.num_processes == 1 or not isinstance(module, ProprioMLLM):
        return
    training = [name for name, one in module.named_parameters() if one.requires_grad and group_of(name) in ("lm", "vision")]
    if training:
        raise ValueError(f"shard=true shares frozen layers, and this stage trains {training[0]} and {len(training) - 1} more")
    assert state.device is not None
    mesh = init_device_mesh(state.device.type, (state.num_processes,))
    for layer in _layers(module):
        if not isinstance(layer, FSDPModule):
            whole = {one for name, one in layer.named_parameters() if adapter_of(name)}
            fully_shard(layer, mesh=mesh, reshard_after_forward=True, ignored_params=whole)


def is_sharded(module: nn.Module) -> bool:
    """Whether processes have to pass through its layers together."""
    return any(isinstance(part, FSDPModule) for part in module.modules())


def _layers(model: ProprioMLLM) -> Iterator[nn.Module]:
    core = model.core.model
    yield from core.language_model.layers
    yield from core.visual.blocks
