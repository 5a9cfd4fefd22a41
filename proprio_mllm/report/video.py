"""One episode as a film: `python -m proprio_mllm report video RUN TASK [trial=0] [cameras=[behind,head]] [out=FILE.mp4]`.

The episode is acted out again from its trace, so no planner is needed. Frames are taken while the skills run; the plan step
stands below while it is acted out, and what became of it afterwards. A step whose result differs from the ledger's is marked.
"""

from __future__ import annotations

import logging
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from configs.arguments import read_named
from interface.failures import INVALID_OUTPUT
from proprio_mllm.report.reenact import Episode, Reenactment, RunTasks, find_record
from proprio_mllm.report.stored import load_run
from sim.tools.video import VideoRecorder, check_film

logger = logging.getLogger(__name__)

_HOLD_S: Final = 0.8


@dataclass(frozen=True)
class VideoConfig:
    """How an episode is filmed.

    Attributes:
        trial: number of the trial.
        cameras: cameras side by side.
        size: side of each picture, pixels, even.
        fps: pictures per simulated second, at most 50.
        pretty: a lamp with shadows and smooth edges, but in the head's pictures.
        out: the file; `video-TASK-TRIAL.mp4` in the run's folder by default.
    """

    trial: int = 0
    cameras: tuple[str, ...] = ("behind", "head")
    size: int = 400
    fps: int = 25
    pretty: bool = True
    out: str | None = None

    def __post_init__(self) -> None:
        check_film("default.mp4" if self.out is None else self.out, self.cameras, self.size, self.fps)


def film(episode: Episode, out: Path, config: VideoConfig) -> int:
    """Films an episode.

    Args:
        episode: which one.
        out: the `.mp4` file; it appears when the film is complete.
        config: how.

    Returns:
        The number of frames.
    """
    reenactment = Reenactment(episode)
    moments = reenactment.moments()
    next(moments)
    with VideoRecorder(reenactment.session, out, config.cameras, config.size, config.fps, config.pretty) as video:
        for moment in moments:
            reply = " ".join(moment.text.split())[:60]
            said = f"{reply} {INVALID_OUTPUT}" if moment.feedback is None else moment.feedback.to_text()
            if moment.differs:
                logger.warning("%s: %s gave %s, the ledger says %s", out.name, moment.text, moment.codes, moment.expected)
                said += " (differs from the ledger)"
            video.hold(_HOLD_S, f"{moment.number}. {said}")
            if moment.number == len(episode.record.trace):
                goals = f"{sum(moment.goals)} of {len(moment.goals)} goals hold"
                video.hold(_HOLD_S, f"{episode.record.outcome.value}: {goals}")
    return video.frames


def main(arguments: Sequence[str]) -> int:
    """Command line; 0 on success, 2 on wrong arguments or what cannot be acted out."""
    logging.basicConfig(level=logging.WARNING, format="%(message)s")
    try:
        (folder, task), config = read_named(VideoConfig, arguments, ("RUN", "TASK"))
        run = load_run(Path(folder))
        episode = RunTasks(run).episode(find_record(run, task, config.trial))
        out = Path(config.out or run.folder / f"video-{task}-{config.trial}.mp4")
        frames = film(episode, out, config)
    except ValueError as error:
        sys.stderr.write(f"video: {error}\n")
        return 2
    sys.stdout.write(f"{out}: {frames} frames, {frames / config.fps:.1f} s\n")
    return 0
