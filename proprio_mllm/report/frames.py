"""Head-camera pictures and goals of every step, acted out again and kept beside the run, so that a second report is quick.

`RUN/frames/<episode>-<size>.json` holds one episode: JPEG pictures (base64, equal ones once), which goals held after each
step, and the codes that each step gave now. The name is a hash of the ledger line, so a line that changes is acted out anew;
after a change of the simulator delete the folder. Files are written whole, so an interrupted report goes on where it stopped.
"""

from __future__ import annotations

import base64
import dataclasses
import functools
import hashlib
import io
import json
import logging
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from tqdm import tqdm

from data.files import write_text
from interface.episode import EpisodeRecord
from proprio_mllm.evaluation.ledger import to_json
from proprio_mllm.evaluation.pool import run_jobs
from proprio_mllm.report.reenact import Episode, Reenactment

logger = logging.getLogger(__name__)

FRAMES_VERSION: Final = 1
_QUALITY: Final = 75


@dataclass(frozen=True, slots=True)
class ActedOut:
    """An episode as it went when it was acted out again.

    Attributes:
        images: JPEG pictures, base64; each different one once.
        shown: index into `images` at the start and after each step.
        goals: whether each goal held at the start and after each step.
        codes: codes of each step now.
        error: why the episode could not be acted out; empty when it could, and then only is it kept.
    """

    images: tuple[str, ...] = ()
    shown: tuple[int, ...] = ()
    goals: tuple[tuple[bool, ...], ...] = ()
    codes: tuple[tuple[str, ...], ...] = ()
    error: str = ""


def episode_id(record: EpisodeRecord) -> str:
    """Hash of a ledger line, 16 hexadecimal digits."""
    line = json.dumps(to_json(record), ensure_ascii=False, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(line.encode()).hexdigest()[:16]


def encode_jpeg(image: NDArray[np.uint8]) -> bytes:
    """JPEG bytes of an (H, W, 3) uint8 image."""
    buffer = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(image)).save(buffer, format="JPEG", quality=_QUALITY, optimize=True)
    return buffer.getvalue()


def act_out(episodes: Iterable[tuple[Path, Episode]], size: int, workers: int) -> dict[str, ActedOut]:
    """Acts out what is not kept yet.

    Args:
        episodes: folder of the run, and an episode of it.
        size: side of the pictures, pixels.
        workers: processes; 0 runs here.

    Returns:
        By `episode_id`. An episode that could not be acted out has an `error`.
    """
    found: dict[str, ActedOut] = {}
    jobs: list[_Job] = []
    for folder, episode in episodes:
        name = episode_id(episode.record)
        path = folder / "frames" / f"{name}-{size}.json"
        kept = _read(path)
        if kept is None:
            jobs.append(_Job(name, path, episode))
        else:
            found[name] = kept
    if not jobs:
        return found
    make = functools.partial(_Actor, size)
    with tqdm(total=len(jobs) + len(found), initial=len(found), desc="acting out", unit="episode") as bar:
        for job, result in run_jobs(make, jobs, workers, _never, _lost):
            if result.error:
                logger.warning("%s, trial %d: %s", job.episode.record.task, job.episode.record.trial, result.error)
            else:
                job.path.parent.mkdir(parents=True, exist_ok=True)
                content = {"schema_version": FRAMES_VERSION, **dataclasses.asdict(result)}
                write_text(job.path, json.dumps(content, separators=(",", ":")) + "\n")
            found[job.name] = result
            bar.update(1)
    return found


@dataclass(frozen=True, slots=True)
class _Job:
    name: str
    path: Path
    episode: Episode


class _Actor:
    """Acts episodes out in a worker process."""

    def __init__(self, size: int) -> None:
        self._size = size

    def __call__(self, job: _Job) -> tuple[_Job, ActedOut]:
        try:
            return job, _act(job.episode, self._size)
        except (ValueError, RuntimeError) as error:  # the simulator or its grammar has changed; the report says so
            return job, ActedOut(error=f"could not be acted out again: {error}")


def _act(episode: Episode, size: int) -> ActedOut:
    reenactment = Reenactment(episode)
    images: dict[str, int] = {}
    shown: list[int] = []
    goals: list[tuple[bool, ...]] = []
    codes: list[tuple[str, ...]] = []
    for moment in reenactment.moments():
        picture = reenactment.session.world.cameras.render("head", size, size).rgb
        text = base64.b64encode(encode_jpeg(picture)).decode()
        shown.append(images.setdefault(text, len(images)))
        goals.append(moment.goals)
        if moment.number:
            codes.append(moment.codes)
    return ActedOut(tuple(images), tuple(shown), tuple(goals), tuple(codes))


def _read(path: Path) -> ActedOut | None:
    """What is kept; None when there is nothing, or only what another version of this code wrote."""
    if not path.is_file():
        return None
    raw: Mapping[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    if raw.get("schema_version") != FRAMES_VERSION:
        return None
    goals, codes = (tuple(tuple(row) for row in raw[name]) for name in ("goals", "codes"))
    return ActedOut(tuple(raw["images"]), tuple(raw["shown"]), goals, codes)


def _never(result: tuple[_Job, ActedOut]) -> bool:
    return False


def _lost(job: _Job, message: str) -> tuple[_Job, ActedOut]:
    return job, ActedOut(error=message)
