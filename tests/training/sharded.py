"""One of the processes of test_memory.py: trains adapters over frozen layers that the processes share, and stores them."""

from __future__ import annotations

import dataclasses
import shutil
import sys
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch
from safetensors.torch import save_file
from torch import Tensor, nn
from torch.distributed.tensor import DTensor

from configs.schema.model import ModelConfig
from configs.schema.train import LoopConfig
from proprio_mllm.model.batch import Batch, Collator, Example
from proprio_mllm.model.building import add_adapter, build_model, build_processor, save_model
from proprio_mllm.model.groups import train_only
from proprio_mllm.model.prompts import described_motion
from proprio_mllm.training.loop import Objective, Parts, run_loop
from proprio_mllm.training.memory import spare_memory
from proprio_mllm.training.processes import first_alone, processes
from tests.model.conftest import TEXTS, TYPES, make_view, small

CFG = LoopConfig(steps=6, batch=8, lr=1e-2, warmup=1)


class Mixed(Objective):
    """Descriptions of motion, with pictures in some steps and in several parts in some processes."""

    name, key = "mixed", "k"

    def __init__(self, recompute: bool = False, shard: bool = False, weights: Path | None = None) -> None:
        cfg = dataclasses.replace(small(), weights=None if weights is None else str(weights))
        model = build_model(cfg, build_processor(cfg, TEXTS, TYPES))
        torch.manual_seed(0)
        add_adapter(model)
        train_only(model, ("rows", "lora", "cse"))
        self.module: nn.Module = model
        self.model = model
        self.collator = Collator(model.processor, cfg)
        spare_memory(model, recompute, shard)

    def kind(self, rng: np.random.Generator) -> str:
        return str(rng.choice(["say", "see"]))

    def batch(self, rng: np.random.Generator, size: int, kind: str) -> Parts:
        return Parts(
            self.collator.in_parts(self.examples(rng, size, kind), 1 + int(rng.integers(2)))
        )  # of some one, of some two

    def examples(self, rng: np.random.Generator, size: int, kind: str) -> list[Example]:
        """Descriptions of motion, with pictures or without."""
        codes = rng.integers(16, size=(size, 4)).tolist()
        words = rng.choice(["put the mug", "into the fridge"], size)
        views = [(make_view(rng),) if kind == "see" else () for _ in codes]
        return [
            Example(described_motion(code, word, image=bool(view), style="terse"), view)
            for code, word, view in zip(codes, words, views, strict=True)
        ]

    def weight(self, batch: Parts) -> float:
        return float(batch[0].out_of)

    def loss(self, module: nn.Module, batch: Batch, generator: torch.Generator) -> tuple[Tensor, Mapping[str, float]]:
        return module(batch).loss, {}


def given(folder: Path, cfg: ModelConfig | None = None) -> Path:
    """A small backbone with its processor, as released weights are."""
    cfg = cfg or small()
    save_model(build_model(cfg, build_processor(cfg, TEXTS, TYPES)), folder)
    shutil.copytree(folder / "processor", folder / "vlm", dirs_exist_ok=True)
    return folder / "vlm"


def main(folder: Path, micro_batches: int, weights: Path) -> None:
    torch.set_num_threads(1)
    objective = Mixed(shard=True, weights=weights)
    run_loop(objective, CFG, folder, 0, None, micro_batches=micro_batches)
    trained = {name: one.detach().clone() for name, one in objective.module.named_parameters() if one.requires_grad}
    save_file(trained, folder / f"weights_{processes().process_index}.safetensors")
    held = sum((one.to_local() if isinstance(one, DTensor) else one).numel() for one in objective.module.parameters())
    (folder / f"held_{processes().process_index}").write_text(str(held))
    model = objective.model.eval()
    first_alone(lambda: save_model(model, folder / "model"))
    asked = objective.collator(objective.examples(np.random.default_rng(1), 2, "see"), generation=True)
    (folder / f"said_{processes().process_index}").write_text("\n".join(model.reply(asked, 6)))


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]), Path(sys.argv[3]))
