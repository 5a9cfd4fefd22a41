"""The memory of LLM-Planner and RAP: tasks that the expert solved, with its steps and what was seen between them.

    python -m proprio_mllm.planners.memory [demos=outputs/tiny/data/demos] [out=outputs/memory] [limit=400]

reads the demonstrations that `python train.py stage=data` collects in the training tasks, none of which is a task of the
benchmark, and writes one JSON line per successful episode.

Paper: baselines LLM-Planner and RAP. RAP's released code takes its memory from the games it is evaluated on; this one does not.
"""

from __future__ import annotations

from pathlib import Path
from typing import Final

__all__ = ["MEMORY_FILE", "MemoryFileError", "check_memory"]

#: Name of the file in a memory's folder.
MEMORY_FILE: Final = "memory.jsonl"


class MemoryFileError(ValueError):
    """A memory that is not there or cannot be read; the message names it and the command that makes it."""


def check_memory(folder: Path) -> Path:
    """A memory's folder.

    Raises:
        MemoryFileError: when it holds none.
    """
    if not (folder / MEMORY_FILE).is_file():
        command = "python -m proprio_mllm.planners.memory"
        raise MemoryFileError(f"no memory at {folder}: make it with `{command}`, or set planner.memory=FOLDER")
    return folder
