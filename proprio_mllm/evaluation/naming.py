"""What a run is called: the settings in which it differs from the plain command, in words for folders and titles.

Paper: none (engineering).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from configs.compose import group_file
from configs.schema.backend import BackendConfig
from configs.schema.checks import defaults_of
from configs.schema.eval import EvalConfig
from configs.schema.planner import PLANNER_KINDS

#: Of a planner's fields, those that say who plans rather than how, and `reflection`, which tables have columns for.
_WHO: Final = frozenset({"weights", "source", "adapter", "train", "memory", "reflection"})
_ASKED: Final = ("temperature", "max_tokens", "image_size")


def options_of(config: Mapping[str, Any]) -> list[str]:
    """What a run does otherwise than the plain command.

    Args:
        config: an `EvalConfig` as a plain mapping, as `run.json` keeps it; what it lacks is at its default.
    """
    planner = config.get("planner", {})
    category, split, start = (config.get(name, "all") for name in ("category", "split", "start"))
    trials, limit, seed = config.get("trials", 1), config.get("limit"), config.get("seed", 0)
    tasks, contingencies = config.get("tasks", "benchmark"), config.get("contingencies", "default")
    usual = defaults_of(EvalConfig)
    steps, stuck = (config.get(name, usual[name]) for name in ("steps", "stuck"))
    said = (
        (category, category != "all"),
        (f"trials{trials}", trials != 1),
        (f"limit{limit}", limit is not None),
        (contingencies, contingencies != "default"),
        (start, start not in ("all", "fixed")),
        (f"steps_{steps}", steps != usual["steps"]),
        (f"stuck{stuck}", stuck != usual["stuck"]),
        (split, split != "all"),
        ("no_reflection", planner.get("reflection", "on") == "off"),
        ("body", planner.get("body", False)),
        (f"blind_{planner.get('blind')}", planner.get("blind", "none") != "none"),
        ("bit", config.get("feedback", "codes") == "bit"),
        ("one_node", not planner.get("parallel", True)),
        *_changed(planner, _published(planner), ("horizon", "replans", "history", "examples", "temperature")),
        *_changed(config.get("backend") or {}, defaults_of(BackendConfig), _ASKED),
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
    changes = _changed(backend, defaults_of(BackendConfig), _ASKED)
    if group_file("planner", _name(planner)):
        published = _published(planner)
        changes += _changed(planner, published, [name for name in published if name not in _WHO])
    return not any(otherwise for _, otherwise in changes)


def _changed(values: Mapping[str, Any], usual: Mapping[str, Any], names: Sequence[str]) -> list[tuple[str, bool]]:
    """Each setting in words, and whether it is another than usual."""
    return [(f"{name}{values.get(name)}", values.get(name, usual[name]) != usual[name]) for name in names if name in usual]


def _published(planner: Mapping[str, Any]) -> dict[str, Any]:
    """Settings of a planner's file in `configs/planner`; of one that has none, the defaults of its kind."""
    schema = PLANNER_KINDS.get(planner.get("kind", ""))
    return ({} if schema is None else defaults_of(schema)) | group_file("planner", _name(planner))


def _name(planner: Mapping[str, Any]) -> str:
    return str(planner.get("name", ""))
