"""Runs for other tools: `python -m proprio_mllm report export RUN [RUN ...] format=sft|jsonl out=FOLDER`.

`format=sft` writes a Hugging Face dataset of supervised fine-tuning rows (`proprio_mllm.report.sft`), one per plan step, from
successful episodes; `format=jsonl` writes `episodes.jsonl`, one episode a line with all that the page of a run shows, and JPEG
pictures on request. Both come with `export.json`: schema version, provenance of the runs with a hash of each ledger, options,
and a checksum per file. Readers refuse unknown versions and changed files. Equal runs give equal `episodes.jsonl`.
"""

from __future__ import annotations

import base64
import json
import logging
import sys
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final, Literal

import datasets
from datasets.arrow_writer import ArrowWriter

from configs.arguments import read_named
from data.files import file_hash, new_folder, write_text
from interface.episode import Outcome
from proprio_mllm.report.digest import run_digest
from proprio_mllm.report.frames import ActedOut
from proprio_mllm.report.html import FrameChoice, run_data
from proprio_mllm.report.reenact import Episode, RunTasks, TaskGoneError
from proprio_mllm.report.sft import RowChoice, sft_features, sft_rows
from proprio_mllm.report.stored import Run, load_run

logger = logging.getLogger(__name__)

EXPORT_VERSION: Final = 1
_MANIFEST: Final = "export.json"
_TRACES: Final = "episodes.jsonl"


class ExportError(ValueError):
    """An export that cannot be written or read; the message names the folder or file and why."""


@dataclass(frozen=True)
class ExportConfig:
    """What is exported.

    Attributes:
        format: `sft` or `jsonl`.
        out: the folder; an earlier export in it is replaced.
        episodes: `successful` or `all`; by default successful ones for `sft` and all for `jsonl`.
        size: side of the pictures, pixels.
        workers: processes that act out; 0 does it in this one.
        steps: sft: whether only steps that succeeded are targets.
        history: sft: newest earlier steps shown in the prompt.
        proprioception: sft: whether the robot's own state is kept.
        frames: jsonl: episodes that are acted out again for pictures and goals.
    """

    format: Literal["sft", "jsonl"]
    out: str
    episodes: Literal["successful", "all"] | None = None
    size: int = 224
    workers: int = 2
    steps: Literal["succeeded", "all"] = "succeeded"
    history: int = 8
    proprioception: bool = False
    frames: FrameChoice = "none"

    def __post_init__(self) -> None:
        if not 32 <= self.size <= 1280:
            raise ValueError(f"size {self.size} outside 32..1280 pixels")
        if not 0 <= self.workers <= 256:
            raise ValueError(f"workers {self.workers} outside 0..256")
        if not 0 <= self.history <= 50:
            raise ValueError(f"history {self.history} outside 0..50 steps")
        other = ("frames",) if self.format == "sft" else ("steps", "history", "proprioception")
        defaults = {"frames": "none", "steps": "succeeded", "history": 8, "proprioception": False}
        wrong = [name for name in other if getattr(self, name) != defaults[name]]
        if wrong:
            raise ValueError(f"{wrong[0]}={getattr(self, wrong[0])} is no option of format={self.format}")

    @property
    def only_successful(self) -> bool:
        """Whether failed episodes are left out."""
        return self.episodes == "successful" or (self.episodes is None and self.format == "sft")


def export(folders: Sequence[Path], config: ExportConfig) -> Mapping[str, Any]:
    """Writes an export whole or not at all.

    Args:
        folders: folders of runs.
        config: what is exported.

    Returns:
        The manifest.

    Raises:
        ExportError: when `out` holds something else than an export, or no episode is left.
        ValueError: when a folder holds no run, or the run's configuration or tasks cannot be read.
    """
    out = Path(config.out)
    if out.is_file() or (out.is_dir() and any(out.iterdir()) and not (out / _MANIFEST).is_file()):
        raise ExportError(f"{out} holds something else than an export; give another out=FOLDER")
    runs = [load_run(folder) for folder in folders]
    if not any(_wanted(run, config) for run in runs):
        raise ExportError(f"no episode to export: {sum(len(run.records) for run in runs)} scored, episodes={config.episodes}")
    out.parent.mkdir(parents=True, exist_ok=True)
    with new_folder(out) as work:
        count, rows = (_write_sft if config.format == "sft" else _write_traces)(runs, config, work)
        files = {str(path.relative_to(work)): file_hash(path) for path in sorted(work.rglob("*")) if path.is_file()}
        options = {name: value for name, value in asdict(config).items() if name not in ("out", "workers", "format")}
        manifest = {
            "schema_version": EXPORT_VERSION,
            "format": config.format,
            "runs": [run_digest(run) for run in runs],
            "options": options,
            "episodes": count,
            "rows": rows,
            "files": files,
        }
        write_text(work / _MANIFEST, json.dumps(manifest, indent=1, ensure_ascii=False, allow_nan=False) + "\n")
    return manifest


def _wanted(run: Run, config: ExportConfig) -> set[tuple[str, int]]:
    """Task and trial of the episodes that are exported."""
    chosen = [one for one in run.records if one.outcome is Outcome.SUCCESS or not config.only_successful]
    return {(one.task, one.trial) for one in chosen}


def _write_traces(runs: Sequence[Run], config: ExportConfig, folder: Path) -> tuple[int, int]:
    lines: list[str] = []
    for run in runs:
        wanted = _wanted(run, config)
        data = run_data(run, config.frames, config.size, config.workers)
        for episode in data.episodes[: len(run.records)]:
            if (episode["task"], episode["trial"]) not in wanted:
                continue
            frames = _write_frames(data.acted.get(episode["id"]), folder, episode["id"])
            line = {"schema_version": EXPORT_VERSION, "run": data.about, "episode": {**episode, "frames": frames}}
            lines.append(json.dumps(line, ensure_ascii=False, separators=(",", ":"), allow_nan=False) + "\n")
    write_text(folder / _TRACES, "".join(lines))
    return len(lines), len(lines)


def _write_frames(acted: ActedOut | None, folder: Path, name: str) -> list[str] | None:
    """Writes an episode's pictures; their paths, the start first, or None where it was not acted out."""
    if acted is None or acted.error:
        return None
    (folder / "images" / name).mkdir(parents=True, exist_ok=True)
    paths = [f"images/{name}/{number:02d}.jpg" for number in range(len(acted.images))]
    for path, text in zip(paths, acted.images, strict=True):
        (folder / path).write_bytes(base64.b64decode(text))
    return [paths[index] for index in acted.shown]


def _write_sft(runs: Sequence[Run], config: ExportConfig, folder: Path) -> tuple[int, int]:
    choice = RowChoice(config.size, config.history, config.steps == "all", config.proprioception)
    episodes: list[tuple[str, Episode]] = []
    for run in runs:
        tasks, wanted = RunTasks(run), _wanted(run, config)
        for record in run.records:
            if (record.task, record.trial) in wanted:
                try:
                    episodes.append((run.folder.resolve().name, tasks.episode(record)))
                except TaskGoneError as error:
                    logger.warning("left out: %s", error)
    features = sft_features(choice)
    count, rows = 0, 0
    # A dataset cannot be saved to the folder of its own source.
    with tempfile.TemporaryDirectory(dir=folder.parent) as raw:
        path = str(Path(raw) / "rows.arrow")
        with ArrowWriter(path=path, features=features) as writer:
            for made in sft_rows(episodes, choice, config.workers):
                for row in made:
                    encoded: Any = features.encode_example(row)
                    writer.write(encoded)
                count, rows = count + bool(made), rows + len(made)
            if rows:
                writer.finalize()
        if not rows:
            raise ExportError(f"no row to export: none of {len(episodes)} episodes could be acted out as in its ledger")
        datasets.Dataset.from_file(path).save_to_disk(folder)
    return count, rows


def _manifest(folder: Path, wanted: str) -> dict[str, Any]:
    """The manifest of an export, after a look at its version, format and files."""
    path = folder / _MANIFEST
    if not path.is_file():
        raise ExportError(f"{folder}: no export here ({_MANIFEST} is missing)")
    manifest = json.loads(path.read_text(encoding="utf-8"))
    if manifest.get("schema_version") != EXPORT_VERSION:
        raise ExportError(f"{path}: version {manifest.get('schema_version')!r} is unknown; this code reads {EXPORT_VERSION}")
    if manifest["format"] != wanted:
        raise ExportError(f"{path}: holds format {manifest['format']!r}, expected {wanted!r}")
    for name, digest in manifest["files"].items():
        if not (folder / name).is_file() or file_hash(folder / name) != digest:
            raise ExportError(f"{folder / name}: missing or changed since the export")
    return manifest


def read_sft(folder: Path) -> tuple[datasets.Dataset, dict[str, Any]]:
    """Fine-tuning rows and the manifest of an export.

    Raises:
        ExportError: when there is none, its version or format is unknown, or a file has changed.
    """
    manifest = _manifest(folder, "sft")
    dataset = datasets.load_from_disk(folder)
    assert isinstance(dataset, datasets.Dataset)
    return dataset, manifest


def read_traces(folder: Path) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """Lines of `episodes.jsonl` (`run` and `episode`) and the manifest of an export.

    Raises:
        ExportError: when there is none, a version or the format is unknown, or a file has changed.
    """
    manifest = _manifest(folder, "jsonl")
    lines = (folder / _TRACES).read_bytes().decode().split("\n")[:-1]
    traces = [json.loads(line) for line in lines]
    for number, trace in enumerate(traces, start=1):
        version = trace.get("schema_version")
        if version != EXPORT_VERSION:
            place = f"{folder / _TRACES}, line {number}"
            raise ExportError(f"{place}: version {version!r} is unknown; this code reads {EXPORT_VERSION}")
    return traces, manifest


def main(arguments: Sequence[str]) -> int:
    """Command line; 0 on success, 2 on wrong arguments or what cannot be exported."""
    logging.basicConfig(level=logging.WARNING, format="%(message)s")
    try:
        folders, config = read_named(ExportConfig, arguments, ("RUN",), more=True)
        manifest = export([Path(folder) for folder in folders], config)
    except ValueError as error:
        sys.stderr.write(f"export: {error}\n")
        return 2
    sys.stdout.write(f"{config.out}: {manifest['episodes']} episodes, {manifest['rows']} rows\n")
    return 0
