"""One of the processes of test_processes.py: trains a small model of which each step uses a part, and stores its weights."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch
from safetensors.torch import save_file
from torch import Tensor, nn

from configs.schema.train import LoggerConfig, LoopConfig
from proprio_mllm.training.loop import Objective, Parts, run_loop
from proprio_mllm.training.metrics import MetricWriter
from proprio_mllm.training.processes import processes

CFG = LoopConfig(steps=24, batch=16, lr=1e-2, warmup=3, checkpoint_every=6, log_every=6)


class Senses(nn.Module):
    """Reads, and sees in some steps alone; what it tastes is in some batches of a step, and it hears never."""

    def __init__(self) -> None:
        super().__init__()
        torch.manual_seed(processes().process_index)  # only the first one's weights are to count
        self.reads, self.sees, self.tastes, self.hears = (nn.Linear(4, 8) for _ in range(4))
        self.tells = nn.Linear(8, 1)


class Mixed(Objective):
    """Rows of which some teach nothing, so that micro-batches weigh differently."""

    name, key = "mixed", "k"

    def __init__(self, dies_at: int | None = None) -> None:
        self.module: nn.Module = Senses()
        self.dies_at, self.steps = dies_at, 0

    def kind(self, rng: np.random.Generator) -> str:
        return "sees" if rng.random() < 0.4 else "reads"

    def batch(self, rng: np.random.Generator, size: int, kind: str) -> Parts:
        rows = torch.from_numpy(rng.normal(size=(size, 4)).astype(np.float32))
        taught = torch.from_numpy(rng.random(size) < 0.6)
        taught[0] = True
        whole = float(taught.sum())
        return Parts((kind, part, mask, whole) for part, mask in zip(rows.chunk(2), taught.chunk(2), strict=True))

    def weight(self, batch: Parts) -> float:
        return batch[0][3]

    def loss(self, module: nn.Module, batch: tuple, generator: torch.Generator) -> tuple[Tensor, Mapping[str, float]]:
        kind, rows, taught, whole = batch
        self.steps += 1
        if self.steps == self.dies_at:
            os.kill(os.getpid(), signal.SIGKILL)
        senses = [kind, "tastes"] if float(rows[0, 0]) > 0.8 else [kind]
        told = sum(module.tells(torch.tanh(getattr(module, sense)(rows)))[:, 0] for sense in senses)
        return ((told - rows.sum(1)).square() * taught).sum() / whole, {"rows": float(len(rows))}


def main(folder: Path, micro_batches: int, dies_at: int | None) -> None:
    torch.set_num_threads(1)
    state = processes()
    objective = Mixed(dies_at if state.process_index == state.num_processes - 1 else None)
    writer = MetricWriter(folder, "mixed", LoggerConfig("disabled")) if state.is_main_process else None
    run_loop(objective, CFG, folder, 5, writer, micro_batches=micro_batches)
    save_file(objective.module.state_dict(), folder / f"weights_{state.process_index}.safetensors")


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3]) if len(sys.argv) > 3 else None)
