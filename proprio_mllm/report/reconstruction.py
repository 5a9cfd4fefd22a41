"""What the motion tokenizer keeps of a motion: `python -m proprio_mllm report reconstruction TOKENIZER CLIPS [out=FILE.png]`.

TOKENIZER is a folder written by stage `tokenizer` (or `motion/` of released weights), CLIPS a folder of `clips` shards. The
picture shows held-out clips as key-body skeletons, the motion in grey and its reconstruction from tokens in colour, and the
height of both hands over time. Paper: motion tokenizer; the paper shows no reconstruction.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from configs.arguments import command, read_named
from data.shards import ShardError
from proprio_mllm.model.motion_tokenizer import MotionTokenizer
from proprio_mllm.training.reconstruction import chosen_pairs, draw_reconstruction
from proprio_mllm.training.sources import Clips


@dataclass(frozen=True)
class PictureConfig:
    """Where the picture goes.

    Attributes:
        out: file to write.
    """

    out: str = "outputs/look/reconstruction.png"


@command()
def main(arguments: Sequence[str]) -> int:
    """Command line; 0 on success, 1 when an input is missing, 2 on wrong arguments."""
    (folder, shards), config = read_named(PictureConfig, arguments, ("TOKENIZER", "CLIPS"))
    out = Path(config.out)
    try:
        tokenizer, clips = MotionTokenizer.load(folder), Clips(Path(shards))
    except (ShardError, FileNotFoundError, ValueError) as error:
        sys.stderr.write(f"{error}\n")
        return 1
    pairs = chosen_pairs(tokenizer, clips)
    out.parent.mkdir(parents=True, exist_ok=True)
    draw_reconstruction(pairs).savefig(out, dpi=80)
    sys.stdout.write(f"{out}\n")
    return 0
