"""Table of what the filters dropped: `python -m proprio_mllm report filter FOLDER`.

Of a folder of `clips` shards it counts what the manifest records, from the clips in the list to those kept for each robot. Of
a folder in HumanML3D's format, which needs no processing, it counts what PHC's list decides about its ids.

Paper: data preparation, "filtered with PHC": 11k of HumanML3D's 14,616 clips are left.
"""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from configs.help import shows_help
from data.filter import GATES, phc_list, reason_group
from data.humanml3d import DatasetError, list_clips
from data.shards import Manifest, ShardError

_USAGE = "usage: python -m proprio_mllm report filter FOLDER (clips shards, or a folder in HumanML3D's format)\n"


def list_counts(ids: Iterable[str]) -> Counter[str]:
    """What PHC's list decides about HumanML3D ids, mirrored or not.

    Returns:
        Counts of `clips`, `PHC list: ISSUE`, `kept`, and of those `truncated` and `whole`.
    """
    counts: Counter[str] = Counter()
    for name in ids:
        decision = phc_list().get(name.removeprefix("M"))
        counts["clips"] += 1
        if decision is not None and decision.decision != "truncate":
            counts[f"PHC list: {decision.issue or decision.decision}"] += 1
            continue
        counts["kept"] += 1
        counts["whole" if decision is None else "truncated"] += 1
    return counts


def shard_counts(manifest: Manifest) -> dict[str, Counter[str]]:
    """What was dropped on the way to `clips` shards.

    Returns:
        By robot the gates and `kept`; under an empty name `clips`, `unusable`, `PHC list: ISSUE`, `automatic rule`,
        `retargeted`, and of those `truncated`.

    Raises:
        ShardError: when the shards are of another kind or do not say how many clips were read.
    """
    parts: list[dict[str, Any]] = list(manifest.metadata.get("parts", {}).values())
    if manifest.kind != "clips" or any("clips" not in part for part in parts):
        raise ShardError(f"shards of kind {manifest.kind!r} without counts of clips; write them again with stage=data")
    robots = sorted(
        {robot for part in parts for robot in (*part["metrics"], *(entry[1] for entry in part["dropped"])) if robot}
    )
    counts: dict[str, Counter[str]] = {name: Counter() for name in ("", *robots)}
    for part in parts:
        counts[""].update({"clips": part["clips"], "truncated": len(part["truncated"])})
        for _, robot, reason in part["dropped"]:
            counts[robot][reason_group(robot, reason)] += 1
    before = counts[""]
    before["retargeted"] = before["clips"] - sum(n for key, n in before.items() if key not in ("clips", "truncated"))
    for robot in robots:
        counts[robot]["kept"] = before["retargeted"] - sum(counts[robot].values())
    return counts


def manifest_table(manifest: Manifest) -> Table:
    """The table of `shard_counts`."""
    counts = shard_counts(manifest)
    before, robots = counts[""], [name for name in counts if name]
    table = _table("clips", *robots)
    _add(table, "in the list", before["clips"])
    for name in ("unusable", *sorted(key for key in before if key.startswith("PHC list")), "automatic rule"):
        _add(table, f"dropped: {name}", before[name])
    _add(table, "retargeted", before["retargeted"])
    _add(table, "of these truncated by PHC's list", before["truncated"])
    for name in (*GATES, "low_pelvis"):
        if any(counts[robot][name] for robot in robots):
            _add(table, f"dropped by gate: {name}", "", *(counts[robot][name] for robot in robots))
    _add(table, "kept", "", *(counts[robot]["kept"] for robot in robots))
    if not manifest.complete:
        table.caption = f"unfinished: {len(manifest.parts)} parts so far"
    return table


def _list_table(ids: Sequence[str]) -> Table:
    plain, mirrored = (list_counts(n for n in ids if n.startswith("M") == is_mirrored) for is_mirrored in (False, True))
    table = _table("clips", "mirrored")
    _add(table, "in the lists", plain["clips"], mirrored["clips"])
    for name in sorted(key for key in plain | mirrored if key.startswith("PHC list")):
        _add(table, f"dropped: {name}", plain[name], mirrored[name])
    for label, name in (("kept", "kept"), ("of these truncated", "truncated"), ("of these whole", "whole")):
        _add(table, label, plain[name], mirrored[name])
    return table


def _table(*columns: str) -> Table:
    table = Table()
    table.add_column("", no_wrap=True)
    for name in columns:
        table.add_column(name, justify="right")
    return table


def _add(table: Table, name: str, *values: int | str) -> None:
    table.add_row(name, *(f"{value:,}" if isinstance(value, int) else value for value in values))


def main(arguments: Sequence[str]) -> int:
    """Command line; 0 on success, 1 when the folder holds neither, 2 on wrong arguments."""
    if shows_help(arguments, __doc__):
        return 0
    if len(arguments) != 1:
        sys.stderr.write(_USAGE)
        return 2
    folder = Path(arguments[0]).expanduser()
    try:
        if (folder / "manifest.json").is_file():
            table = manifest_table(Manifest.load(folder))
        else:
            table = _list_table([name for name, _ in list_clips(folder)])
    except (DatasetError, ShardError) as error:
        sys.stderr.write(f"{error}\n")
        return 1
    Console().print(table)
    return 0
