"""Commands over motion data: `python -m data filter …` (what was dropped) and `python -m data retarget …` (its quality)."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from typing import Final

from configs.validate import allowed_values
from data import filter_table, retarget_report

__all__ = ["main"]

COMMANDS: Final[Mapping[str, Callable[[Sequence[str]], int]]] = {
    "filter": filter_table.main,
    "retarget": retarget_report.main,
}


def main(arguments: Sequence[str]) -> int:
    """Command line; the command's exit code, 2 without one that exists."""
    name, *rest = arguments or [""]
    if name in COMMANDS:
        return COMMANDS[name](rest)
    sys.stderr.write(
        f"{__doc__}\n"
        if not name or name in ("-h", "--help")
        else f"python -m data: {name!r}; {allowed_values(name, COMMANDS)}\n"
    )
    return 0 if name in ("-h", "--help") else 2


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
