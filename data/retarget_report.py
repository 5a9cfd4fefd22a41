"""Table of retargeting metrics: `python -m proprio_mllm report retarget [clips=72] [physics=true]`.

Columns: generated clips per robot, and what `make motions` installed: each OMOMO clip, and the parts of the climbing clips on
level floor together (weighted by frames). What the project aims at is in the last column. With `physics=true` rows are added
that say whether the motors of waist and arms can follow (`data.tracking`), which takes longer than everything else.

Paper: none.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from rich.console import Console
from rich.table import Table

from configs.arguments import command, read_arguments
from configs.schema.checks import require
from data.generator import generate_clip
from data.metrics import Metrics, evaluate
from data.omomo import find_demo_clips, level_parts, load_mocap, load_omomo
from data.retarget import Retargeter
from data.skeleton import HumanMotion
from data.tracking import Tracker, Tracking
from robots.spec import available_robots, load_robot

#: Metric, its heading and what the project aims at.
TARGETS: Final = {
    "hand_cm": "1",
    "hand_p95_cm": "",
    "foot_cm": "1",
    "foot_p95_cm": "",
    "arm_deg": "8",
    "leg_deg": "13",
    "skate_cm_s": "3",
    "human_skate_cm_s": "",
    "penetration_cm": "0.5",
    "penetration_max_cm": "",
    "penetration_pct": "5",
    "float_pct": "",
    "limit_pct": "0",
    "saturation_pct": "",
    "velocity_pct": "0.3",
    "jump_pct": "",
    "jerk_rad_s3": "",
    "self_pct": "2",
    "self_max_cm": "",
    "pa_mpjpe_cm": "",
    "balance_cm": "",
    "lowest_pelvis": "",
}
#: What `data.tracking` adds.
PHYSICS: Final = ("joint_deg", "saturated_pct", "torque_ratio", "body_cm", "failed_pct")


@dataclass(frozen=True, slots=True)
class Column:
    """Mean metrics of some clips, milliseconds per frame of retargeting, and how motors follow, None when not asked for."""

    name: str
    metrics: Metrics
    ms_per_frame: float
    physics: Tracking | None = None


def measure(name: str, retargeter: Retargeter, clips: Iterable[HumanMotion], physics: bool = False) -> Column:
    """A column of the table.

    Args:
        name: heading.
        retargeter: of the robot.
        clips: at least one.
        physics: whether the clips are also simulated.
    """
    metrics: list[Metrics] = []
    tracked: list[Tracking] = []
    tracker = Tracker(retargeter.robot) if physics else None
    seconds = 0.0
    for clip in clips:
        start = time.perf_counter()
        result = retargeter(clip)
        seconds += time.perf_counter() - start
        metrics.append(evaluate(retargeter, result))
        if tracker is not None:
            tracked.append(tracker(result.motion))
    mean = Metrics.mean(metrics)
    return Column(name, mean, 1e3 * seconds / mean.frames, Tracking.mean(tracked) if tracked else None)


def table(columns: Sequence[Column]) -> Table:
    """The table of some columns."""
    out = Table()
    out.add_column("metric", no_wrap=True)
    for heading in (*(column.name for column in columns), "aim at most"):
        out.add_column(heading, overflow="fold", min_width=5)
    for name, aim in TARGETS.items():
        values = [getattr(column.metrics, name) for column in columns]
        out.add_row(name, *("-" if np.isnan(v) else f"{v:.2f}" for v in values), aim)
    out.add_row("ms/frame", *(f"{column.ms_per_frame:.2f}" for column in columns), "1")
    out.add_row("frames", *(str(column.metrics.frames) for column in columns), "")
    if any(column.physics for column in columns):
        for name in PHYSICS:
            out.add_row(f"physics: {name}", *(f"{getattr(c.physics, name):.2f}" if c.physics else "-" for c in columns), "")
    return out


@dataclass(frozen=True)
class RetargetReport:
    """What `python -m proprio_mllm report retarget` takes.

    Attributes:
        clips: generated clips per robot.
        physics: say, too, whether the motors of waist and arms can follow.
    """

    clips: int = 72
    physics: bool = False

    def __post_init__(self) -> None:
        require(self.clips > 0, f"clips={self.clips}: at least 1")


@command()
def main(arguments: Sequence[str]) -> int:
    """Command line; 0 on success, 2 on wrong arguments."""
    options = read_arguments(RetargetReport, arguments)
    count, physics = options.clips, options.physics
    real = [load_omomo(path) for path in find_demo_clips() if path.suffix == ".pt"]
    level = [part for path in find_demo_clips() if path.suffix == ".npy" for part in level_parts(load_mocap(path))]
    columns: list[Column] = []
    for robot in available_robots():
        retargeter = Retargeter(load_robot(robot))
        columns.append(measure(f"{robot} generated", retargeter, (generate_clip(0, i) for i in range(count)), physics))
        columns += [measure(f"{robot} {clip.name}", retargeter, [clip], physics) for clip in real]
        if level:
            columns.append(measure(f"{robot} climb, level parts", retargeter, level, physics))
    console = Console(width=None if sys.stdout.isatty() else 220)
    console.print(table(columns))
    if not real:
        console.print("Real clips are not installed; run `make motions` for them.")
    return 0
