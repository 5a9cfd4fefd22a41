"""Runs of several trainings side by side."""

from __future__ import annotations

import dataclasses

import pytest

from interface.failures import FailureCategory
from proprio_mllm.report.commands import main
from proprio_mllm.report.stored import Run, load_run
from proprio_mllm.report.trainings import compare_trainings

#: Too far from one thing, then near enough; and near enough to another at once.
TRACE = [
    {"outcomes": [{"action": "Lift(Box_1)", "ok": False, "code": "TooFar", "contingency": ""}]},
    {"outcomes": [{"action": "Lift(Box_1)", "ok": True, "code": "", "contingency": ""}]},
    {"outcomes": [{"action": "Lift(Box_2)", "ok": True, "code": "", "contingency": ""}]},
]


@pytest.fixture
def trained(tmp_path, store, record):
    """A run of one training that solves so many of ten tasks; every third is single."""

    def make(planner: str, training: int, solved: int, **change) -> Run:
        rows = [
            record(
                f"t{i}", "single" if i % 3 == 0 else "essential", i < solved, planner=planner, trace=tuple(TRACE[i % 2 :]),
                failure=None if i < solved else FailureCategory.BODY_ADJUSTMENT,
            )
            for i in range(10)
        ]  # fmt: skip
        folder = tmp_path / f"{planner}-{training}"
        return load_run(store(folder, rows, weights_digest=f"{planner}{training}", **change))

    return make


def test_shares_of_every_training_and_the_difference(trained) -> None:
    table = compare_trainings([trained("full", i, n) for i, n in enumerate((8, 6))], [trained("less", i, 5) for i in (0, 1, 2)])
    rows = {row[:2]: row[2:] for row in table.rows}
    assert list(dict.fromkeys(row[0] for row in table.rows)) == ["single", "essential", "all"]
    assert rows["all", "success"][:4] == ("10", "80.0 60.0", "50.0 50.0 50.0", "+20.0")
    low, high = map(float, rows["all", "success"][4].strip("[]").split(","))
    assert low < 20 < high
    assert rows["all", "failed by body adjustment"][3] == "-20.0"
    assert rows["all", "failed by logical"][3:] == ("+0.0", "[+0.0, +0.0]")
    assert rows["single", "success"][0] == "4"
    assert rows["all", "first tries in reach"][1] == "75.0 75.0"  # of two tries each, every second episode misses one
    assert "2 and 3 trainings" in table.notes[0]


def test_what_is_not_several_trainings_is_refused(trained) -> None:
    one, other = trained("full", 0, 8), trained("less", 0, 5)
    with pytest.raises(ValueError, match="are of the same weights"):
        compare_trainings([one, dataclasses.replace(one)], [other])
    with pytest.raises(ValueError, match="seed: 0 and 3"):
        compare_trainings([one], [trained("less", 1, 5, seed=3)])
    with pytest.raises(ValueError, match="no scored task in common"):
        compare_trainings([one], [dataclasses.replace(other, records=())])


def test_command_line(trained, tmp_path, capsys) -> None:
    full, less = (",".join(str(trained(name, i, n).folder) for i in (0, 1)) for name, n in (("full", 8), ("less", 5)))
    out = tmp_path / "table.md"
    assert main(["compare", full, less, f"out={out}"]) == 0
    assert out.read_text().startswith("**Full against Less (h1)**")
    assert "+30.0" in capsys.readouterr().out
    assert main(["compare", full, less, "json=true"]) == 2
    assert "JSON is of two runs" in capsys.readouterr().err
    assert main(["gap", full, less]) == 2
    assert "gap takes one run a side" in capsys.readouterr().err
