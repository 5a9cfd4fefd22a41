"""One of the processes of test_processes.py that run all stages: `python -m tests.training.all_stages OUTPUT MICRO_BATCHES`."""

from __future__ import annotations

import sys
from pathlib import Path

import torch

from tests.training.conftest import all_stages, debug_config

if __name__ == "__main__":
    torch.set_num_threads(1)
    all_stages(debug_config(Path(sys.argv[1]), [f"micro_batches={sys.argv[2]}"]))
