"""docs/simulator.md lists every action and every failure code of the contract."""

from __future__ import annotations

from pathlib import Path

import pytest

from data.interface.actions import ACTIONS
from data.interface.failures import FAILURES

PAGE = (Path(__file__).parents[1] / "docs" / "simulator.md").read_text(encoding="utf-8")


@pytest.mark.parametrize("name", [*ACTIONS, *FAILURES])
def test_it_is_listed(name: str) -> None:
    rows = [line for line in PAGE.splitlines() if line.startswith("|")]
    assert any(f"`{name}`" in row or f"`{name}(" in row for row in rows), name
