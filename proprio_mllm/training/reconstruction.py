"""Pictures of what the motion tokenizer keeps: motions beside their reconstruction, and how often each code is used.

`render` makes all of them for held-out clips when the stage is done: a figure and a film per clip, and the codes' use. Paper:
motion tokenizer; the paper shows no reconstruction.
"""

from __future__ import annotations

import os
import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import imageio.v3 as iio
import numpy as np
import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from data.motion import FPS, decode_key_bodies
from interface.bodies import KEY_BODIES
from proprio_mllm.model.motion_tokenizer import MotionTokenizer
from proprio_mllm.training.motion_stage import codebook_use
from proprio_mllm.training.sources import Clips

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
    rebuilt = tokenizer.decode(tokenizer.encode(torch.from_numpy(window[None])))[0].cpu().numpy()
    return decode_key_bodies(window), decode_key_bodies(rebuilt)


def draw_reconstruction(pairs: Sequence[tuple[str, NDArray[np.float32], NDArray[np.float32]]]) -> Figure:
    """A figure with one row per (title, true key bodies, rebuilt key bodies)."""
    figure = Figure(figsize=(13.0, 2.7 * len(pairs)), layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.add_gridspec(len(pairs), _MOMENTS + 2)
    for row, (title, truth, rebuilt) in enumerate(pairs):
        for column, frame in enumerate(np.linspace(0, len(truth) - 1, _MOMENTS).round().astype(int)):
            axes: Any = figure.add_subplot(grid[row, column], projection="3d")
            _draw_bodies(axes, truth[frame], rebuilt[frame])
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


def _draw_bodies(axes: Any, truth: NDArray[np.float32], rebuilt: NDArray[np.float32]) -> None:
    """Key bodies (K, 3) in grey and their reconstruction in colour."""
    for bodies, colour, width in ((truth, _GREY, 4.0), (rebuilt, _ORANGE, 1.5)):
        for chain in _CHAINS:
            points = bodies[[KEY_BODIES.index(name) for name in chain]]
            axes.plot(*points.T, color=colour, linewidth=width)
    axes.set(xlim=(-0.5, 0.7), ylim=(-0.6, 0.6), zlim=(-0.95, 0.75))
    axes.set_box_aspect((1.2, 1.2, 1.7), zoom=1.35)
    axes.view_init(elev=10, azim=35)
    axes.set_axis_off()


def film_reconstruction(title: str, truth: NDArray[np.float32], rebuilt: NDArray[np.float32], path: Path) -> Path:
    """Writes key bodies (T, K, 3) and their reconstruction, over each other, as an mp4 at the motion's own rate."""
    figure = Figure(figsize=(4.0, 4.4), dpi=80)
    canvas = FigureCanvasAgg(figure)
    axes: Any = figure.add_axes((0.0, 0.0, 1.0, 0.88), projection="3d")
    figure.suptitle(textwrap.fill(title, 48), fontsize=9)
    frames = []
    for bodies, copy in zip(truth, rebuilt, strict=True):
        axes.clear()
        _draw_bodies(axes, bodies, copy)
        canvas.draw()
        frames.append(np.asarray(canvas.buffer_rgba())[..., :3].copy())
    path.parent.mkdir(parents=True, exist_ok=True)
    work = path.with_name(f".{path.name}.tmp.mp4")
    iio.imwrite(work, np.stack(frames), fps=FPS, codec="libx264", plugin="pyav")
    os.replace(work, path)
    return path


def draw_use(lines: Sequence[tuple[str, NDArray[np.int64]]]) -> Figure:
    """Share of each token over its rank, one line per (label, counts); where a line ends, no code is used any more."""
    figure = Figure(figsize=(7.0, 4.0), layout="constrained")
    FigureCanvasAgg(figure)
    axes: Any = figure.add_subplot()
    for label, counts in lines:
        used = np.sort(counts[counts > 0])[::-1]
        share = f"{100.0 * len(used) / len(counts):.0f} % of {len(counts)}"
        axes.plot(np.arange(1, len(used) + 1), 100.0 * used / used.sum(), label=f"{label}: {share}")
    axes.set(xlabel="codes by how often they occur", ylabel="share of the tokens, %", yscale="log")
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)
    return figure


def chosen_pairs(
    tokenizer: MotionTokenizer, clips: Clips, count: int = 4
) -> list[tuple[str, NDArray[np.float32], NDArray[np.float32]]]:
    """Title, key bodies and reconstruction of some held-out clips, the robots in turn."""
    rng = np.random.default_rng(0)
    robots = clips.reader.column("robot")
    drawn = list(map(int, rng.permutation(clips.split.test)))
    places = {index: sum(robots[one] == robots[index] for one in drawn[:place]) for place, index in enumerate(drawn)}
    pairs = []
    for index in sorted(drawn, key=lambda index: (places[index], robots[index]))[:count]:
        window = clips.window(index, tokenizer.cfg.window, rng)
        pairs.append((f"{robots[index]}: {clips.captions[index][0]}", *reconstruct(tokenizer, window)))
    return pairs


def render(tokenizer: MotionTokenizer, clips: Clips, folder: Path, count: int = 4) -> list[Path]:
    """Writes `reconstruction.png`, `reconstruction_0.mp4` … and `codes.png`.

    Args:
        tokenizer: in evaluation mode.
        clips: the held-out ones are drawn.
        folder: made when absent.
        count: clips.
    """
    folder.mkdir(parents=True, exist_ok=True)
    written: list[Path] = []
    pairs = chosen_pairs(tokenizer, clips, count)
    if pairs:
        written.append(folder / "reconstruction.png")
        draw_reconstruction(pairs).savefig(written[-1], dpi=80)
        written += [film_reconstruction(*pair, folder / f"reconstruction_{k}.mp4") for k, pair in enumerate(pairs)]
    rng = np.random.default_rng(0)
    rows = np.stack([clips.window(int(rng.choice(clips.split.train)), tokenizer.cfg.window, rng) for _ in range(512)])
    written.append(folder / "codes.png")
    draw_use([("training clips", codebook_use(tokenizer, rows))]).savefig(written[-1], dpi=100)
    return written
