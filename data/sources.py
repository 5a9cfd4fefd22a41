"""Clips by the configuration's source: HumanML3D's format, a folder of AMASS, or a folder of motion files.

A source is a list of clip ids, and a function from an id to one clip: clips are read one at a time, and a bad one raises
`DatasetError`, which the caller records. The ids of a folder of files are the paths below it; a file `CLIP.txt` beside a clip
holds captions in HumanML3D's format, and without one the caption is the activity in the file's name.

Paper: motion data.
"""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path
from typing import Final

from configs.schema.data import DataConfig
from data.amass import load_amass, require_smplx
from data.humanml3d import DatasetError, list_clips, load_clip, parse_captions
from data.omomo import load_mocap, load_omomo
from data.skeleton import Caption, HumanMotion

#: What a folder of files may hold, by source.
SUFFIXES: Final = {"amass": (".npz",), "folder": (".npy", ".npz", ".pt")}
#: Files of AMASS that are bodies, not motions.
_BODIES: Final = re.compile(r"shape|.*stagei")
_NOISE: Final = re.compile(r"[\d_\-.]+|\b(poses|stageii|joint|positions)\b")


def clip_ids(cfg: DataConfig, folder: Path) -> list[tuple[str, str]]:
    """(clip id, split) of all clips that the configuration asks for, in a fixed order.

    Raises:
        DatasetError: when the folder, a needed part of it, or what AMASS clips need (smplx, body models) is missing.
    """
    if cfg.source in SUFFIXES:
        if not folder.is_dir():
            raise DatasetError(f"{folder}: no such folder")
        files = (p for p in folder.rglob("*") if p.suffix in SUFFIXES[cfg.source] and not _BODIES.fullmatch(p.stem))
        clips = [(path.relative_to(folder).as_posix(), "train") for path in sorted(files)] if "train" in cfg.splits else []
        if any(name.endswith(".npz") for name, _ in clips):
            require_smplx()
            if cfg.body_models is None or not Path(cfg.body_models).expanduser().is_dir():
                raise DatasetError(f"{cfg.body_models}: no such folder of body models (data.body_models)")
    else:
        clips = [(name, split) for name, split in list_clips(folder, cfg.splits) if cfg.mirrored or not name.startswith("M")]
    return clips[: cfg.clips] if cfg.clips and cfg.source != "generated" else clips


def read_clip(cfg: DataConfig, folder: Path, name: str, split: str) -> HumanMotion:
    """One clip of `clip_ids`.

    Raises:
        DatasetError: when it cannot be used.
    """
    if cfg.source not in SUFFIXES:
        return load_clip(folder, name, split)
    clip = load_file(folder / name, Path(cfg.body_models).expanduser() if cfg.body_models else None)
    return dataclasses.replace(clip, name=name, captions=_captions(folder, name, clip.duration_s), split=split)


def load_file(path: Path, body_models: Path | None = None) -> HumanMotion:
    """One file: AMASS `.npz`, OMOMO `.pt`, or motion capture `.npy`.

    Raises:
        DatasetError: when it cannot be used, has another suffix, or is an AMASS clip and there is no folder of body models.
    """
    if path.suffix == ".npz":
        if body_models is None:
            raise DatasetError(f"{path}: an AMASS clip needs a folder of body models (data.body_models=FOLDER)")
        return load_amass(path, body_models)
    if path.suffix == ".pt":
        return load_omomo(path)
    if path.suffix == ".npy":
        return load_mocap(path)
    raise DatasetError(f"{path}: suffix {path.suffix!r}; allowed: {', '.join(SUFFIXES['folder'])}")


def activity(name: str) -> str:
    """The activity that the path of a clip names: `KIT/3/kick_high_left02_poses.npz` is a `kick high left`.

    A name of digits only says nothing; then the folder above it is asked.
    """
    for part in reversed(Path(name).with_suffix("").parts):
        words = " ".join(_NOISE.sub(" ", _NOISE.sub(" ", part)).split()).lower()
        if words:
            return words
    return "motion"


def _captions(folder: Path, name: str, duration_s: float) -> tuple[Caption, ...]:
    path = (folder / name).with_suffix(".txt")
    try:
        text = path.read_text(encoding="utf-8") if path.is_file() else ""
    except (OSError, UnicodeDecodeError) as error:
        raise DatasetError(f"{path}: {error}") from error
    return parse_captions(text, duration_s, path.name) if text.strip() else (Caption(activity(name)),)
