"""What a run is called: the settings in which it differs from the plain command, in words for folders and titles.

Paper: none (engineering).
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

__all__ = ["options_of"]


def options_of(config: Mapping[str, Any]) -> list[str]:
    """What a run does otherwise than the plain command.

    Args:
        config: an `EvalConfig` as a plain mapping, as `run.json` keeps it; what it lacks is at its default.
    """
    planner = config.get("planner", {})
    category, split, start = (config.get(name, "all") for name in ("category", "split", "start"))
    trials, limit, seed = config.get("trials", 1), config.get("limit"), config.get("seed", 0)
    tasks, luck = config.get("tasks", "benchmark"), config.get("contingencies", "default")
    horizon = planner.get("horizon", 1)
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
        (f"horizon{horizon}", horizon != 1),
        (f"seed{seed}", seed != 0),
        (Path(tasks).stem, tasks != "benchmark"),
    )
    return [words for words, otherwise in said if otherwise]
