"""One of the processes of test_processes.py that run all stages: `python -m tests.training.all_stages OUTPUT MICRO_BATCHES`."""

from __future__ import annotations

import sys
from pathlib import Path

import torch

from proprio_mllm.evaluation.lessons import Lessons
from proprio_mllm.training.pipeline import Pipeline
from proprio_mllm.training.stages import STAGES
from tests.training.conftest import collect, correct, debug_config


def main(root: Path, micro_batches: int) -> None:
    torch.set_num_threads(1)
    cfg = debug_config(root, [f"micro_batches={micro_batches}"])
    pipeline = Pipeline(STAGES, cfg, collect, "python train.py stage=all", correct, Lessons())
    for stage in STAGES:
        assert pipeline.run(stage) is not None


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]))
