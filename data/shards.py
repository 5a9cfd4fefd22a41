"""Shards: the only way in which simulator and training exchange data.

A shard folder holds Arrow files of Hugging Face `datasets` (`part-00000.arrow` …) and `manifest.json` with the schema version,
the kind, the hash of the producing configuration, and rows and sha256 of each part. Parts are written under a temporary name
and renamed; the manifest follows each part, so that an interrupted run continues with the parts that are missing. Readers
refuse unknown versions and name a corrupted file. Files are memory-mapped; nothing is copied into a cache.

Paper: none (engineering). Kinds: `views` (posed views), `clips` (motion with captions and replayed views), `demos` (expert
steps), `rollouts` (SELU's trajectories, one row per episode).
Shape letters: T frames, F motion features, H and W image rows and columns.
"""

from __future__ import annotations

import hashlib
import io
import json
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import datasets
import numpy as np
from datasets.arrow_writer import ArrowWriter
from numpy.typing import ArrayLike, NDArray
from PIL import Image

from data.files import file_hash, write_text
from data.motion import N_FEATURES
from data.shard_kinds import KINDS

SCHEMA_VERSION: Final = 2
_MANIFEST: Final = "manifest.json"


class ShardError(RuntimeError):
    """A shard folder that cannot be read or continued; the message names the file and why."""


def config_hash(config: Mapping[str, Any]) -> str:
    """Short hash of a configuration that JSON can express; equal configurations have equal hashes."""
    text = json.dumps(config, sort_keys=True, separators=(",", ":"), default=str)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def encode_png(image: NDArray[np.uint8]) -> bytes:
    """PNG bytes of an (H, W, 3) or (H, W) uint8 image."""
    buffer = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(image)).save(buffer, format="PNG", compress_level=3)
    return buffer.getvalue()


def decode_png(data: bytes) -> NDArray[np.uint8]:
    """(H, W, 3) uint8 image of PNG bytes."""
    with Image.open(io.BytesIO(data), formats=["PNG"]) as image:
        return np.asarray(image.convert("RGB"))


def decode_motion(flat: ArrayLike) -> NDArray[np.float32]:
    """(T, F) features of a stored motion.

    Raises:
        ValueError: when the length is not a multiple of F.
    """
    array = np.asarray(flat, dtype=np.float32)
    if array.size == 0 or array.size % N_FEATURES:
        raise ValueError(f"motion of {array.size} numbers; expected a multiple of {N_FEATURES}")
    return array.reshape(-1, N_FEATURES)


def decode_depth(data: bytes, height: int, width: int) -> NDArray[np.float32]:
    """(H, W) metres of float16 bytes."""
    return np.frombuffer(data, dtype="<f2").reshape(height, width).astype(np.float32)


def decode_segmentation(data: bytes, height: int, width: int) -> NDArray[np.int16]:
    """(H, W) indices of object types (-1: none) of int16 bytes."""
    return np.frombuffer(data, dtype="<i2").reshape(height, width).astype(np.int16)


@dataclass(frozen=True, slots=True)
class Part:
    """One file of a shard folder: name, rows and sha256."""

    file: str
    rows: int
    sha256: str


@dataclass(frozen=True, slots=True)
class Manifest:
    """Contents of `manifest.json`.

    Attributes:
        kind: a key of `KINDS`.
        config_hash: hash of the producing configuration.
        complete: whether the producer finished.
        parts: parts by index.
        metadata: what the producer adds (type names, statistics …), JSON values only.
    """

    kind: str
    config_hash: str
    complete: bool
    parts: Mapping[int, Part]
    metadata: Mapping[str, Any]

    @property
    def rows(self) -> int:
        """Rows in all parts."""
        return sum(part.rows for part in self.parts.values())

    @staticmethod
    def load(folder: Path) -> Manifest:
        """Reads the manifest of a shard folder.

        Raises:
            ShardError: when there is none, it is not readable, or its schema version or kind is unknown.
        """
        path = folder / _MANIFEST
        try:
            raw = json.loads(path.read_text(encoding="utf-8"))
            version, kind = raw["schema_version"], raw["kind"]
        except FileNotFoundError:
            raise ShardError(f"{path}: no such file; the folder has no shards") from None
        except (ValueError, KeyError, TypeError) as error:
            raise ShardError(f"{path}: not a shard manifest ({error})") from error
        if version != SCHEMA_VERSION:
            raise ShardError(f"{path}: schema version {version!r} is unknown; this code reads {SCHEMA_VERSION}")
        if kind not in KINDS:
            raise ShardError(f"{path}: kind {kind!r} is unknown; allowed: {', '.join(KINDS)}")
        parts = {int(index): Part(**part) for index, part in raw["parts"].items()}
        return Manifest(kind, raw["config_hash"], bool(raw["complete"]), parts, raw["metadata"])

    def save(self, folder: Path) -> None:
        """Writes the manifest atomically."""
        raw = {
            "schema_version": SCHEMA_VERSION,
            "kind": self.kind,
            "config_hash": self.config_hash,
            "complete": self.complete,
            "rows": self.rows,
            "parts": {
                str(index): {"file": part.file, "rows": part.rows, "sha256": part.sha256}
                for index, part in sorted(self.parts.items())
            },
            "metadata": dict(self.metadata),
        }
        write_text(folder / _MANIFEST, json.dumps(raw, indent=1))


class ShardWriter:
    """Writes one shard folder, part by part.

    Usage: `for i in writer.missing(n): writer.write(i, rows)`, then `writer.finish()`. One process writes; workers hand
    it rows.
    """

    def __init__(self, folder: Path, kind: str, config_hash: str, overwrite: bool = False) -> None:
        """Opens a folder, continuing what an earlier run with the same configuration left there.

        Args:
            folder: shard folder, made when absent.
            kind: a key of `KINDS`.
            config_hash: hash of the producing configuration.
            overwrite: start over when the folder holds shards of another configuration.

        Raises:
            ShardError: on an unknown kind, or shards of another configuration without `overwrite`.
        """
        if kind not in KINDS:
            raise ShardError(f"shard kind {kind!r} is unknown; allowed: {', '.join(KINDS)}")
        self.folder = Path(folder)
        self.folder.mkdir(parents=True, exist_ok=True)
        self._features = datasets.Features(dict(KINDS[kind]))
        self.manifest = Manifest(kind, config_hash, False, {}, {})
        if (self.folder / _MANIFEST).exists():
            try:
                found: Manifest | None = Manifest.load(self.folder)
            except ShardError:
                if not overwrite:
                    raise
                found = None
            if found is not None and (found.kind, found.config_hash) == (kind, config_hash):
                kept = {i: part for i, part in found.parts.items() if _intact(self.folder, part)}
                self.manifest = Manifest(kind, config_hash, found.complete and kept == found.parts, kept, found.metadata)
            elif not overwrite:
                assert found is not None
                raise ShardError(
                    f"{self.folder}: holds {found.kind} of configuration {found.config_hash}, wanted {kind} of {config_hash}; "
                    "choose another folder or overwrite"
                )
        for stale in self.folder.glob("part-*.arrow"):
            if stale.name not in {part.file for part in self.manifest.parts.values()}:
                stale.unlink()
        self.manifest.save(self.folder)

    def missing(self, parts: int) -> list[int]:
        """Indices below `parts` that are not written yet."""
        return [index for index in range(parts) if index not in self.manifest.parts]

    def write(self, index: int, rows: Iterable[Mapping[str, Any]]) -> None:
        """Writes one part; a part may have no rows.

        Args:
            index: part number, 0 to 99999.
            rows: rows with exactly the columns of the kind. Arrays may be numpy; they are flattened where the column is flat.

        Raises:
            ShardError: on a row with other columns.
        """
        final = self.folder / f"part-{index:05d}.arrow"
        temporary = self.folder / f".{final.name}.tmp"
        columns = set(self._features)
        count = 0
        writer = ArrowWriter(path=str(temporary), features=self._features)
        try:
            for row in rows:
                if set(row) != columns:
                    raise ShardError(
                        f"{final}: row {count} of kind {self.manifest.kind}: missing {sorted(columns - set(row))}, "
                        f"unknown {sorted(set(row) - columns)}"
                    )
                writer.write({name: _plain(value, self._features[name]) for name, value in row.items()})
                count += 1
            writer.finalize()
        except BaseException:
            writer.close()
            temporary.unlink(missing_ok=True)
            raise
        digest = file_hash(temporary)
        os.replace(temporary, final)
        parts = {**self.manifest.parts, index: Part(final.name, count, digest)}
        self.manifest = Manifest(self.manifest.kind, self.manifest.config_hash, False, parts, self.manifest.metadata)
        self.manifest.save(self.folder)

    def annotate(self, metadata: Mapping[str, Any]) -> None:
        """Adds to the manifest's metadata (JSON values) while the folder is not complete yet."""
        old = self.manifest
        self.manifest = Manifest(old.kind, old.config_hash, old.complete, old.parts, {**old.metadata, **metadata})
        self.manifest.save(self.folder)

    def finish(self, metadata: Mapping[str, Any] | None = None) -> Manifest:
        """Marks the folder complete and stores the producer's metadata (JSON values)."""
        old = self.manifest
        self.manifest = Manifest(old.kind, old.config_hash, True, old.parts, {**old.metadata, **(metadata or {})})
        self.manifest.save(self.folder)
        return self.manifest


class ShardReader(Sequence[Mapping[str, Any]]):
    """Reads a shard folder; rows are dicts of the columns in `KINDS`, lists as Python lists."""

    def __init__(self, folder: Path, kind: str, verify: bool = True, allow_partial: bool = False) -> None:
        """Opens a folder.

        Args:
            folder: shard folder.
            kind: the kind that the caller understands.
            verify: compare every part with its checksum.
            allow_partial: read what an unfinished producer has written so far.

        Raises:
            ShardError: on another kind, an unfinished folder, a missing file, or a file that differs from its checksum.
        """
        self.folder = Path(folder)
        self.manifest = Manifest.load(self.folder)
        if self.manifest.kind != kind:
            raise ShardError(f"{self.folder}: holds {self.manifest.kind!r} shards, expected {kind!r}")
        if not (self.manifest.complete or allow_partial):
            raise ShardError(f"{self.folder}: its producer has not finished; run the same command again to continue it")
        tables = []
        for _, part in sorted(self.manifest.parts.items()):
            path = self.folder / part.file
            if Path(part.file).name != part.file or not path.is_file():
                raise ShardError(f"{path}: listed in the manifest but missing")
            if verify and not _intact(path.parent, part):
                raise ShardError(
                    f"{path}: differs from its checksum; the file is corrupted, delete it and run its producer again"
                )
            if part.rows:
                tables.append(datasets.Dataset.from_file(str(path)))
        empty = datasets.Features(dict(KINDS[kind]))
        self.dataset = (
            datasets.concatenate_datasets(tables)
            if tables
            else datasets.Dataset.from_dict({name: [] for name in empty}, features=empty)
        )

    def __len__(self) -> int:
        """Rows in all parts."""
        return len(self.dataset)

    def __getitem__(self, index: Any) -> Any:
        """Row `index`, or the list of rows of a slice."""
        if isinstance(index, slice):
            return [self[i] for i in range(*index.indices(len(self)))]
        return self.dataset[int(index)]

    def __iter__(self) -> Iterator[Mapping[str, Any]]:
        """Rows in order."""
        return (self[index] for index in range(len(self)))

    def column(self, name: str) -> list[Any]:
        """One column without decoding the others."""
        return self.dataset.select_columns([name])[:][name]


def _plain(value: Any, feature: Any) -> Any:
    if isinstance(value, np.ndarray):
        nested = isinstance(getattr(feature, "feature", None), datasets.List)
        return value.reshape(len(value), -1).tolist() if nested else value.ravel().tolist()
    if isinstance(value, list | tuple):
        return [_plain(item, getattr(feature, "feature", None)) for item in value]
    return value


def _intact(folder: Path, part: Part) -> bool:
    path = folder / part.file
    return path.is_file() and file_hash(path) == part.sha256
