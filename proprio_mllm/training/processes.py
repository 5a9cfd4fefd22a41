"""The processes that train together, started by `accelerate launch` or `torchrun`: one of them writes, and gradients are added.

Every process runs the same stages. What leaves something behind (shards, checkpoints, models, metrics) is done by the first one
while the others wait, so all read the same files: folders have to be shared between machines. Gradients are added here rather
than by DistributedDataParallel, because a step trains what its batch touches: modalities come and go, and a parameter without a
gradient has none in any process. With one process nothing of this does anything.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Sequence
from datetime import timedelta
from functools import cache
from typing import TypeVar

import torch
import torch.distributed as dist
from accelerate import PartialState
from torch import Tensor, nn

T = TypeVar("T")
#: How long processes wait for the first one, which may be collecting episodes.
_PATIENCE = timedelta(days=7)


@cache
def processes() -> PartialState:
    """This process among all; joins them when it is first asked for, and from then on GPUs add in the same order every time."""
    if torch.cuda.is_available():
        os.environ.setdefault("CUBLAS_WORKSPACE_CONFIG", ":4096:8")
        torch.use_deterministic_algorithms(True, warn_only=True)
        torch.utils.deterministic.fill_uninitialized_memory = False  # type: ignore[attr-defined]  # torch has no stub for it
        torch.backends.cuda.enable_cudnn_sdp(False)  # whose gradients keep no order
    return PartialState(cpu=not torch.cuda.is_available(), timeout=_PATIENCE)


def first_alone(work: Callable[[], T]) -> T | None:
    """Does something in the first process while the others wait; they get None."""
    state = processes()
    try:
        return work() if state.is_main_process else None
    finally:
        state.wait_for_everyone()


def added(values: Sequence[float]) -> list[float]:
    """Sums over all processes."""
    state = processes()
    if state.num_processes == 1:
        return list(values)
    total = torch.tensor(values, dtype=torch.float64, device=state.device)
    dist.all_reduce(total)
    return total.tolist()


def from_first(values: Sequence[float]) -> list[float]:
    """What the first process says."""
    state = processes()
    if state.num_processes == 1:
        return list(values)
    told = torch.tensor(values, dtype=torch.float64, device=state.device)
    dist.broadcast(told, 0)
    return told.tolist()


def largest(value: int) -> int:
    """The largest that any process says."""
    state = processes()
    told = torch.tensor(value, device=state.device)
    if state.num_processes > 1:
        dist.all_reduce(told, dist.ReduceOp.MAX)
    return int(told)


def add_gradients(parameters: Sequence[nn.Parameter]) -> None:
    """Adds gradients over all processes; a parameter that no process has one for keeps none."""
    if processes().num_processes == 1:
        return
    has = torch.tensor([float(one.grad is not None) for one in parameters], device=parameters[0].device)
    dist.all_reduce(has, dist.ReduceOp.MAX)
    wanted = [one for one, some in zip(parameters, has.tolist(), strict=True) if some]
    for dtype in sorted({one.dtype for one in wanted}, key=str):
        same = [one for one in wanted if one.dtype == dtype]
        flat = torch.cat([(torch.zeros_like(one) if one.grad is None else one.grad).flatten() for one in same])
        dist.all_reduce(flat)
        for one, piece in zip(same, flat.split([one.numel() for one in same]), strict=True):
            one.grad = piece.view_as(one).clone() if one.grad is None else one.grad.copy_(piece.view_as(one))


def same_everywhere(tensors: Iterable[Tensor]) -> None:
    """Gives all processes the first one's values."""
    if processes().num_processes > 1:
        with torch.no_grad():
            for one in tensors:
                dist.broadcast(one, 0)
