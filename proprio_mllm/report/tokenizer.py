"""What motion tokenizers keep: one table over tokenizers, and how often each code is used.

    python -m proprio_mllm report tokenizers TOKENIZER [TOKENIZER ...] clips=FOLDER [out=FILE.md] [figure=FILE.png]

A TOKENIZER is a folder that stage `tokenizer` wrote (or `motion/` of released weights), `clips` a folder of `clips` shards, of
which the held-out ones count. Real clips, the two of OMOMO and the level parts of five climbing captures that `make motions`
installs, are retargeted to both robots; no stage trains on them. `joints` is the way back to the robot: mean difference
between the joint angles that follow from the motion's features and from its tokens (`data.joint_angles`). `ms` is one window
of 64 frames to tokens on one thread, as a planner does it.

Paper: motion tokenizer; the paper gives no such figures.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray

from configs.arguments import command, read_named
from data.files import write_text
from data.joint_angles import JointAngles
from data.omomo import demo_motions
from data.retarget import Retargeter
from data.shards import ShardError
from proprio_mllm.model.motion_tokenizer import MotionTokenizer
from proprio_mllm.training.motion_stage import bits_per_s, codebook_use, perplexity, reconstruction_metrics
from proprio_mllm.training.reconstruction import draw_use
from proprio_mllm.training.sources import Clips
from robots.spec import available_robots, load_robot

_HEADINGS: Final = (
    "tokenizer", "codes", "bits/s", "clips", "MPJPE mm", "hands mm", "feet mm", "velocity mm/s", "joints °", "used %",
    "perplexity", "ms",
)  # fmt: skip
_TIMED: Final = 200
_ROBOT_WINDOWS: Final = 12


@dataclass(frozen=True)
class Options:
    """Options of the command line.

    Attributes:
        clips: folder of `clips` shards.
        out: Markdown file for the table.
        figure: PNG file for the use of the codes.
    """

    clips: str
    out: str | None = None
    figure: str | None = None


@dataclass(frozen=True, slots=True)
class Row:
    """A tokenizer on one kind of clips.

    Attributes:
        name: of the tokenizer.
        tokenizer: it.
        clips: which clips.
        metrics: see `reconstruction_metrics`.
        joints_deg: per robot, mean error of joint angles.
        use: how often each token occurs.
        ms: one window to tokens.
    """

    name: str
    tokenizer: MotionTokenizer
    clips: str
    metrics: dict[str, float]
    joints_deg: dict[str, float]
    use: NDArray[np.int64]
    ms: float


def windows_of(motion: NDArray[np.float32], frames: int) -> list[NDArray[np.float32]]:
    """Windows (frames, F) of a motion (T, F), half overlapping; a shorter motion repeats its first frame in front."""
    if len(motion) < frames:
        motion = np.concatenate([np.repeat(motion[:1], frames - len(motion), axis=0), motion])
    return [motion[start : start + frames] for start in range(0, len(motion) - frames + 1, frames // 2)]


def real_windows(frames: int) -> dict[str, NDArray[np.float32]]:
    """Windows (N, frames, F) of the real clips per robot; empty when they are not installed."""
    motions = demo_motions()
    found: dict[str, NDArray[np.float32]] = {}
    for robot in available_robots() if motions else ():
        retargeter = Retargeter(load_robot(robot))
        windows = [window for human in motions for window in windows_of(retargeter(human).motion.features, frames)]
        found[robot] = np.stack(windows)
    return found


def _held_out(clips: Clips, frames: int) -> dict[str, NDArray[np.float32]]:
    """Windows of the held-out clips per robot."""
    robots = clips.reader.column("robot")
    found: dict[str, list[NDArray[np.float32]]] = {}
    for index in map(int, clips.split.test):
        found.setdefault(robots[index], []).extend(windows_of(clips.motions[index], frames))
    return {robot: np.stack(windows) for robot, windows in sorted(found.items())}


def evaluate_tokenizer(
    name: str, tokenizer: MotionTokenizer, kinds: dict[str, dict[str, NDArray[np.float32]]], solvers: dict[str, JointAngles]
) -> list[Row]:
    """A row per kind of clips.

    Args:
        name: of the tokenizer.
        tokenizer: in evaluation mode.
        kinds: windows (N, T, F) per kind of clips and robot.
        solvers: joint angles per robot.
    """
    rows: list[Row] = []
    ms = _milliseconds(tokenizer, next(iter(next(iter(kinds.values())).values()))[0])
    for kind, by_robot in kinds.items():
        everything = np.concatenate(list(by_robot.values()))
        joints = {robot: _joint_error(tokenizer, windows, solvers[robot]) for robot, windows in by_robot.items()}
        metrics = reconstruction_metrics(tokenizer, everything)
        rows.append(Row(name, tokenizer, kind, metrics, joints, codebook_use(tokenizer, everything), ms))
    return rows


@torch.no_grad()
def _joint_error(tokenizer: MotionTokenizer, windows: NDArray[np.float32], solver: JointAngles) -> float:
    """Mean error (deg) of the joints that key bodies show, over some of the windows."""
    chosen = windows[np.linspace(0, len(windows) - 1, min(_ROBOT_WINDOWS, len(windows))).round().astype(int)]
    rebuilt = tokenizer.decode(tokenizer.encode(torch.from_numpy(chosen))).cpu().numpy()
    errors = [
        np.abs(solver(copy)[1] - solver(window)[1])[:, solver.shown] for window, copy in zip(chosen, rebuilt, strict=True)
    ]
    return float(np.rad2deg(np.mean(errors)))


def _milliseconds(tokenizer: MotionTokenizer, window: NDArray[np.float32]) -> float:
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        times = []
        for _ in range(_TIMED):
            started = time.perf_counter()
            tokenizer.encode_window(window)
            times.append(time.perf_counter() - started)
    finally:
        torch.set_num_threads(threads)
    return 1e3 * float(np.median(times))


def table(rows: Sequence[Row]) -> str:
    """Markdown."""
    lines = ["| " + " | ".join(_HEADINGS) + " |", "|" + "---|" * len(_HEADINGS)]
    for row in rows:
        cfg, m = row.tokenizer.cfg, row.metrics
        cells = [
            row.name,
            f"{cfg.quantizer} {cfg.codebooks} × {cfg.codes}",
            f"{bits_per_s(cfg):.0f}",
            f"{row.clips} ({m['count']:.0f} windows)",
            *(f"{m[key]:.1f}" for key in ("mpjpe_mm", "hands_mm", "feet_mm", "velocity_mm_s")),
            ", ".join(f"{robot} {error:.1f}" for robot, error in row.joints_deg.items()),
            f"{100.0 * float((row.use > 0).mean()):.0f}",
            f"{perplexity(row.use):.0f}",
            f"{row.ms:.2f}",
        ]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


@command()
def main(arguments: Sequence[str]) -> int:
    """Command line; 0 on success, 1 when an input is missing, 2 on wrong arguments."""
    folders, options = read_named(Options, arguments, ("TOKENIZER",), more=True)
    try:
        tokenizers = {folder: MotionTokenizer.load(folder) for folder in folders}
        clips = Clips(Path(options.clips))
    except (ShardError, FileNotFoundError, ValueError) as error:
        sys.stderr.write(f"{error}\n")
        return 1
    solvers = {robot: JointAngles(load_robot(robot)) for robot in available_robots()}
    rows: list[Row] = []
    windows: dict[int, dict[str, dict[str, NDArray[np.float32]]]] = {}  # by window length: real clips are slow to retarget
    for name, tokenizer in tokenizers.items():
        frames = tokenizer.cfg.window
        if frames not in windows:
            windows[frames] = {"generated": _held_out(clips, frames), "real": real_windows(frames)}
        kinds = windows[frames]
        rows += evaluate_tokenizer(name, tokenizer, {kind: found for kind, found in kinds.items() if found}, solvers)
    text = table(rows)
    sys.stdout.write(text)
    if not any(row.clips == "real" for row in rows):
        sys.stdout.write("Real clips are not installed; run `make motions` for them.\n")
    if options.out:
        write_text(Path(options.out), text)
    if options.figure:
        Path(options.figure).parent.mkdir(parents=True, exist_ok=True)
        lines = [(f"{row.name}, {row.clips}", row.use) for row in rows]
        draw_use(lines).savefig(options.figure, dpi=100)
    return 0
