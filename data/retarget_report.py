"""Table of retargeting metrics: `python -m data.retarget report [clips]`.

Columns: generated clips per robot, and what `make motions` installed: each OMOMO clip, and the parts of the climbing clips on
level floor together (weighted by frames). What the project aims at is in the last column.

Paper: none.
"""

from __future__ import annotations

import dataclasses
import sys
import time
from collections.abc import Iterable, Sequence
from typing import Final

import numpy as np
from rich.console import Console
from rich.table import Table

from data.generator import generate_clip
from data.metrics import Metrics, evaluate
from data.omomo import find_demo_clips, level_parts, load_mocap, load_omomo
from data.retarget import Retargeter
from data.skeleton import HumanMotion
from sim.robots.spec import available_robots, load_robot

__all__ = ["TARGETS", "main", "measure", "table"]

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


def measure(retargeter: Retargeter, clips: Iterable[HumanMotion]) -> tuple[Metrics, float]:
    """Mean metrics of clips, and milliseconds per frame of retargeting."""
    metrics: list[Metrics] = []
    seconds = 0.0
    for clip in clips:
        start = time.perf_counter()
        result = retargeter(clip)
        seconds += time.perf_counter() - start
        metrics.append(evaluate(retargeter, result))
    mean = Metrics.mean(metrics)
    return mean, 1e3 * seconds / mean.frames


def table(columns: Sequence[tuple[str, Metrics, float]]) -> Table:
    """A table with one column per (name, metrics, ms per frame)."""
    out = Table()
    out.add_column("metric", no_wrap=True)
    for heading in (*(name for name, _, _ in columns), "aim at most"):
        out.add_column(heading)
    for name, aim in TARGETS.items():
        values = [dataclasses.asdict(metrics)[name] for _, metrics, _ in columns]
        out.add_row(name, *("-" if np.isnan(v) else f"{v:.2f}" for v in values), aim)
    out.add_row("ms/frame", *(f"{ms:.2f}" for _, _, ms in columns), "1")
    out.add_row("frames", *(str(metrics.frames) for _, metrics, _ in columns), "")
    return out


def main(arguments: Sequence[str]) -> int:
    """Command line; prints the table, or what is allowed."""
    if not arguments or arguments[0] != "report" or len(arguments) > 2 or not all(a.isdigit() for a in arguments[1:]):
        sys.stderr.write("usage: python -m data.retarget report [number of generated clips, 72 by default]\n")
        return 2
    count = max(1, int(arguments[1])) if len(arguments) == 2 else 72
    real = [load_omomo(path) for path in find_demo_clips() if path.suffix == ".pt"]
    level = [part for path in find_demo_clips() if path.suffix == ".npy" for part in level_parts(load_mocap(path))]
    columns: list[tuple[str, Metrics, float]] = []
    for robot in available_robots():
        retargeter = Retargeter(load_robot(robot))
        columns.append((f"{robot} generated", *measure(retargeter, (generate_clip(0, i) for i in range(count)))))
        columns += [(f"{robot} {clip.name}", *measure(retargeter, [clip])) for clip in real]
        if level:
            columns.append((f"{robot} climb, level parts", *measure(retargeter, level)))
    console = Console()
    console.print(table(columns))
    if not real:
        console.print("Real clips are not installed; run `make motions` for them.")
    return 0
