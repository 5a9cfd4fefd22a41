"""Failure codes and robots are named in `interface` and the configurations; elsewhere nobody spells them."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

from interface.bodies import PAPER_ROBOTS
from interface.failures import INVALID_OUTPUT, FailureCode

ROOT = Path(__file__).parents[2]
#: AI2-THOR's own error code of this name.
ALLOWED = {("sim/interfaces/controller.py", "ReceptacleFull")}
#: Words that are codes and something else, too.
ORDINARY = {"Empty"}


def strings(path: Path) -> Iterator[str]:
    """String constants of a module."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            yield node.value


def test_codes_and_robots_are_spelled_once() -> None:
    names = {code.value for code in FailureCode} - ORDINARY | {INVALID_OUTPUT, *PAPER_ROBOTS}
    found = set()
    for package in ("interface", "robots", "data", "sim", "proprio_mllm"):
        for path in (ROOT / package).rglob("*.py"):
            place = str(path.relative_to(ROOT))
            if not place.startswith("interface/"):
                found |= {(place, text) for text in strings(path) if text in names}
    assert found <= ALLOWED, sorted(found - ALLOWED)
