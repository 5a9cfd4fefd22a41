"""Lists types, rooms, robots, actions, failure codes and cameras: `python -m sim catalogue [json=true]`.

The user's own assets (`configs.assets`) are included. The JSON has the same entries with every field, and counts.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

from configs.arguments import command, read_arguments
from interface.actions import ACTIONS
from interface.failures import FAILURES
from robots.spec import available_robots, load_robot
from sim.interfaces.aliases import ALIASES
from sim.scene.catalogue import load_catalogue
from sim.scene.rooms import load_room, room_names
from sim.session.contingency import DIFFICULTIES, OUTCOMES
from sim.world.rendering import CAMERAS

Row = dict[str, Any]


def inventory() -> dict[str, Any]:
    """Everything that commands and configurations may name: a list of rows per kind, and `counts`."""
    parts: dict[str, list[Row]] = {
        "types": _types(),
        "rooms": _rooms(),
        "robots": _robots(),
        "actions": _actions(),
        "failure_codes": [
            {
                "code": code.value,
                "category": "of the action" if spec.category is None else spec.category.value,
                "meaning": spec.meaning,
                "margins": list(spec.margins),
            }
            for code, spec in FAILURES.items()
        ],
        "cameras": [{"name": name} for name in CAMERAS],
        "difficulties": [{"name": name} for name in DIFFICULTIES],
        "contingencies": [{"outcome": name} for name in OUTCOMES],
    }
    return {**parts, "counts": {name: len(rows) for name, rows in parts.items()}}


def _types() -> list[Row]:
    return [
        {
            "name": kind.name,
            "rooms": list(kind.rooms),
            "size_m": list(kind.size),
            "mass_kg": kind.mass,
            "properties": sorted(kind.properties),
            "moving": [moving.name for moving in kind.moving],
        }
        for kind in load_catalogue().types.values()
    ]


def _rooms() -> list[Row]:
    rows: list[Row] = []
    for name in room_names():
        room = load_room(name)
        x0, y0, x1, y1 = room.bounds
        rows.append(
            {
                "name": name,
                "category": room.category,
                "size_m": [round(x1 - x0, 3), round(y1 - y0, 3)],
                "furniture": [item.id for item in room.furniture],
                "objects": {item.id: item.receptacle for item in room.objects},
            }
        )
    return rows


def _robots() -> list[Row]:
    rows: list[Row] = []
    for name in available_robots():
        spec = load_robot(name)
        rows.append(
            {
                "name": name,
                "joints": len(spec.joints),
                "arm_joints": len(spec.arms["left"].joints),
                "hand_joints": len(spec.arms["left"].hand_joints),
                "pelvis_height_m": list(spec.pelvis_height_range_m),
                "max_load_kg": spec.arms["left"].max_load_kg,
                "two_arm_max_load_kg": spec.two_arm_max_load_kg,
                "solver": spec.solver,
            }
        )
    return rows


def _actions() -> list[Row]:
    aliases: dict[str, list[str]] = {}
    for alias, name in ALIASES.items():
        if alias != name.lower():
            aliases.setdefault(name, []).append(alias)
    return [
        {
            "name": spec.name,
            "kind": spec.kind.value,
            "meaning": spec.meaning,
            "takes_object": spec.takes_object,
            "tool": spec.tool,
            "amount": None
            if spec.amount is None
            else {"unit": spec.amount.unit, "range": [spec.amount.low, spec.amount.high], "default": spec.amount.default},
            "failure_codes": [code.value for code in spec.codes],
            "aliases": aliases.get(spec.name, []),
        }
        for spec in ACTIONS.values()
    ]


def _cell(value: Any) -> str:
    if isinstance(value, Mapping):
        return ", ".join(f"{key}: {_cell(item)}" for key, item in value.items())
    if isinstance(value, list):
        return ", ".join(map(_cell, value)) or "–"
    return "–" if value is None else "yes" if value is True else "no" if value is False else str(value)


def _print(parts: Mapping[str, Any], console: Console) -> None:
    for name, count in parts["counts"].items():
        rows: list[Row] = parts[name]
        if len(rows) and len(rows[0]) == 1:
            console.print(f"\n{name} ({count}): {', '.join(str(*row.values()) for row in rows)}")
            continue
        table = Table(box=SIMPLE_HEAD, title=f"{name} ({count})", title_justify="left")
        for column in rows[0]:
            table.add_column(column.replace("_", " "), overflow="fold")
        for row in rows:
            table.add_row(*map(_cell, row.values()))
        console.print(table)


@dataclass(frozen=True)
class CatalogueConfig:
    """How the catalogue is printed.

    Attributes:
        json: one JSON object with every field and counts, in place of tables.
    """

    json: bool = False


@command()
def main(arguments: Sequence[str]) -> int:
    """Prints the inventory; returns the exit code."""
    wanted = read_arguments(CatalogueConfig, arguments)
    parts = inventory()
    if wanted.json:
        sys.stdout.write(json.dumps(parts, indent=1) + "\n")
    else:
        _print(parts, Console(width=None if sys.stdout.isatty() else 160))
    return 0
