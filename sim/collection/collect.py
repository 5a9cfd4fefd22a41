"""Collects training shards: posed views and demonstrations of the expert from the simulator.

    python -m sim collect kind=views out=outputs/views count=4800 workers=2
    python -m sim collect kind=demos out=outputs/demos count=600 workers=2

A part file is a function of the configuration and its index only, so runs may be interrupted, resumed and spread over processes
without changing a byte. Paper: the planning demonstrations and views that the open stages train on; the paper starts from
pretrained weights instead.
"""

from __future__ import annotations

import dataclasses
import logging
import sys
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from configs.arguments import command, read_arguments
from configs.schema.collect import CollectConfig
from data.shards import Manifest, ShardWriter, config_hash
from data.workers import computed

_LOG = logging.getLogger(__name__)

#: Raised when the meaning of a configuration changes, so that old shards are not continued.
_VERSION = {"views": 4, "demos": 3}
#: Fields that do not change what is written.
_UNKEYED = {
    "views": ("out", "workers", "noise", "chance_share", "foreseen"),
    "demos": ("out", "workers", "views_per_world", "foreseen"),
}


def parts_of(config: CollectConfig) -> int:
    """Number of part files of a configuration."""
    return -(-config.count // config.part_size)


def rows_of_part(config: CollectConfig, part: int) -> list[dict[str, Any]]:
    """Computes one part; imports the simulator only here, so that workers start light."""
    if config.kind == "views":
        from sim.collection.view_sampling import views_of_part

        return list(views_of_part(config, part))
    from sim.collection.demonstrations import demos_of_part

    return list(demos_of_part(config, part))


def collect(config: CollectConfig, progress: Callable[[int, int], None] | None = None, overwrite: bool = False) -> Manifest:
    """Writes a shard folder, continuing one that was interrupted.

    Args:
        config: what to collect.
        progress: called with (parts done, parts in all).
        overwrite: start over when the folder holds shards of another configuration.

    Raises:
        data.shards.ShardError: when the folder holds something else and `overwrite` is off.
    """
    keyed = {k: v for k, v in dataclasses.asdict(config).items() if k not in _UNKEYED[config.kind]} | {
        "version": _VERSION[config.kind]
    }
    writer = ShardWriter(Path(config.out), config.kind, config_hash(keyed), overwrite)
    total = parts_of(config)
    missing = writer.missing(total)
    done = total - len(missing)
    report = progress or (lambda finished, parts: _LOG.info("%s: %d of %d parts", config.out, finished, parts))
    report(done, total)
    for part, rows in computed({part: partial(rows_of_part, config, part) for part in missing}, config.workers):
        writer.write(part, rows)
        done += 1
        report(done, total)
    return writer.finish({"config": keyed, **_metadata(config)})


def _metadata(config: CollectConfig) -> dict[str, Any]:
    if config.kind != "views":
        return {}
    from sim.collection.view_sampling import type_names

    return {"type_names": list(type_names())}


def _with_bar(run: Callable[[Callable[[int, int], None]], Manifest], title: str) -> Manifest:
    columns = (
        TextColumn(title),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("parts"),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )
    with Progress(*columns) as bar:
        task = bar.add_task(title)
        return run(lambda done, total: bar.update(task, completed=done, total=total))


@command()
def main(arguments: Sequence[str]) -> int:
    """Command line; returns the exit code."""
    config = read_arguments(CollectConfig, arguments)
    manifest = _with_bar(lambda report: collect(config, report), config.kind)
    facts: Mapping[str, Any] = {"rows": manifest.rows, "parts": len(manifest.parts), "config_hash": manifest.config_hash}
    sys.stdout.write(f"{config.out}: {facts}\n")
    return 0
