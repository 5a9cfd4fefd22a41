"""Commands around the model: `python -m proprio_mllm` lists them. Training is train.py, evaluation is eval.py."""

from __future__ import annotations

import sys
from typing import Final

from configs.arguments import dispatch

COMMANDS: Final = {
    "report": ("proprio_mllm.report.commands", "tables, pages, films and exports of runs, motion data and tokenizers"),
    "bodyqa": ("proprio_mllm.report.bodyqa", "questions about what a model sees and feels of its own body"),
    "memory": ("proprio_mllm.planners.memory_build", "the memory of LLM-Planner and RAP, from demonstrations"),
    "push": ("proprio_mllm.training.push", "released weights to the Hugging Face hub"),
    "serve": ("proprio_mllm.backends.serve", "a checkpoint as an OpenAI-compatible server"),
}


def main() -> int:
    """The command line; returns the exit code."""
    return dispatch("python -m proprio_mllm", COMMANDS, sys.argv[1:])


if __name__ == "__main__":
    sys.exit(main())
