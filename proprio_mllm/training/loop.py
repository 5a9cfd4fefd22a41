"""The one training loop: seeded batches, AdamW or Muon, cosine schedule, checkpoints, metrics, progress with time left.

A stage gives an `Objective`: which module trains, the batch of a step, and its loss. The batch of a step is a function of
(seed, step, process) only, so a run that is killed and resumed ends with the same weights as one that was not. accelerate
places the module and averages gradients over processes; on one CPU it adds nothing.
"""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch
from accelerate import Accelerator
from torch import Tensor, nn
from tqdm import tqdm

from configs.schema.train import LoopConfig
from proprio_mllm.training.checkpoint import load_checkpoint, save_checkpoint
from proprio_mllm.training.metrics import MetricWriter
from proprio_mllm.training.muon import Muon, linear_weights

logger = logging.getLogger(__name__)


class Objective(Protocol):
    """What a stage trains."""

    name: str
    #: Identifies data and configuration; a checkpoint of another key is not resumed.
    key: str

    @property
    def module(self) -> nn.Module:
        """The module whose parameters with `requires_grad` are trained; called on batches by `loss`."""
        ...

    def batch(self, rng: np.random.Generator, size: int) -> Any:
        """A batch on the CPU; must depend on `rng` alone."""
        ...

    def loss(self, module: nn.Module, batch: Any, generator: torch.Generator) -> tuple[Tensor, Mapping[str, float]]:
        """Loss and metrics of a batch through `module` (possibly wrapped for several processes)."""
        ...


class Parts(tuple[Any, ...]):
    """A batch whose loss, and whose metrics, are the sums of its parts'; each part is let go of before the next is computed."""


@dataclass(frozen=True, slots=True)
class LoopResult:
    """What a run did: steps and seconds in all, examples of this process, and the mean of each metric over the last log."""

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
    return batch.to(device) if hasattr(batch, "to") and device.type != "cpu" else batch


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
        return Muon(matrices, groups, cfg.lr, weight_decay=cfg.weight_decay, adam_share=cfg.adam_share)
    return torch.optim.AdamW(groups, lr=cfg.lr, betas=(0.9, 0.99))


def run_loop(
    objective: Objective, cfg: LoopConfig, folder: Path, seed: int, writer: MetricWriter, resume: bool = True
) -> LoopResult:
    """Trains an objective to `cfg.steps` or for `cfg.minutes`, resuming from `folder/checkpoint` when it is of the same run.

    Raises:
        FloatingPointError: when the loss is not finite; the message names stage and step.
    """
    accelerator = Accelerator(cpu=not torch.cuda.is_available())
    source = objective.module
    trained = [parameter for parameter in source.parameters() if parameter.requires_grad]
    if not trained:
        raise ValueError(f"stage {objective.name!r} trains no parameter")
    optimizer = make_optimizer(source, cfg)
    module, prepared = accelerator.prepare(source, optimizer)
    checkpoint = folder / "checkpoint"
    first, spent = load_checkpoint(checkpoint, source, optimizer, objective.key) if resume else (0, 0.0)
    writer.discard_after(first)
    rank = accelerator.process_index
    if first:
        logger.info("%s: resumed at step %d of %d", objective.name, first, cfg.steps)

    def make(step: int) -> Any:
        return objective.batch(np.random.default_rng([seed, step, rank]), cfg.batch)

    began, sums, counted, last = time.monotonic(), dict[str, float](), 0, dict[str, float]()
    module.train()
    with (
        ThreadPoolExecutor(1) as pool,
        tqdm(total=cfg.steps, initial=first, desc=objective.name, mininterval=5.0, disable=rank > 0) as bar,
    ):
        ahead: Future[Any] | None = pool.submit(make, first) if first < cfg.steps else None
        for step in range(first, cfg.steps):
            assert ahead is not None
            batch = ahead.result()
            seconds = spent + time.monotonic() - began
            out_of_time = bool(cfg.minutes) and seconds > 60.0 * cfg.minutes
            ahead = pool.submit(make, step + 1) if step + 1 < cfg.steps else None
            for group in optimizer.param_groups:
                group["lr"] = learning_rate(cfg, step, seconds)
            draw_seed = (seed * 1_000_003 + step) * 64 + rank
            generator = torch.Generator().manual_seed(draw_seed)
            torch.manual_seed(draw_seed)  # dropout draws from torch's own
            found: dict[str, float] = {}
            for part in batch if isinstance(batch, Parts) else (batch,):
                with torch.autocast(accelerator.device.type, torch.bfloat16, enabled=cfg.precision == "bf16"):
                    loss, values = objective.loss(module, _moved(part, accelerator.device), generator)
                if not bool(torch.isfinite(loss)):
                    raise FloatingPointError(
                        f"{objective.name}: loss {float(loss.detach())} at step {step}; lower lr ({cfg.lr})"
                    )
                accelerator.backward(loss)
                for name, value in {"loss": float(loss.detach()), **values}.items():
                    found[name] = found.get(name, 0.0) + value
            norm = accelerator.clip_grad_norm_(trained, cfg.clip)
            prepared.step()
            prepared.zero_grad(set_to_none=True)
            for name, value in {**found, "grad_norm": float(norm or 0.0)}.items():
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
                if accelerator.is_main_process:
                    writer.write(done, last)
                bar.set_postfix(loss=f"{last['loss']:.3f}", refresh=False)
                sums = {}
            if (done % cfg.checkpoint_every == 0 or final) and accelerator.is_main_process:
                save_checkpoint(checkpoint, done, source, optimizer, objective.key, spent + time.monotonic() - began)
            if final:
                break
    module.eval()
    return LoopResult(first + counted, spent + time.monotonic() - began, counted * cfg.batch, last)
