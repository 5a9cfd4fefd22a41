"""What the motion tokenizer keeps of a motion: `python -m proprio_mllm.report.reconstruction TOKENIZER CLIPS [FILE.png]`.

TOKENIZER is a folder written by stage `tokenizer` (or `motion/` of released weights), CLIPS a folder of `clips` shards. The
picture shows held-out clips as key-body skeletons, the motion in grey and its reconstruction from tokens in colour, and the
height of both hands over time. Paper: motion tokenizer; the paper shows no reconstruction.
"""

from __future__ import annotations

import sys
import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from data.motion import FPS, decode_key_bodies
from data.shards import ShardError
from proprio_mllm.model.geometry import KEY_BODIES
from proprio_mllm.model.motion_tokenizer import MotionTokenizer
from proprio_mllm.training.sources import Clips

__all__ = ["draw_reconstruction", "main", "reconstruct"]

_CHAINS: Final = (
    ("head", "torso"),
    ("torso", "left_shoulder", "left_elbow", "left_hand"),
    ("torso", "right_shoulder", "right_elbow", "right_hand"),
    ("torso", "left_hip", "left_knee", "left_ankle"),
    ("torso", "right_hip", "right_knee", "right_ankle"),
)
_MOMENTS: Final = 6
_GREY, _ORANGE, _BLUE = "#999999", "#ee8866", "#4477aa"


@torch.no_grad()
def reconstruct(tokenizer: MotionTokenizer, window: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Key bodies (T, K, 3) of a window (T, F) and of its reconstruction, metres, pelvis heading frame."""
    rebuilt = tokenizer.decode(tokenizer.encode(torch.from_numpy(window[None])))[0].numpy()
    return decode_key_bodies(window), decode_key_bodies(rebuilt)


def draw_reconstruction(pairs: Sequence[tuple[str, NDArray[np.float32], NDArray[np.float32]]]) -> Figure:
    """A figure with one row per (title, true key bodies, rebuilt key bodies)."""
    figure = Figure(figsize=(13.0, 2.7 * len(pairs)), layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.add_gridspec(len(pairs), _MOMENTS + 2)
    for row, (title, truth, rebuilt) in enumerate(pairs):
        for column, frame in enumerate(np.linspace(0, len(truth) - 1, _MOMENTS).round().astype(int)):
            axes: Any = figure.add_subplot(grid[row, column], projection="3d")
            for bodies, colour, width in ((truth[frame], _GREY, 4.0), (rebuilt[frame], _ORANGE, 1.5)):
                for chain in _CHAINS:
                    points = bodies[[KEY_BODIES.index(name) for name in chain]]
                    axes.plot(*points.T, color=colour, linewidth=width)
            axes.set(xlim=(-0.5, 0.7), ylim=(-0.6, 0.6), zlim=(-0.95, 0.75))
            axes.set_box_aspect((1.2, 1.2, 1.7), zoom=1.35)
            axes.view_init(elev=10, azim=35)
            axes.set_axis_off()
            axes.set_title(f"{frame / FPS:.1f} s", fontsize=8)
        lines = figure.add_subplot(grid[row, _MOMENTS:])
        seconds = np.arange(len(truth)) / FPS
        for name, colour in (("left_hand", _BLUE), ("right_hand", _ORANGE)):
            place = KEY_BODIES.index(name)
            lines.plot(seconds, truth[:, place, 2], color=colour, alpha=0.35, linewidth=4, label=name.replace("_", " "))
            lines.plot(seconds, rebuilt[:, place, 2], color=colour, linewidth=1.2)
        error_mm = 1000.0 * float(np.linalg.norm(rebuilt - truth, axis=-1).mean())
        lines.set_title(f"{textwrap.fill(title, 44)}\nMPJPE {error_mm:.0f} mm", fontsize=9)
        lines.set_xlabel("s")
        lines.set_ylabel("above the pelvis, m")
        lines.legend(fontsize=7)
    return figure


def main(arguments: Sequence[str]) -> int:
    """Command line; 0 on success, 1 when an input is missing, 2 on wrong arguments."""
    if len(arguments) not in (2, 3):
        sys.stderr.write("usage: python -m proprio_mllm.report.reconstruction TOKENIZER CLIPS [FILE.png]\n")
        return 2
    out = Path(arguments[2]) if len(arguments) == 3 else Path("outputs/look/reconstruction.png")
    try:
        tokenizer, clips = MotionTokenizer.load(arguments[0]), Clips(Path(arguments[1]))
    except (ShardError, FileNotFoundError, ValueError) as error:
        sys.stderr.write(f"{error}\n")
        return 1
    rng = np.random.default_rng(0)
    chosen = [int(i) for i in rng.permutation(clips.split.test)[:3]]
    pairs = []
    for index in chosen:
        window = clips.window(index, tokenizer.cfg.window, rng)
        pairs.append((f"{clips.reader[index]['robot']}: {clips.captions[index][0]}", *reconstruct(tokenizer, window)))
    out.parent.mkdir(parents=True, exist_ok=True)
    draw_reconstruction(pairs).savefig(out, dpi=80)
    sys.stdout.write(f"{out}\n")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
