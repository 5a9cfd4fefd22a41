"""Memory and speed of reading a data set of HumanML3D's size: list, load, check and filter, one clip at a time.

    python benchmarks/streaming.py [--clips 14616] [--distinct 240] [--seed 0]

Writes a few hundred generated clips, links them to as many ids as asked (three files each), breaks one clip, and streams all of
them through PHC's list and the automatic rule, without retargeting. Prints what was kept and why not, clips per second, and the
peak of the resident memory before and after: this process and all that it imported.
"""

from __future__ import annotations

import argparse
import os
import resource
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

from configs.schema.data import DataConfig
from data.filter import admit, reason_group
from data.generator import write_dataset
from data.humanml3d import DatasetError
from data.sources import clip_ids, read_clip

#: HumanML3D's clips before mirroring.
CLIPS = 14616


def linked(folder: Path, clips: int, distinct: int, seed: int) -> Path:
    """A folder in HumanML3D's format with `clips` ids over `distinct` generated clips, one of them broken."""
    made = write_dataset(folder / "made", distinct, seed)
    out = folder / "linked"
    for name, suffix in (("new_joints", "npy"), ("hand_opening", "npy"), ("texts", "txt")):
        (out / name).mkdir(parents=True)
        for number in range(clips):
            os.link(made / name / f"{number % distinct:06d}.{suffix}", out / name / f"{number:06d}.{suffix}")
    broken = out / "new_joints" / "000000.npy"
    broken.unlink()
    broken.write_bytes(b"not an array")
    (out / "train.txt").write_text("".join(f"{number:06d}\n" for number in range(clips)), encoding="utf-8")
    return out


def peak_mb() -> float:
    """Highest resident memory of this process so far, in 10^6 bytes."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e6


def stream(cfg: DataConfig, folder: Path) -> tuple[Counter[str], int]:
    """Counts of what became of each clip, and the frames of those kept."""
    counts: Counter[str] = Counter()
    frames = 0
    for name, split in clip_ids(cfg, folder):
        try:
            clip = admit(read_clip(cfg, folder, name, split), cfg.phc_list)
        except DatasetError as error:
            sys.stdout.write(f"skipped {name}: {error}\n")
            clip = str(error)
        if isinstance(clip, str):
            counts[reason_group("", clip)] += 1
        else:
            counts["kept"] += 1
            frames += len(clip.joints)
    return counts, frames


def main() -> int:
    """Prints the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--clips", type=int, default=CLIPS)
    parser.add_argument("--distinct", type=int, default=240)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = linked(Path(temporary), args.clips, min(args.distinct, args.clips), args.seed)
        cfg = DataConfig(source="humanml3d", path=str(folder), clips=0, splits=("train",), phc_list=True)
        before, wall, cpu = peak_mb(), time.perf_counter(), time.process_time()
        counts, frames = stream(cfg, folder)
        wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    sys.stdout.write(f"{args.clips} clips: {', '.join(f'{name} {count}' for name, count in sorted(counts.items()))}\n")
    sys.stdout.write(
        f"{frames} frames kept; {args.clips / wall:.0f} clips/s of wall time, {args.clips / cpu:.0f} of CPU time\n"
    )
    sys.stdout.write(f"peak resident memory {before:.0f} MB before, {peak_mb():.0f} MB after\n")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
