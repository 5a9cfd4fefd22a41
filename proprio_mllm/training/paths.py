"""Where stages keep their outputs, and when an output is current.

    <output>/<model>/data/{clips,views,lessons,practice}   shards, shared by all variants
    <output>/<model>/shared/{words,practice,base,pointmap,tokenizer}
    <output>/<model>/<variant>/{alignment,selu}            <variant>-<seed> over shared stages of another seed

A finished stage writes `done.json` with its key (hash of configuration and inputs) and its metrics; the stage is current while
the key is the one that the present configuration and inputs give.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from configs.schema.train import TrainConfig
from data.files import read_json, write_text
from data.shards import config_hash

_SHARED = ("words", "practice", "base", "pointmap", "tokenizer")
#: Names under which what all variants share is released, by the stage that leaves it.
RELEASED_AS: Final = {"practice": "words", "base": "base", "pointmap": "pointmap"}


class StagePaths:
    """Folders of one configuration."""

    def __init__(self, cfg: TrainConfig) -> None:
        self.root = Path(cfg.output) / cfg.model.name
        self._seed, self._shared_seed = cfg.seed, cfg.seed if cfg.shared_seed is None else cfg.shared_seed
        self.variant = cfg.variant if self._shared_seed == self._seed else f"{cfg.variant}-{cfg.seed}"

    def shards(self, kind: str) -> Path:
        """Folder of shards: `views`, `demos` …; docs/data.md lists them."""
        return self.root / "data" / kind

    def stage(self, name: str) -> Path:
        """Folder of a training stage's output."""
        return self.root / ("shared" if name in _SHARED else self.variant) / name

    def seed(self, name: str) -> int:
        """Seed of a training stage."""
        return self._shared_seed if name in _SHARED else self._seed

    def model(self, name: str) -> Path:
        """The model folder that a stage leaves behind."""
        return self.stage(name) / "model"


def stage_key(cfg: object, seed: int, inputs: Mapping[str, str]) -> str:
    """Key of a stage: hash of its configuration dataclass, the seed, and the keys or hashes of its inputs."""
    values = dataclasses.asdict(cfg) if dataclasses.is_dataclass(cfg) and not isinstance(cfg, type) else cfg
    return config_hash({"config": values, "seed": seed, "inputs": dict(inputs)})


def finished_key(folder: Path) -> str | None:
    """Key of the finished output in a folder, None when there is none."""
    path = folder / "done.json"
    if not path.is_file():
        return None
    return str(read_json(path).get("key"))


def finish(folder: Path, key: str, metrics: Mapping[str, Any], command: str = "") -> None:
    """Marks a stage's output as complete; `command` is the command line that made it."""
    record = {"key": key, "command": command, "metrics": dict(metrics)}
    write_text(folder / "done.json", json.dumps(record, indent=1) + "\n")
