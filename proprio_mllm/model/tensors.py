"""Tensors in files: written whole, read back checked, and an error that names the file.

Paper: none (engineering).
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch import Tensor

from data.files import DamagedFileError, file_hash


def write_tensors(tensors: Mapping[str, Tensor], path: Path) -> None:
    """Writes a safetensors file.

    Raises:
        OSError: when it cannot be written, as on a full disk.
    """
    try:
        save_file(dict(tensors), path, {"format": "pt"})
    except SafetensorError as error:
        raise OSError(f"{path}: cannot be written: {error}") from error


def read_tensors(path: Path) -> dict[str, Tensor]:
    """Reads a safetensors file.

    Raises:
        DamagedFileError: when no tensors are in it.
        FileNotFoundError: when there is no such file.
    """
    try:
        return load_file(path)
    except SafetensorError as error:
        raise DamagedFileError(f"{path}: damaged: {error}") from error


def file_hashes(folder: Path) -> dict[str, str]:
    """Checksums of the safetensors files below a folder, by their path in it."""
    return {path.relative_to(folder).as_posix(): file_hash(path) for path in sorted(folder.rglob("*.safetensors"))}


def check_files(folder: Path, hashes: Mapping[str, str]) -> None:
    """Holds files against checksums.

    Raises:
        DamagedFileError: naming the first that is missing or another one.
    """
    for name, sha256 in hashes.items():
        path = folder / name
        if not path.is_file():
            raise DamagedFileError(f"{path}: missing")
        if file_hash(path) != sha256:
            raise DamagedFileError(f"{path}: damaged: its checksum is not the one that it was written with")
