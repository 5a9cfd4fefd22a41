"""The one training loop: seeded batches, AdamW or Muon, cosine schedule, checkpoints, metrics, progress with time left.

A stage gives an `Objective`: which module trains, the batches of a step, and their loss. A step's batch may be cut into
micro-batches, whose gradients are added: one process takes them in turn, several processes share them. A micro-batch is a
function of (seed, step, its number) alone, so a run that is killed and resumed, by as many processes or by others, ends with
the same weights as one that was not, up to rounding where sums are taken in another order.
"""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor, nn
from tqdm import tqdm

from configs.schema.train import LoopConfig
from proprio_mllm.training.checkpoint import load_checkpoint, save_checkpoint
from proprio_mllm.training.memory import is_sharded
from proprio_mllm.training.metrics import MetricWriter
from proprio_mllm.training.muon import Muon, linear_weights
from proprio_mllm.training.processes import add_gradients, added, first_alone, from_first, largest, processes, same_everywhere

logger = logging.getLogger(__name__)


class Objective(Protocol):
    """What a stage trains; the methods with a body are for those whose micro-batches are all alike."""

    name: str
    #: Identifies data and configuration; a checkpoint of another key is not resumed.
    key: str

    #: Its parameters with `requires_grad` are trained; called on batches by `loss`.
    module: nn.Module

    def kind(self, rng: np.random.Generator) -> Any:
        """Of what kind all micro-batches of a step are, so that all processes have the same work."""
        return None

    def batch(self, rng: np.random.Generator, size: int, kind: Any) -> Any:
        """A micro-batch on the CPU; must depend on `rng` and `kind` alone."""
        ...

    def weight(self, batch: Any) -> float:
        """What a micro-batch counts in the mean over a step: how many tokens it teaches, or 1 where all teach the same."""
        return 1.0

    def loss(self, module: nn.Module, batch: Any, generator: torch.Generator) -> tuple[Tensor, Mapping[str, float]]:
        """Loss and metrics of a micro-batch, or of one of its `Parts`, through `module`."""
        ...


class Parts(tuple[Any, ...]):
    """A batch whose loss, and whose metrics, are the sums of its parts'; each part is let go of before the next is computed."""


@dataclass(frozen=True, slots=True)
class LoopResult:
    """What a run did: steps and seconds in all, examples of all processes, and the mean of each metric over the last log."""

    steps: int
    seconds: float
    examples: int
    last: Mapping[str, float]


def learning_rate(cfg: LoopConfig, step: int, seconds: float = 0.0) -> float:
    """Learning rate of step 0, 1, …: linear warm-up, then a cosine from the peak to a tenth of it.

    With a time budget the cosine follows the larger of the shares of steps and of `seconds` that are spent.
    """
    warmup = min(cfg.warmup, max(cfg.steps // 10, 1))
    if step < warmup:
        return cfg.lr * (step + 1) / warmup
    done = max((step - warmup) / max(cfg.steps - warmup, 1), seconds / (60.0 * cfg.minutes) if cfg.minutes else 0.0)
    return cfg.lr * (0.1 + 0.9 * 0.5 * (1.0 + math.cos(math.pi * min(done, 1.0))))


def _moved(batch: Any, device: torch.device) -> Any:
    """Tensors, and batches that can move themselves, on a device; tuples item by item."""
    if isinstance(batch, tuple):
        return tuple(_moved(item, device) for item in batch)
    return batch.to(device) if hasattr(batch, "to") else batch


def make_optimizer(module: nn.Module, cfg: LoopConfig) -> torch.optim.Optimizer:
    """The configured optimiser over a module's trained parameters; weight decay on matrices only."""
    trained = [parameter for parameter in module.parameters() if parameter.requires_grad]
    matrices = linear_weights(module) if cfg.optimizer == "muon" else []
    taken = {id(parameter) for parameter in matrices}
    others = [parameter for parameter in trained if id(parameter) not in taken]
    groups = [
        {"params": [p for p in others if p.ndim >= 2], "weight_decay": cfg.weight_decay},
        {"params": [p for p in others if p.ndim < 2], "weight_decay": 0.0},
    ]
    groups = [group for group in groups if group["params"]]
    if matrices:
        dtype = torch.bfloat16 if cfg.precision == "bf16" else torch.float32
        return Muon(matrices, groups, cfg.lr, weight_decay=cfg.weight_decay, adam_share=cfg.adam_share, dtype=dtype)
    return torch.optim.AdamW(groups, lr=cfg.lr, betas=(0.9, 0.99))


def run_loop(
    objective: Objective,
    cfg: LoopConfig,
    folder: Path,
    seed: int,
    writer: MetricWriter | None,
    resume: bool = True,
    micro_batches: int = 1,
) -> LoopResult:
    """Trains an objective to `cfg.steps` or for `cfg.minutes`, resuming from `folder/checkpoint` when it is of the same run.

    Args:
        objective: what trains.
        cfg: steps, batch, optimiser.
        folder: of the checkpoint.
        seed: of all draws.
        writer: takes the metrics, those of the first process but for the loss; None in the other processes.
        resume: whether an earlier checkpoint is continued.
        micro_batches: into how many a step's batch is cut.

    Raises:
        FloatingPointError: when the loss is not finite; the message names stage and step.
        ValueError: when nothing trains, or the batch cannot be cut or shared like that.
    """
    state = processes()
    device = state.device
    assert device is not None
    rank, count = state.process_index, state.num_processes
    if micro_batches % count or cfg.batch % micro_batches:
        raise ValueError(
            f"{objective.name}: a batch of {cfg.batch} in micro_batches={micro_batches} cannot be shared by {count} processes; "
            "micro_batches must be a multiple of the processes and a divisor of the batch"
        )
    module = objective.module.to(device)
    trained = [parameter for parameter in module.parameters() if parameter.requires_grad]
    if not trained:
        raise ValueError(f"stage {objective.name!r} trains no parameter")
    sharded = is_sharded(module)
    optimizer = make_optimizer(module, cfg)
    checkpoint = folder / "checkpoint"
    first, spent = load_checkpoint(checkpoint, module, optimizer, objective.key) if resume else (0, 0.0)
    same_everywhere([*trained, *module.buffers()])
    if writer is not None:
        writer.discard_after(first)
    if first:
        logger.info("%s: resumed at step %d of %d", objective.name, first, cfg.steps)

    def make(step: int) -> tuple[Any, list[Any]]:
        streams = [np.random.default_rng([seed, step, number]) for number in range(micro_batches)]
        kind = objective.kind(streams[0] if rank == 0 else np.random.default_rng([seed, step, 0]))
        return kind, [objective.batch(stream, cfg.batch // micro_batches, kind) for stream in streams[rank::count]]

    began, sums, counted, last = time.monotonic(), dict[str, float](), 0, dict[str, float]()
    module.train()
    with (
        ThreadPoolExecutor(1) as pool,
        tqdm(total=cfg.steps, initial=first, desc=objective.name, mininterval=5.0, disable=rank > 0) as bar,
    ):
        ahead: Future[tuple[Any, list[Any]]] | None = pool.submit(make, first) if first < cfg.steps else None
        for step in range(first, cfg.steps):
            assert ahead is not None
            kind, batches = ahead.result()
            (seconds,) = from_first([spent + time.monotonic() - began])
            out_of_time = bool(cfg.minutes) and seconds > 60.0 * cfg.minutes
            ahead = pool.submit(make, step + 1) if step + 1 < cfg.steps else None
            for group in optimizer.param_groups:
                group["lr"] = learning_rate(cfg, step, seconds)
            weights = [objective.weight(batch) for batch in batches]
            (whole,) = added([sum(weights)])
            found: dict[str, float] = {}
            parts = [batch if isinstance(batch, Parts) else Parts((batch,)) for batch in batches]
            passes = sum(map(len, parts))
            idle = largest(passes) - passes if sharded else 0
            for number, (batch, weight) in enumerate(zip(parts, weights, strict=True)):
                draw_seed = (seed * 1_000_003 + step) * 64 + rank + number * count
                generator = torch.Generator().manual_seed(draw_seed)
                torch.manual_seed(draw_seed)  # dropout draws from torch's own
                share = weight / whole if whole else 0.0
                for part in batch:
                    with torch.autocast(device.type, torch.bfloat16, enabled=cfg.precision == "bf16"):
                        loss, values = objective.loss(module, _moved(part, device), generator)
                    (loss * share).backward()
                    found["loss"] = found.get("loss", 0.0) + float(loss.detach()) * share
                    for name, value in values.items():
                        found[name] = found.get(name, 0.0) + value / len(batches)
            for _ in range(idle):  # a layer is gathered by all processes or by none
                (0.0 * objective.loss(module, _moved(parts[0][0], device), torch.Generator())[0]).backward()
            (found["loss"],) = added([found["loss"]])
            if not math.isfinite(found["loss"]):
                raise FloatingPointError(f"{objective.name}: loss {found['loss']} at step {step}; lower lr ({cfg.lr})")
            add_gradients(trained)
            found["grad_norm" if kind is None else f"{kind}_grad_norm"] = float(nn.utils.clip_grad_norm_(trained, cfg.clip))
            optimizer.step()
            optimizer.zero_grad(set_to_none=True)
            same_everywhere(module.buffers())  # codes that are learnt without gradients
            for name, value in found.items():
                sums[name] = sums.get(name, 0.0) + value
                sums[f"#{name}"] = sums.get(f"#{name}", 0.0) + 1.0
            counted += 1
            bar.update(1)
            done = step + 1
            final = done == cfg.steps or out_of_time
            if done % cfg.log_every == 0 or final:
                last = {name: total / sums[f"#{name}"] for name, total in sums.items() if not name.startswith("#")}
                last["lr"] = learning_rate(cfg, step, seconds)
                last["examples_per_s"] = counted * cfg.batch / max(time.monotonic() - began, 1e-9)
                if device.type == "cuda":
                    last["gpu_gb"] = torch.cuda.max_memory_allocated(device) / 1e9
                if writer is not None:
                    writer.write(done, last)
                bar.set_postfix(loss=f"{last['loss']:.3f}", refresh=False)
                sums = {}
            if done % cfg.checkpoint_every == 0 or final:
                taken = spent + time.monotonic() - began
                first_alone(partial(save_checkpoint, checkpoint, done, module, optimizer, objective.key, taken))
            if final:
                break
    module.eval()
    return LoopResult(first + counted, spent + time.monotonic() - began, counted * cfg.batch, last)
