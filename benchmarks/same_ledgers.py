"""Compares two ledgers step by step: `python benchmarks/same_ledgers.py OLD NEW` (folders of runs, or folders of such folders).

A change that must keep behaviour is judged by this: episodes of the same planner, robot, task and trial have to agree in every
outcome, action, failure code, margin and duration. Clock times, hashes of the configuration and message texts are left out.
Episodes that only one side has are counted, not compared. Exit code 1 when an episode differs or none is shared.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

#: What a second run of the same code may change.
CLOCK = ("planner_s", "wall_s", "config_hash", "version", "message", "cached_calls")


def episodes(folder: Path) -> dict[tuple[Any, ...], dict[str, Any]]:
    """Records of all ledgers below a folder by planner, robot, difficulty, task and trial."""
    found: dict[tuple[Any, ...], dict[str, Any]] = {}
    for path in sorted(folder.rglob("ledger.jsonl")):
        for line in path.read_text(encoding="utf-8").splitlines():
            record = json.loads(line)
            key = tuple(record[name] for name in ("planner", "robot", "difficulty", "task", "trial"))
            found[key] = {name: value for name, value in record.items() if name not in CLOCK}
    return found


def first_difference(old: dict[str, Any], new: dict[str, Any]) -> str:
    """Where two records part, in one line; empty when they agree."""
    for number, (a, b) in enumerate(zip(old["trace"], new["trace"], strict=False)):
        if a != b:
            return f"step {number}: {json.dumps(a)[:300]} | {json.dumps(b)[:300]}"
    for name in old.keys() | new.keys():
        if old.get(name) != new.get(name):
            return f"{name}: {str(old.get(name))[:120]} | {str(new.get(name))[:120]}"
    return ""


def main() -> int:
    """Prints differing episodes and a count per planner and robot."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("old", type=Path)
    parser.add_argument("new", type=Path)
    options = parser.parse_args()
    old, new = episodes(options.old), episodes(options.new)
    shared = [key for key in old if key in new]
    counts: dict[tuple[str, str], list[int]] = {}
    for key in shared:
        difference = first_difference(old[key], new[key])
        count = counts.setdefault((key[0], key[1]), [0, 0])
        count[0] += 1
        if difference:
            count[1] += 1
            print(*key, difference)
    for (planner, robot), (total, differing) in sorted(counts.items()):
        print(f"{planner} {robot}: {total} episodes compared, {differing} differ")
    print(f"only in old: {len(old.keys() - new.keys())}, only in new: {len(new.keys() - old.keys())}")
    return int(not shared or any(differing for _, differing in counts.values()))


if __name__ == "__main__":
    sys.exit(main())
