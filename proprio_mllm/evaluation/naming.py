"""What a run is called: the settings in which it differs from the plain command, in words for folders and titles.

Paper: none (engineering).
"""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any, Final

import yaml

from configs.compose import CONFIG_DIR
from configs.schema.backend import BackendConfig
from configs.schema.eval import PlannerConfig

__all__ = ["as_published", "options_of"]

#: Of a planner's fields, those that say who plans rather than how, and `reflection`, which tables have columns for.
_WHO: Final = frozenset({"name", "kind", "label", "weights", "source", "adapter", "train", "memory", "reflection"})
_ASKED: Final = ("temperature", "max_tokens", "image_size")


def options_of(config: Mapping[str, Any]) -> list[str]:
    """What a run does otherwise than the plain command.

    Args:
        config: an `EvalConfig` as a plain mapping, as `run.json` keeps it; what it lacks is at its default.
    """
    planner = config.get("planner", {})
    category, split, start = (config.get(name, "all") for name in ("category", "split", "start"))
    trials, limit, seed = config.get("trials", 1), config.get("limit"), config.get("seed", 0)
    tasks, luck = config.get("tasks", "benchmark"), config.get("contingencies", "default")
    said = (
        (category, category != "all"),
        (f"trials{trials}", trials != 1),
        (f"limit{limit}", limit is not None),
        (luck, luck != "default"),
        (start, start not in ("all", "fixed")),
        (split, split != "all"),
        ("no_reflection", planner.get("reflection", "on") == "off"),
        ("body", planner.get("body", False)),
        ("one_node", not planner.get("parallel", True)),
        *_changed(
            planner, _published(str(planner.get("name", ""))), ("horizon", "replans", "history", "examples", "temperature")
        ),
        *_changed(config.get("backend") or {}, _defaults(BackendConfig), _ASKED),
        (f"seed{seed}", seed != 0),
        (Path(tasks).stem, tasks != "benchmark"),
    )
    return [words for words, otherwise in said if otherwise]


def as_published(config: Mapping[str, Any]) -> bool:
    """Whether a run's planner and backend answer with the settings of their files in `configs/`, whoever the model is.

    A planner without a file there, a user's own, has its own settings.

    Args:
        config: as of `options_of`.
    """
    planner, backend = config.get("planner", {}), config.get("backend") or {}
    name = str(planner.get("name", ""))
    own = planner if _file(name) is None else {}
    changes = [
        *_changed(planner, _published(name) | own, [field for field in _defaults(PlannerConfig) if field not in _WHO]),
        *_changed(backend, _defaults(BackendConfig), _ASKED),
    ]
    return not any(otherwise for _, otherwise in changes)


def _changed(values: Mapping[str, Any], usual: Mapping[str, Any], names: list[str] | tuple[str, ...]) -> list[tuple[str, bool]]:
    """Each setting in words, and whether it is another than usual."""
    return [(f"{name}{values.get(name)}", values.get(name, usual[name]) != usual[name]) for name in names]


@functools.cache
def _published(planner: str) -> dict[str, Any]:
    """Settings of a planner's file in `configs/planner`; of one that has none, the defaults."""
    path = _file(planner)
    own = {} if path is None else yaml.safe_load(path.read_text(encoding="utf-8"))
    usual = _defaults(PlannerConfig)
    return usual | {name: value for name, value in own.items() if name in usual}


def _file(planner: str) -> Path | None:
    path = CONFIG_DIR / "planner" / f"{planner}.yaml"
    return path if planner.isidentifier() and path.is_file() else None


@functools.cache
def _defaults(schema: type) -> dict[str, Any]:
    return {field.name: field.default for field in fields(schema)}
