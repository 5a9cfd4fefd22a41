"""The figures that the paper prints. They were measured in another simulator with a 7B model: tables show them in columns of
their own, marked "paper", and never mix them with what this repository measured.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import yaml

from interface.bodies import PAPER_ROBOTS

#: Rows of the paper's tables that stand beside a planner of ours: planner name to (Table II, Table III, Table IV).
PAPER_ROWS: Final[Mapping[str, tuple[str | None, str | None, str | None]]] = {
    "proprio": ("Proprio-MLLM", "Proprio-MLLM", "Proprio-MLLM"),
    "proprio_no_cse": (None, None, "without CSE"),
    "proprio_no_mpe": (None, None, "without MPE"),
    "proprio_no_mpe_cse": (None, None, "without both"),
    "base": (None, None, "Qwen2.5-VL-Ins"),
    "gpt4o": ("GPT-4o", None, None),
    "gemini": ("Gemini-1.5-Pro", None, None),
    "qwen2_5_vl": ("Qwen2.5-VL-7B-Ins", None, None),
    "internvl2_5": ("InternVL2.5-8B", None, None),
    "llm_planner": ("LLM-Planner", None, None),
    "rap": ("RAP", None, None),
    "dag_plan": ("DAG-Plan", "DAG-Plan", None),
}
_COLUMNS: Final = tuple(
    (category, robot) for category in ("essential", "optional", "single") for robot in reversed(PAPER_ROBOTS)
)


@functools.cache
def _tables() -> dict[str, Any]:
    return yaml.safe_load((Path(__file__).parent / "paper_tables.yaml").read_text(encoding="utf-8"))


def paper_main() -> dict[str, dict[tuple[str, str], float]]:
    """Table II: success in percent by method, then by (category, robot)."""
    table = _tables()["main_success_rate_percent"]
    return {
        name: dict(zip(_COLUMNS, values, strict=True)) for name, values in table.items() if name != "mean_gain_over_dag_plan"
    }


def paper_replanning() -> dict[str, dict[str, float]]:
    """Table III: success in percent by method, then by difficulty; H1, dual-arm essential."""
    table = _tables()["replanning_h1_essential_percent"]
    return {name: dict(zip(table["columns"], values, strict=True)) for name, values in table.items() if name != "columns"}


def paper_ablation() -> dict[str, dict[str, float]]:
    """Table IV: success in percent and failures by type, by method; H1, dual-arm essential, 133 tasks x 50 trials."""
    table = _tables()["ablation_h1_essential"]
    return {name: dict(zip(table["columns"], values, strict=True)) for name, values in table.items() if name != "columns"}
