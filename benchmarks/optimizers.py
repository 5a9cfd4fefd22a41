"""Muon against AdamW: the language part from scratch on exercises in words, the same batches for both.

    python benchmarks/optimizers.py outputs/tiny [--steps 300] [--threads 2]

Needs the shards and the base model's processor (`python train.py stage=base`). The two runs take turns step by step, so that a
noisy machine disturbs both alike; the figures are held-out loss at equal steps, and the ratio of the seconds per step.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import time
from pathlib import Path
from typing import Final, Literal

import numpy as np
import torch

from configs.schema.train import LoopConfig
from proprio_mllm.model.batch import Batch, Collator
from proprio_mllm.model.building import build_model, load_model
from proprio_mllm.model.groups import train_only
from proprio_mllm.model.modeling import ProprioMLLM
from proprio_mllm.training.loop import learning_rate, make_optimizer
from proprio_mllm.training.sources import Demos, TextPlanning, Views
from proprio_mllm.training.text import start_from_words

_HELD_OUT: Final = 300
_CHUNK: Final = 30


class Run:
    """One optimiser's model on its way."""

    def __init__(self, output: Path, name: Literal["adamw", "muon"], args: argparse.Namespace) -> None:
        self.name, self.seconds = name, list[float]()
        self.cfg = LoopConfig(steps=args.steps, batch=args.batch, lr=args.lr, warmup=50, optimizer=name)
        trained = load_model(output / "shared" / "base" / "model")
        self.model: ProprioMLLM = build_model(trained.cfg, trained.processor, args.seed)
        start_from_words(self.model, Views(output / "data" / "views", trained.cfg).type_names)
        self.parameters = train_only(self.model, ("rows", "lm"))
        self.optimizer = make_optimizer(self.model, self.cfg)
        self.model.train()

    def step(self, number: int, batch: tuple[Batch, ...]) -> None:
        """One optimiser step."""
        began = time.perf_counter()
        for group in self.optimizer.param_groups:
            group["lr"] = learning_rate(self.cfg, number)
        self.model(batch).loss.backward()
        torch.nn.utils.clip_grad_norm_(self.parameters, self.cfg.clip)
        self.optimizer.step()
        self.optimizer.zero_grad()
        self.seconds.append(time.perf_counter() - began)

    @torch.no_grad()
    def loss(self, batches: list[Batch]) -> float:
        """Mean loss over the answers' tokens."""
        self.model.eval()
        sums = [(float(self.model((batch,)).loss) * batch.supervised, batch.supervised) for batch in batches]
        self.model.train()
        return sum(loss for loss, _ in sums) / sum(count for _, count in sums)


def main() -> int:
    """Prints a line every hundred steps and the ratio at the end."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("output", type=Path)
    parser.add_argument("--steps", type=int, default=300)
    parser.add_argument("--batch", type=int, default=24)
    parser.add_argument("--lr", type=float, default=1e-3)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    runs = [Run(args.output, "adamw", args), Run(args.output, "muon", args)]
    cfg = runs[0].model.cfg
    text_planning = TextPlanning(args.output / "data" / "text_planning", cfg, Demos(args.output / "data" / "demos", cfg))
    collator = Collator(runs[0].model.processor, cfg)
    stride = max(1, len(text_planning.test) // _HELD_OUT)
    asked = [text_planning.example(int(i), np.random.default_rng(0)) for i in text_planning.test[::stride]]
    held_out = [collator(asked[i : i + _CHUNK]) for i in range(0, len(asked), _CHUNK)]
    for number in range(args.steps):
        rng = np.random.default_rng([args.seed, number])
        batch = collator.in_parts([text_planning.draw(rng) for _ in range(args.batch)])
        for run in runs if number % 2 else reversed(runs):
            run.step(number, batch)
        if (number + 1) % 100 == 0 or number + 1 == args.steps:
            shown = ", ".join(f"{run.name} {run.loss(held_out):.3f}" for run in runs)
            sys.stdout.write(f"step {number + 1}: held-out loss {shown}\n")
            sys.stdout.flush()
    ratio = statistics.median(m / a for a, m in zip(runs[0].seconds, runs[1].seconds, strict=True))
    sys.stdout.write(f"seconds per step, muon / adamw: {ratio:.2f}\n")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
