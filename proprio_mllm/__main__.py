"""Commands around the model: `python -m proprio_mllm` lists them. Training is train.py, evaluation is eval.py."""

from __future__ import annotations

import sys
from typing import Final

from configs.arguments import dispatch

__all__ = ["COMMANDS"]

COMMANDS: Final = {
    "report": ("proprio_mllm.report.commands", "tables, pages, films and exports of runs, motion data and tokenizers"),
    "memory": ("proprio_mllm.planners.memory_build", "the memory of LLM-Planner and RAP, from demonstrations"),
    "serve": ("proprio_mllm.backends.serve", "a checkpoint as an OpenAI-compatible server"),
}

if __name__ == "__main__":
    sys.exit(dispatch("python -m proprio_mllm", COMMANDS, sys.argv[1:]))
