"""From human motion to `clips` shards: load, filter, retarget, filter again, replay, write.

Pictures need the simulator, which `data` may not import: the caller hands in a function (`sim.collection.replay.replay_clip`).
Parts are computed by worker processes and written by this one; an interrupted run continues.

Paper: data preparation for stages 1 and 2 (HumanML3D, PHC filtering, retargeting, replay in the simulator).
"""

from __future__ import annotations

import dataclasses
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, Final

import numpy as np

from configs.schema.data import DataConfig, ReplayConfig
from data.cluster import ray_instance
from data.filter import admit, gate, reason_group
from data.generator import GENERATOR_VERSION, write_dataset
from data.humanml3d import DatasetError
from data.metrics import Metrics, evaluate
from data.motion import FPS
from data.retarget import Retargeter
from data.shards import Manifest, ShardWriter, config_hash
from data.sources import clip_ids, read_clip
from data.workers import computed
from interface.motion import Motion
from robots.spec import load_robot

#: Raised when the same configuration gives other shards than before.
_VERSION: Final = 2
#: Fields that do not decide what is in the shards.
_NOT_CONTENT: Final = ("workers", "path", "body_models", "scheduler", "ray_address")


@dataclass(frozen=True, slots=True)
class Pictures:
    """Head-camera pictures of a replayed clip.

    Attributes:
        images: PNG bytes.
        depths: (H, W) metres as float16 bytes.
        frames: clip frame of each picture.
        cameras_in_pelvis: (4, 4) pose of the camera for each picture.
        intrinsics: (3, 3), the same for all.
        height, width: size.
        room, seed: where it was replayed, and the seed of the placement.
    """

    images: tuple[bytes, ...]
    depths: tuple[bytes, ...]
    frames: tuple[int, ...]
    cameras_in_pelvis: tuple[Any, ...]
    intrinsics: Any
    height: int
    width: int
    room: str
    seed: int


#: Motion, configuration and seed to pictures; None when no room has a free path. A module-level function, so that worker
#: processes find it.
Replay = Callable[[Motion, ReplayConfig, int], Pictures | None]


@dataclass(frozen=True, slots=True)
class PartResult:
    """Rows of one part, what was dropped and why, what PHC's list cut short, and the metrics of what was kept."""

    clips: int
    rows: list[dict[str, Any]]
    dropped: list[tuple[str, str, str]]
    truncated: list[str]
    metrics: list[tuple[str, Metrics]]
    without_pictures: int
    retarget_s: float
    frames: int


def dataset_folder(cfg: DataConfig, out: Path) -> Path:
    """The folder that clips are read from; generated clips are made when they are not there."""
    if cfg.source != "generated":
        assert cfg.path is not None
        return Path(cfg.path).expanduser()
    folder = Path(cfg.path) if cfg.path else out.parent / f"generated-{cfg.clips}-{cfg.seed}"
    return write_dataset(folder, cfg.clips, cfg.seed)


@lru_cache(maxsize=4)
def _retargeter(robot: str, iterations: int) -> Retargeter:
    return Retargeter(load_robot(robot), iterations)


def part_of_clips(cfg: DataConfig, folder: Path, clips: Sequence[tuple[str, str]], replay: Replay | None) -> PartResult:
    """Processes some clips for every robot.

    Args:
        cfg: configuration.
        folder: data set folder.
        clips: (id, split) of each clip.
        replay: makes pictures, None for none.
    """
    result = PartResult(len(clips), [], [], [], [], 0, 0.0, 0)
    without = frames = 0
    seconds = 0.0
    for name, split in clips:
        try:
            human = read_clip(cfg, folder, name, split)
        except DatasetError as error:
            result.dropped.append((name, "", str(error)))
            continue
        kept = admit(human, cfg.phc_list)
        if isinstance(kept, str):
            result.dropped.append((name, "", kept))
            continue
        if len(kept.joints) < len(human.joints):
            result.truncated.append(name)
        for robot in cfg.robots:
            retargeter = _retargeter(robot, cfg.iterations)
            start = time.perf_counter()
            done = retargeter(kept)
            seconds += time.perf_counter() - start
            frames += len(done.motion.features)
            metrics = evaluate(retargeter, done)
            assert done.motion.root_pose is not None
            reason = gate(metrics, done.motion.root_pose[:, 2], retargeter.spec.standing_pelvis_height_m, FPS, cfg.gates)
            if reason:
                result.dropped.append((name, robot, reason))
                continue
            result.metrics.append((robot, metrics))
            seed = int.from_bytes(bytes.fromhex(config_hash({"clip": name, "robot": robot, "seed": cfg.seed}))[:6], "big")
            pictures = replay(done.motion, cfg.replay, seed) if replay is not None and cfg.replay.enabled else None
            without += pictures is None
            result.rows.append(_row(done.motion, split, pictures, seed))
    return dataclasses.replace(result, without_pictures=without, retarget_s=seconds, frames=frames)


def _row(motion: Motion, split: str, pictures: Pictures | None, seed: int) -> dict[str, Any]:
    return {
        "name": motion.name,
        "robot": motion.robot,
        "motion": motion.features,
        "captions": list(motion.captions),
        "images": list(pictures.images) if pictures else [],
        "depths": list(pictures.depths) if pictures else [],
        "height": pictures.height if pictures else 0,
        "width": pictures.width if pictures else 0,
        "image_frames": list(pictures.frames) if pictures else [],
        "intrinsics": np.asarray(pictures.intrinsics).ravel().tolist() if pictures else [],
        "cameras_in_pelvis": [np.asarray(pose).ravel().tolist() for pose in pictures.cameras_in_pelvis] if pictures else [],
        "room": pictures.room if pictures else "",
        "seed": seed,
        "split": split,
    }


def build_clips(
    cfg: DataConfig,
    out: Path,
    replay: Replay | None = None,
    progress: Callable[[int, int], None] | None = None,
    overwrite: bool = False,
) -> Manifest:
    """Writes the `clips` shards of a configuration, continuing an interrupted run.

    Args:
        cfg: configuration.
        out: shard folder.
        replay: makes pictures (`sim.collection.replay.replay_clip`); None writes clips without.
        progress: called with parts done and parts in all.
        overwrite: start over when the folder holds shards of another configuration.

    Returns:
        The manifest; its metadata has what was dropped and why, and the mean metrics per robot.

    Raises:
        DatasetError: when the data set folder is not usable, or no clip is left.
        data.shards.ShardError: when the folder holds shards of another configuration and `overwrite` is off.
    """
    folder = dataset_folder(cfg, out)
    clips = clip_ids(cfg, folder)
    if not clips:
        raise DatasetError(f"{folder}: no clip in {', '.join(cfg.splits)}")
    keyed = {key: value for key, value in dataclasses.asdict(cfg).items() if key not in _NOT_CONTENT}
    keyed |= {
        "version": _VERSION,
        "generator": GENERATOR_VERSION,
        "ids": config_hash({"ids": clips}),
        "pictures": replay is not None,
    }
    writer = ShardWriter(out, "clips", config_hash(keyed), overwrite)
    parts = [clips[i : i + cfg.part_size] for i in range(0, len(clips), cfg.part_size)]
    missing = writer.missing(len(parts))
    if writer.manifest.complete and not missing:
        return writer.manifest
    done = len(parts) - len(missing)
    notes: dict[str, Any] = dict(writer.manifest.metadata.get("parts", {}))
    if progress:
        progress(done, len(parts))
    for index, result in _computed(cfg, folder, parts, missing, replay):
        notes[str(index)] = _notes(result)
        writer.write(index, result.rows)
        writer.annotate({"parts": notes})
        done += 1
        if progress:
            progress(done, len(parts))
    return writer.finish({"config": keyed, "summary": _summary(notes)})


def _computed(
    cfg: DataConfig, folder: Path, parts: Sequence[Sequence[tuple[str, str]]], missing: Sequence[int], replay: Replay | None
) -> Iterator[tuple[int, PartResult]]:
    if cfg.scheduler == "ray":
        yield from _on_ray(cfg, folder, parts, missing, replay)
        return
    calls = {index: partial(part_of_clips, cfg, folder, parts[index], replay) for index in missing}
    yield from computed(calls, cfg.workers)


def _on_ray(
    cfg: DataConfig, folder: Path, parts: Sequence[Sequence[tuple[str, str]]], missing: Sequence[int], replay: Replay | None
) -> Iterator[tuple[int, PartResult]]:
    """Parts computed on a Ray instance; one whose worker dies is computed again (Ray's own retries)."""
    with ray_instance(cfg.workers, cfg.ray_address) as ray:
        work = ray.remote(part_of_clips).options(num_cpus=1, max_retries=2)
        waiting = list(missing)
        running: dict[Any, int] = {}
        while waiting or running:
            while waiting and len(running) < 2 * max(cfg.workers, 1):  # no more than can be written while they come in
                index = waiting.pop(0)
                running[work.remote(cfg, folder, parts[index], replay)] = index
            done, _ = ray.wait(list(running))
            for reference in done:
                yield running.pop(reference), ray.get(reference)


def _notes(result: PartResult) -> dict[str, Any]:
    by_robot: dict[str, list[Metrics]] = {}
    for robot, metrics in result.metrics:
        by_robot.setdefault(robot, []).append(metrics)
    means = {robot: dataclasses.asdict(Metrics.mean(of)) for robot, of in by_robot.items()}
    for mean in means.values():
        mean["balance_cm"] = mean["balance_cm"] if np.isfinite(mean["balance_cm"]) else None
    return {
        "clips": result.clips,
        "rows": len(result.rows),
        "truncated": result.truncated,
        "dropped": [list(entry) for entry in result.dropped],
        "without_pictures": result.without_pictures,
        "retarget_s": round(result.retarget_s, 3),
        "frames": result.frames,
        "metrics": means,
    }


def _metrics(row: dict[str, Any]) -> Metrics:
    values: dict[str, Any] = {key: np.nan if value is None else value for key, value in row.items()}
    return Metrics(**values)


def _summary(notes: dict[str, Any]) -> dict[str, Any]:
    parts = list(notes.values())
    reasons = Counter(reason_group(robot, reason) for part in parts for _, robot, reason in part["dropped"])
    metrics: dict[str, Any] = {}
    for robot in sorted({robot for part in parts for robot in part["metrics"]}):
        rows = [part["metrics"][robot] for part in parts if robot in part["metrics"]]
        known = [_metrics(row) for row in rows]
        mean = dataclasses.asdict(Metrics.mean(known))
        metrics[robot] = {key: None if value != value else round(value, 3) for key, value in mean.items()}
    return {
        "rows": sum(part["rows"] for part in parts),
        "dropped": sum(len(part["dropped"]) for part in parts),
        "reasons": dict(reasons),
        "without_pictures": sum(part["without_pictures"] for part in parts),
        "retarget_ms_per_frame": round(1e3 * sum(p["retarget_s"] for p in parts) / max(1, sum(p["frames"] for p in parts)), 3),
        "metrics": metrics,
    }
