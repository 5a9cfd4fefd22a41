"""Keeps what docs/benchmark.md says of runs, as files beside it: `python -m tools.publish RUN [RUN …] [below=FOLDER]`.

`docs/results/NAME.json` holds a run's command, physics, weights and rows, and task by task whether it was solved and in time; a
folder below it, those of an older physics, another feedback or another training. Tests hold the figures of README.md
and docs/benchmark.md against these files, and `make reproduce` holds a rerun against them.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from configs.arguments import command, read_named
from data.files import read_json, write_text
from interface.episode import Outcome
from proprio_mllm.report.references import references_of
from proprio_mllm.report.stored import Run, load_run

FOLDER: Final = Path(__file__).parents[1] / "docs" / "results"
#: Options that say where a run was made, and not what it is.
_LOCAL: Final = ("output=", "workers=", "planner.weights=")


def published(run: Run) -> dict[str, Any]:
    """What is kept of a run.

    Raises:
        ValueError: when it is not finished.
    """
    if not run.complete:
        raise ValueError(
            f"{run.folder}: {len(run.records)} of {len(run.metadata['planned'])} episodes; a whole run is published"
        )
    meta = run.metadata
    return {
        **{name: meta[name] for name in ("planner", "label", "robot", "difficulty", "category")},
        "reflection": meta.get("reflection", "on"),
        "command": " ".join(word for word in meta["command"].split() if not word.startswith(_LOCAL)),
        **{name: meta.get(name) for name in ("weights_digest", "steps", "physics", "commit", "processor")},
        "solved": "".join(str(int(record.outcome is Outcome.SUCCESS)) for record in run.records),
        "in_time": "".join(str(int(record.in_time)) for record in run.records),
        "rows": {row.category: row.to_json() for row in run.rows(references_of(run))},
    }


def results(folder: str = ".") -> dict[str, dict[str, Any]]:
    """All that is published in a folder below `docs/results`, by name."""
    return {path.stem: read_json(path) for path in sorted((FOLDER / folder).glob("*.json"))}


@dataclass(frozen=True)
class Options:
    """Command line.

    Attributes:
        below: folder below `docs/results`.
    """

    below: str = "."


@command(ValueError, OSError)
def main(arguments: Sequence[str]) -> int:
    """Publishes runs under their folders' names without the hash."""
    folders, options = read_named(Options, arguments, ("RUN",), more=True)
    for folder in map(Path, folders):
        target = FOLDER / options.below / f"{folder.resolve().name.rpartition('-')[0]}.json"
        target.parent.mkdir(parents=True, exist_ok=True)
        write_text(target, json.dumps(published(load_run(folder)), indent=1) + "\n")
        sys.stdout.write(f"{target}\n")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
