"""One episode as a strip of pictures: `python -m proprio_mllm report strip RUN TASK [trial=0] [out=FILE.png]`.

The episode is acted out again from its trace, with its own contingencies, so no planner is needed; a step whose result differs
from the ledger's is marked. Columns are plan steps: the head view, a view from its side, the plan text and the failure codes.
"""

from __future__ import annotations

import logging
import sys
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from configs.arguments import read_named
from proprio_mllm.report.reenact import Reenactment, RunTasks, find_record
from proprio_mllm.report.stored import Run, load_run

logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Frame:
    """The scene after a step: head view, third-person view (each (H, W, 3) uint8), and what to write below."""

    head: NDArray[np.uint8]
    outside: NDArray[np.uint8]
    text: str
    failed: bool


def replay(run: Run, task: str, trial: int = 0, size: int = 320, camera: str = "left") -> list[Frame]:
    """Acts an episode out again.

    Args:
        run: the run.
        task: task id.
        trial: number of the trial.
        size: side of the pictures, pixels.
        camera: third-person camera.

    Returns:
        The start and one frame per step.

    Raises:
        ValueError: when the run has no such episode, or its task has changed.
    """
    reenactment = Reenactment(RunTasks(run).episode(find_record(run, task, trial)))
    world = reenactment.session.world
    frames: list[Frame] = []
    for moment in reenactment.moments():
        views = [world.cameras.render(name, size, size, pretty=name == camera).rgb for name in ("head", camera)]
        words = " ".join(code or "ok" for code in moment.codes) + (" (differs from the ledger)" if moment.differs else "")
        if moment.differs:
            logger.warning("%s: %s gave %s, the ledger says %s", task, moment.text, moment.codes, moment.expected)
        text = f"{moment.text[:60]}\n{words}" if moment.number else f"start: {reenactment.episode.task.instruction}"
        frames.append(Frame(views[0], views[1], text, any(moment.codes)))
    return frames


def draw_strip(frames: Sequence[Frame], title: str, path: Path, per_row: int = 8) -> Path:
    """Writes the frames as a picture, at most `per_row` steps in a line, the lines of about equal length."""
    lines = -(-len(frames) // per_row)
    columns = -(-len(frames) // lines)
    figure = Figure(figsize=(2.4 * columns, 5.1 * lines + 0.4), layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.subplots(2 * lines, columns, squeeze=False)
    for axes in grid.ravel():
        axes.axis("off")
    for number, frame in enumerate(frames):
        line, column = divmod(number, columns)
        grid[2 * line][column].imshow(frame.head)
        grid[2 * line][column].set_title(f"{number}", fontsize=8)
        below = grid[2 * line + 1][column]
        below.imshow(frame.outside)
        words = "\n".join(textwrap.fill(part, 32) for part in frame.text.splitlines())
        below.text(0.5, -0.03, words, transform=below.transAxes, ha="center", va="top", fontsize=7,
                   color="#aa3377" if frame.failed else "black")  # fmt: skip
    figure.suptitle(title, fontsize=10)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=100)
    return path


@dataclass(frozen=True)
class StripConfig:
    """What a strip shows.

    Attributes:
        trial: number of the trial.
        camera: the camera beside the head's.
        out: file to write; RUN/strip-TASK-TRIAL.png by default.
    """

    trial: int = 0
    camera: str = "left"
    out: str = ""


def main(arguments: Sequence[str]) -> int:
    """Command line; 0 on success, 2 on wrong arguments."""
    try:
        (folder, task), config = read_named(StripConfig, arguments, ("RUN", "TASK"))
        run = load_run(Path(folder))
        record = find_record(run, task, config.trial)
        frames = replay(run, task, config.trial, camera=config.camera)
    except ValueError as error:
        sys.stderr.write(f"strip: {error}\n")
        return 2
    title = f"{run.title} · {task} · {record.outcome.value}"
    out = Path(config.out or run.folder / f"strip-{task}-{config.trial}.png")
    sys.stdout.write(f"{draw_strip(frames, title, out)}\n")
    return 0
