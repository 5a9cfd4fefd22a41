"""Bugs that are put in: each changes one place, and the tests of a module notice a bug that matters."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

from benchmarks import mutants

SOURCE = '''
def inside(x: int = 3, *, closed: bool = True) -> float:
    """Says 3."""
    if not x or (x < 2 and x is not None):
        raise ValueError(f"got {x + 1}")
    return 0.5 * x if closed else x - 1
'''


def test_every_place_gives_one_other_module() -> None:
    places = list(mutants.places(ast.parse(SOURCE)))
    made = [mutants.with_bug(SOURCE, number) for number in range(len(places))]
    assert len({source for source, _, _ in made}) == len(places) == 13
    told = {bug for _, _, bug in made}
    assert {"x < 2 -> x <= 2", "not x -> x", "3 -> 4", "True -> False", "x - 1 -> x + 1", "0.5 * x -> 0.5 / x"} <= told
    assert not any("x + 1" in bug.split(" -> ")[0] for bug in told), "a message is no result"
    for source, line, _ in made:
        ast.parse(source)
        assert 2 <= line <= 6


@pytest.mark.parametrize("module", mutants.MODULES)
def test_every_module_and_its_tests_exist(module: str) -> None:
    source = (mutants.ROOT / module).read_text(encoding="utf-8")
    assert list(mutants.places(ast.parse(source)))
    assert all((mutants.ROOT / path).exists() for path in mutants.MODULES[module].split())


def test_a_bug_is_noticed_and_taken_out_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "one.py").write_text("LIMIT = 1\n")
    (tmp_path / "test_one.py").write_text("from one import LIMIT\n\n\ndef test_limit():\n    assert LIMIT > 0\n")
    monkeypatch.setitem(mutants.MODULES, "one.py", "test_one.py")
    assert mutants.noticed(tmp_path, "one.py", "LIMIT = 0\n")
    assert not mutants.noticed(tmp_path, "one.py", "LIMIT = 2\n")
    assert (tmp_path / "one.py").read_text() == "LIMIT = 1\n"
