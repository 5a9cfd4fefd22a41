"""What the motion tokenizer keeps of a motion: `python -m proprio_mllm.report.reconstruction TOKENIZER CLIPS [FILE.png]`.

TOKENIZER is a folder written by stage `tokenizer` (or `motion/` of released weights), CLIPS a folder of `clips` shards. The
picture shows held-out clips as key-body skeletons, the motion in grey and its reconstruction from tokens in colour, and the
height of both hands over time. Paper: motion tokenizer; the paper shows no reconstruction.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

from configs.help import shows_help
from data.shards import ShardError
from proprio_mllm.model.motion_tokenizer import MotionTokenizer
from proprio_mllm.training.reconstruction import chosen_pairs, draw_reconstruction
from proprio_mllm.training.sources import Clips

__all__ = ["main"]


def main(arguments: Sequence[str]) -> int:
    """Command line; 0 on success, 1 when an input is missing, 2 on wrong arguments."""
    if shows_help(arguments, __doc__):
        return 0
    if len(arguments) not in (2, 3):
        sys.stderr.write("usage: python -m proprio_mllm.report.reconstruction TOKENIZER CLIPS [FILE.png]\n")
        return 2
    out = Path(arguments[2]) if len(arguments) == 3 else Path("outputs/look/reconstruction.png")
    try:
        tokenizer, clips = MotionTokenizer.load(arguments[0]), Clips(Path(arguments[1]))
    except (ShardError, FileNotFoundError, ValueError) as error:
        sys.stderr.write(f"{error}\n")
        return 1
    pairs = chosen_pairs(tokenizer, clips)
    out.parent.mkdir(parents=True, exist_ok=True)
    draw_reconstruction(pairs).savefig(out, dpi=80)
    sys.stdout.write(f"{out}\n")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
