"""Files written whole or not at all, and their hashes: what shards, models, runs and checkpoints share.

A file or folder is written under a temporary name beside its place and renamed, so that a stop leaves the old or the new one.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import shutil
import zipfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray


class DamagedFileError(ValueError):
    """A file of this project's own that cannot be read; the message names it and what is wrong."""


def read_json(path: Path) -> dict[str, Any]:
    """A JSON object that this project wrote.

    Raises:
        DamagedFileError: when the file holds anything else, as after a cut.
        FileNotFoundError: when there is no such file.
    """
    try:
        value = json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        raise DamagedFileError(f"{path}: damaged: no JSON ({error})") from error
    if not isinstance(value, dict):
        raise DamagedFileError(f"{path}: damaged: {type(value).__name__} in place of an object")
    return value


def parse_json(text: str | bytes) -> Any:
    """JSON as its standard has it.

    Raises:
        ValueError: on anything else, NaN and infinity included.
    """

    def refuse(word: str) -> Any:
        raise ValueError(f"{word} is no JSON number")

    return json.loads(text, parse_constant=refuse)


def file_hash(path: Path) -> str:
    """SHA-256 of a file, 64 hexadecimal digits."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def cache_folder() -> Path:
    """Where what is computed once per machine is kept: `proprio-mllm` in the user's cache folder (`XDG_CACHE_HOME`)."""
    return Path(os.environ.get("XDG_CACHE_HOME") or "~/.cache").expanduser() / "proprio-mllm"


def read_cached(name: str) -> dict[str, NDArray[Any]] | None:
    """Arrays that were kept under a name, which must hold the hash of all they depend on; None when there are none."""
    try:
        with np.load(cache_folder() / f"{name}.npz", allow_pickle=False) as file:
            return {key: file[key] for key in file.files}
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
        return None


def write_cached(name: str, arrays: Mapping[str, NDArray[Any]]) -> None:
    """Keeps arrays under a name; where the folder cannot be written nothing is kept, and nothing fails."""
    path = cache_folder() / f"{name}.npz"
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with temporary.open("wb") as file:
            np.savez(file, **arrays)  # type: ignore[arg-type]
        os.replace(temporary, path)
    except OSError:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)


def write_text(path: Path, text: str) -> None:
    """Writes a UTF-8 text file; into a device or a pipe, such as /dev/stdout, it writes without replacing it."""
    if path.exists() and not path.is_file() and not path.is_dir():
        with path.open("wb") as stream:
            stream.write(text.encode())
        return
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        temporary.write_bytes(text.encode())
        os.replace(temporary, path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


@contextlib.contextmanager
def new_folder(folder: Path) -> Iterator[Path]:
    """An empty folder to write to, which takes the place of `folder` when the block ends well.

    Files get the rights that the folder has, since some writers (safetensors) make them readable to their owner alone.
    A folder cannot be replaced in one step: the old one is moved to `NAME.old` for the moment of the change, and is
    what is left after a stop in it.
    """
    work, old = (folder.with_name(folder.name + ending) for ending in (".tmp", ".old"))
    shutil.rmtree(work, ignore_errors=True)
    work.mkdir(parents=True)
    try:
        yield work
    except BaseException:
        shutil.rmtree(work)
        raise
    rights = work.stat().st_mode & 0o666
    for path in work.rglob("*"):
        if path.is_file() and not path.is_symlink():
            path.chmod(rights)
    if folder.exists():
        shutil.rmtree(old, ignore_errors=True)
        os.replace(folder, old)
    os.replace(work, folder)
    shutil.rmtree(old, ignore_errors=True)
