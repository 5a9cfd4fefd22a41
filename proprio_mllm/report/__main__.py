"""Reports on runs that exist.

compare: two planners on the same body, tasks and luck. gap: one planner on two bodies. write: writes a run's `summary.json`
and tables again, for example after the run at `difficulty=easy` that its regret needs.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from rich.console import Console

from data.files import write_text
from proprio_mllm.report.comparison import RunComparison, compare_bodies, compare_runs, comparison_table
from proprio_mllm.report.runs import Run, load_run, write_report
from proprio_mllm.report.table import Table

__all__ = ["main"]

_PAIRED: Final[Mapping[str, Callable[[Run, Run], RunComparison]]] = {"compare": compare_runs, "gap": compare_bodies}
_FORMATS: Final[Mapping[str, Callable[[Table], str]]] = {
    ".md": Table.to_markdown,
    ".csv": Table.to_csv,
    ".tex": Table.to_latex,
}


def _text(result: RunComparison, suffix: str) -> str:
    if suffix == ".json":
        return json.dumps(result.to_json(), indent=1, ensure_ascii=False) + "\n"
    return _FORMATS[suffix](comparison_table(result))


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m proprio_mllm.report", description=__doc__)
    commands = parser.add_subparsers(dest="command", required=True)
    for name in _PAIRED:
        own = commands.add_parser(name)
        own.add_argument("a", type=Path, metavar="RUN_A", help="folder of a run")
        own.add_argument("b", type=Path, metavar="RUN_B", help="folder of the run that it is compared with")
        own.add_argument("--json", action="store_true", help="print one JSON object, with every pair of episodes")
        own.add_argument("--out", type=Path, help=f"write to a file: {', '.join((*_FORMATS, '.json'))}")
    commands.add_parser("write").add_argument("run", type=Path, metavar="RUN", help="folder of a run")
    return parser


def _paired(wanted: argparse.Namespace) -> None:
    out: Path | None = wanted.out
    if out is not None and out.suffix not in (*_FORMATS, ".json"):
        raise ValueError(f"--out {out}: the ending {out.suffix!r} is not allowed; allowed: {', '.join((*_FORMATS, '.json'))}")
    result = _PAIRED[wanted.command](load_run(wanted.a), load_run(wanted.b))
    if out is not None:
        out.parent.mkdir(parents=True, exist_ok=True)
        write_text(out, _text(result, out.suffix))
    if wanted.json:
        sys.stdout.write(_text(result, ".json"))
    else:
        comparison_table(result).show()


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; 0 on success, 2 on wrong arguments or runs that cannot be compared."""
    wanted: Any = _parser().parse_args(arguments)
    try:
        if wanted.command == "write":
            write_report(load_run(wanted.run)).show()
        else:
            _paired(wanted)
    except ValueError as error:
        Console(stderr=True, highlight=False).print(f"report: {error}", style="red", markup=False, soft_wrap=True)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
