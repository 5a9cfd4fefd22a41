"""What clips cost to make, from retargeting to the written shard, and what the paper's 11,955 clips would cost.

    python benchmarks/replay.py [--clips 24] [--pictures-per-s 1] [--size 112] [--out FILE]

Clips are generated, of 2 to 10 s, made for both robots in one process and on one thread, without and with pictures; the
difference is the replay. The first clip of each robot and room pays for compiling the room and is timed apart. On paper:
seconds per clip and robot, times 11,955 clips times two robots, over the cores; parts do not depend on one another, so that
only the compilation on every core and the last part's length come on top.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import tempfile
import time
from pathlib import Path
from typing import Any

from configs.schema.data import DataConfig, ReplayConfig
from data.generator import write_dataset
from data.humanml3d import list_clips
from data.pipeline import part_of_clips
from data.shards import ShardWriter
from sim.collection.replay import replay_clip

PAPER_CLIPS = 11_955
CORES = (2, 64, 1024)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--clips", type=int, default=24)
    parser.add_argument("--pictures-per-s", type=float, default=1.0)
    parser.add_argument("--size", type=int, default=112, help="side of the pictures, pixels")
    parser.add_argument("--out", type=Path)
    arguments = parser.parse_args()
    replay = ReplayConfig(pictures_per_s=arguments.pictures_per_s, image_size=arguments.size)
    cfg = DataConfig(clips=arguments.clips, workers=1, replay=replay)
    with tempfile.TemporaryDirectory() as name:
        figures = measure(cfg, Path(name))
    print(json.dumps(figures, indent=1))
    if arguments.out:
        arguments.out.write_text(json.dumps(figures, indent=1) + "\n", encoding="utf-8")


def measure(cfg: DataConfig, folder: Path) -> dict[str, Any]:
    data = write_dataset(folder / "generated", cfg.clips, cfg.seed)
    clips = list_clips(data, cfg.splits)
    started = time.perf_counter()
    part_of_clips(cfg, data, clips[: len(cfg.replay.rooms)], replay_clip)
    first = time.perf_counter() - started
    bare = dataclasses.replace(cfg, replay=dataclasses.replace(cfg.replay, enabled=False))
    started = time.perf_counter()
    without = part_of_clips(bare, data, clips, None)
    bare_s = time.perf_counter() - started
    started = time.perf_counter()
    result = part_of_clips(cfg, data, clips, replay_clip)
    full_s = time.perf_counter() - started
    started = time.perf_counter()
    writer = ShardWriter(folder / "clips", "clips", "benchmark", False)
    writer.write(0, result.rows)
    writer.finish({})
    write_s = time.perf_counter() - started
    size = sum(path.stat().st_size for path in (folder / "clips").iterdir())
    made = len(clips) * len(cfg.robots)
    pictures = sum(len(row["images"]) for row in result.rows)
    per_clip_s = (full_s + write_s) / made
    return {
        "clips_times_robots": made,
        "kept": len(result.rows),
        "without_pictures": result.without_pictures,
        "frames_per_clip": result.frames / made,
        "retarget_ms_per_frame": 1e3 * without.retarget_s / without.frames,
        "metrics_ms_per_frame": 1e3 * (bare_s - without.retarget_s) / without.frames,
        "pictures": pictures,
        "pictures_per_s": pictures / max(full_s - bare_s, 1e-9),
        "write_ms_per_clip": 1e3 * write_s / made,
        "bytes_per_clip": size / max(len(result.rows), 1),
        "first_use_of_rooms_s": first,
        "s_per_clip_and_robot": per_clip_s,
        "paper_hours": {str(cores): PAPER_CLIPS * len(cfg.robots) * per_clip_s / cores / 3600.0 for cores in CORES},
        "paper_gigabytes": PAPER_CLIPS * len(cfg.robots) * size / max(len(result.rows), 1) / 1e9,
    }


if __name__ == "__main__":
    main()
