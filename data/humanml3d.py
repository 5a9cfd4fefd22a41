"""Reads data sets in HumanML3D's directory format: joints, captions with time spans, splits.

Every clip is checked before it is used; a bad one is skipped with a reason, never silently. `M` ids are mirrored clips and are
ordinary files. If `new_joints` lacks a clip, its joints are recovered from `new_joint_vecs`.

Paper: motion data (HumanML3D, 14,616 clips and their mirror images).
"""

from __future__ import annotations

import logging
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from data.motion import FPS
from data.representation import VECTOR_SIZE, joints_from_vectors
from data.skeleton import JOINTS, Caption, HumanMotion, to_z_up

logger = logging.getLogger(__name__)
Array = NDArray[np.float64]
_MIN_FRAMES: Final = 10
_SPLITS: Final = ("train", "val", "test")


class DatasetError(ValueError):
    """A data set or clip that cannot be used; the message names the file and why."""


@dataclass(frozen=True, slots=True)
class Skipped:
    """A clip that is left out, and why."""

    name: str
    reason: str


def parse_captions(text: str, duration_s: float, where: str = "captions") -> tuple[Caption, ...]:
    """Reads the lines of a caption file, `caption#word/POS ...#start_s#end_s`.

    Spans that are not numbers count as the whole clip (HumanML3D has some `nan`); spans are cut at the clip's end.

    Raises:
        DatasetError: when a line does not have four fields, or none is left.
    """
    captions: list[Caption] = []
    for number, line in enumerate(text.splitlines(), start=1):
        if not line.strip():
            continue
        fields = line.strip().split("#")
        if len(fields) != 4:
            raise DatasetError(f"{where}, line {number}: {len(fields)} fields between #, expected 4: {line[:80]!r}")
        sentence = " ".join(fields[0].split())
        try:
            start, end = float(fields[2]), float(fields[3])
        except ValueError:
            raise DatasetError(f"{where}, line {number}: time span {fields[2]!r} to {fields[3]!r} is not two numbers") from None
        if not (np.isfinite(start) and np.isfinite(end)) or end <= start:
            start, end = 0.0, 0.0
        if sentence:
            captions.append(Caption(sentence, start, min(end, duration_s) if end else 0.0))
    if not captions:
        raise DatasetError(f"{where}: no caption")
    return tuple(captions)


def list_clips(folder: Path, splits: tuple[str, ...] = _SPLITS) -> list[tuple[str, str]]:
    """(clip id, split) of all clips of the data set, in file order.

    Raises:
        DatasetError: when the folder or a needed part of it is missing; the message says what is expected.
    """
    missing = [name for name in ("texts",) if not (folder / name).is_dir()]
    if not ((folder / "new_joints").is_dir() or (folder / "new_joint_vecs").is_dir()):
        missing.append("new_joints")
    missing += [f"{split}.txt" for split in splits if not (folder / f"{split}.txt").is_file()]
    if missing:
        raise DatasetError(
            f"{folder}: {', '.join(missing)} missing; expected HumanML3D's folder with new_joints, texts, train.txt …"
        )
    clips: list[tuple[str, str]] = []
    for split in splits:
        names = (folder / f"{split}.txt").read_text(encoding="utf-8").split()
        clips += [(name, split) for name in names]
    return clips


def load_clip(folder: Path, name: str, split: str = "train") -> HumanMotion:
    """Loads and checks one clip.

    Args:
        folder: data set folder.
        name: clip id, for example `000021` or `M000021`.
        split: the split it belongs to.

    Returns:
        The clip with z up.

    Raises:
        DatasetError: when a file is missing or unreadable, has a wrong shape or size, or the motion is not plausible.
    """
    if not name.replace("_", "").isalnum():
        raise DatasetError(f"{name!r}: not a clip id")
    joints = to_z_up(_joints(folder, name))
    check_joints(name, joints)
    path = folder / "texts" / f"{name}.txt"
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise DatasetError(f"{path}: {error}") from error
    captions = parse_captions(text, (len(joints) - 1) / FPS, path.name)
    return HumanMotion(name, joints, FPS, captions, _hand_opening(folder, name, len(joints)), split)


def check_joints(name: str, joints: Array) -> None:
    """Refuses joints (T, 22, 3), z up, that are no plausible motion at 20 frames per second.

    Raises:
        DatasetError: naming the clip, the value and what is allowed.
    """
    if len(joints) < _MIN_FRAMES:
        raise DatasetError(f"{name}: {len(joints)} frames; at least {_MIN_FRAMES} are needed")
    if not np.isfinite(joints).all():
        raise DatasetError(f"{name}: positions that are not finite")
    height = float(np.ptp(joints[:, :, 2], axis=1).max())
    if not 0.5 < height < 3.0:
        raise DatasetError(
            f"{name}: body {height:.2f} m tall; expected 0.5 to 3 m (are the units metres, is the right axis up?)"
        )
    jump = float(np.abs(np.diff(joints[:, 0], axis=0)).max())
    if jump > 0.75:
        raise DatasetError(f"{name}: the pelvis jumps {jump:.2f} m between frames")


def _load_array(path: Path) -> Array:
    try:
        return np.load(path, allow_pickle=False).astype(np.float64)
    except (OSError, ValueError, EOFError) as error:
        raise DatasetError(f"{path}: not a readable array ({error})") from error


def _joints(folder: Path, name: str) -> Array:
    path = folder / "new_joints" / f"{name}.npy"
    if path.is_file():
        joints = _load_array(path)
        if joints.ndim != 3 or joints.shape[1:] != (len(JOINTS), 3):
            raise DatasetError(f"{path}: shape {joints.shape}; expected (T, {len(JOINTS)}, 3)")
        return joints
    path = folder / "new_joint_vecs" / f"{name}.npy"
    if not path.is_file():
        raise DatasetError(f"{name}: neither new_joints nor new_joint_vecs has it")
    vectors = _load_array(path)
    if vectors.ndim != 2 or vectors.shape[1] != VECTOR_SIZE:
        raise DatasetError(f"{path}: shape {vectors.shape}; expected (T, {VECTOR_SIZE})")
    return joints_from_vectors(vectors)


def _hand_opening(folder: Path, name: str, frames: int) -> Array | None:
    path = folder / "hand_opening" / f"{name}.npy"
    if not path.is_file():
        return None
    opening = _load_array(path)
    if opening.shape != (frames, 2):
        raise DatasetError(f"{path}: shape {opening.shape}; expected ({frames}, 2)")
    return np.clip(opening, 0.0, 1.0)


def load_dataset(folder: Path, splits: tuple[str, ...] = _SPLITS) -> Iterator[HumanMotion | Skipped]:
    """All clips of a data set in order; a bad clip comes as `Skipped` and is logged."""
    for name, split in list_clips(folder, splits):
        try:
            yield load_clip(folder, name, split)
        except DatasetError as error:
            logger.warning("skipped %s: %s", name, error)
            yield Skipped(name, str(error))
