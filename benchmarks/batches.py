"""Time of a training step on a batch in parts of similar length, as a share of the whole batch's.

    python benchmarks/batches.py outputs/tiny [--threads 2] [--repeats 8]

Needs the shards and the base model of `python train.py stage=base`. Each batch is run in every way in turn, so that a noisy
machine disturbs all of them alike; the figure is the median ratio.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import torch

from proprio_mllm.model.batch import Collator, Example
from proprio_mllm.model.building import load_model
from proprio_mllm.model.modeling import ProprioMLLM
from proprio_mllm.training.sources import Demos, TextPlanning

PARTS = (1, 2, 3, 4)


def seconds(model: ProprioMLLM, collator: Collator, examples: Sequence[Example], parts: int) -> float:
    """Forward and backward pass of one batch, collation included."""
    began = time.perf_counter()
    model(collator.in_parts(examples, parts)).loss.backward()
    model.zero_grad()
    return time.perf_counter() - began


def main() -> int:
    """Prints one line per kind of batch."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("output", type=Path)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--repeats", type=int, default=8)
    parser.add_argument("--batch", type=int, default=24)
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    model = load_model(args.output / "shared" / "base" / "model", trainable=True).train()
    demos = Demos(args.output / "data" / "demos", model.cfg)
    text_planning = TextPlanning(args.output / "data" / "text_planning", model.cfg, demos)
    collator, rng = Collator(model.processor, model.cfg), np.random.default_rng(0)
    kinds: dict[str, Callable[[], list[Example]]] = {
        "text_planning": lambda: [text_planning.draw(rng) for _ in range(args.batch)],
        "planning": lambda: [demos.example(int(i), None) for i in demos.draw(rng, args.batch)],
    }
    for name, draw in kinds.items():
        taken: dict[int, list[float]] = {parts: [] for parts in PARTS}
        seconds(model, collator, draw(), 1)
        for _ in range(args.repeats):
            examples = draw()
            for parts in PARTS:
                taken[parts].append(seconds(model, collator, examples, parts))
        ratios = {p: statistics.median(t / w for t, w in zip(taken[p], taken[1], strict=True)) for p in PARTS[1:]}
        shown = ", ".join(f"{p} parts {ratio:.2f}" for p, ratio in ratios.items())
        sys.stdout.write(f"{name}: whole {statistics.median(taken[1]):.3f} s; {shown}\n")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
