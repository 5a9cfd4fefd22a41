"""What README.md and docs/benchmark.md say of runs is what the runs' own files say."""

from __future__ import annotations

import csv
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from data.files import read_json
from proprio_mllm.evaluation.run import weights_digest
from proprio_mllm.report.paper import paper_ablation
from proprio_mllm.report.statistics import trained_interval, wilson
from sim.scene.compiler import PHYSICS
from tools.publish import FOLDER, results

ROOT = Path(__file__).parents[2]
RESULTS = results()
BIT, SELU, ORACLE, BEFORE, BLIND = (results(name) for name in ("bit", "selu", "selu_oracle", "before", "blind"))
#: By seed.
ABLATIONS = [results(f"ablations/{seed}") for seed in range(3)]
LONGER = results("ablations/240_steps")
#: Planners of the published table, by the name of their row.
PLANNERS = {
    "random legal actions": "random",
    "Proprio-MLLM": "proprio",
    "language model, words alone": "words",
    "scripted rules": "scripted",
    "expert (privileged)": "expert",
}
NAMES = ("docs/benchmark.md", "docs/learnt.md", "README.md")
BENCHMARK, LEARNT, README = ((ROOT / name).read_text(encoding="utf-8") for name in NAMES)


def percent(share: float) -> str:
    """Whole, unless that would say all of what is not."""
    return f"{share:.1%}".replace("%", " %") if 0.995 <= share < 1.0 else f"{share:.0%}".replace("%", " %")


def counted(row: dict[str, Any], key: str, rate: str) -> str:
    low, high = (f"{100 * row[name]:.0f}" for name in (f"{rate}low", f"{rate}high"))
    return f"{row[key]}/{row['episodes']} = {percent(row[key] / row['episodes'])} [{low}, {high}]"


def counts(result: dict[str, Any], category: str) -> str:
    """Solved, in time, first tries."""
    row = result["rows"][category]
    return f"{row['successes']} | {row['in_time']} | {percent(row['first_try_rate'])}"


def planner_row(label: str, result: dict[str, Any]) -> str:
    """A row of the table of planners."""
    row, rows = result["rows"]["all"], result["rows"]
    cells = [label, result["robot"].upper(), counted(row, "successes", ""), counted(row, "in_time", "in_time_")]
    for category in ("single", "optional", "essential"):
        one = rows[category]
        cells += [f"{one['successes']}/{one['episodes']}", str(one["in_time"])]
    cells += [
        f"{row['navigation']} / {row['body_adjustment']} / {row['logical']}",
        f"{row['budget_exhausted']} / {row['stuck']}",
    ]
    return f"| {' | '.join(cells)} |"


@pytest.mark.parametrize("label", PLANNERS)
@pytest.mark.parametrize("robot", ["h1", "x1"])
def test_the_table_of_planners(label: str, robot: str) -> None:
    assert planner_row(label, RESULTS[f"{PLANNERS[label]}-{robot}-easy"]) in BENCHMARK.splitlines()


def test_no_other_planner_is_in_the_table() -> None:
    found = re.findall(r"^\| ([^|]+?) \| (?:H1|X1) \| \d+/359 =", BENCHMARK, re.MULTILINE)
    assert len(found) == 2 * len(PLANNERS)


@pytest.mark.parametrize("planner", ["proprio", "words", "scripted", "expert"])
def test_the_table_of_the_readme(planner: str) -> None:
    shares = [percent(RESULTS[f"{planner}-{robot}-easy"]["rows"]["all"]["success_rate"]) for robot in ("h1", "x1")]
    label = {"proprio": "Proprio-MLLM (", "words": "language model alone (", "scripted": "scripted rules", "expert": "expert"}[
        planner
    ]
    (row,) = (line for line in README.splitlines() if line.startswith(f"| {label}"))
    assert row.endswith(f" | {shares[0]} | {shares[1]} |")


#: Planners of the ablations, by the variant that they run.
VARIANTS = {
    "full": "proprio",
    "no_mpe": "proprio_no_mpe",
    "no_cse": "proprio_no_cse",
    "no_mpe_cse": "proprio_no_mpe_cse",
    "no_proprio": "no_proprio",
}


def trainings(variant: str) -> list[dict[str, Any]]:
    """A variant's published runs, one per seed."""
    return [one[f"{VARIANTS[variant]}-h1-easy-essential"] for one in ABLATIONS]


def differences(name: str) -> list[dict[str, str]]:
    """Figures of all categories together, one training kind minus another."""
    with (FOLDER / "ablations" / f"{name}.csv").open(encoding="utf-8", newline="") as file:
        return [row for row in csv.DictReader(file) if row["category"] == "all"]


def ablation_cells(variant: str) -> list[list[str]]:
    """Of the variant's row in the table of counts and, but for the full model, in the table of differences."""
    lines = [line for line in BENCHMARK.splitlines() if line.startswith(f"| `{variant}` | ")]
    return [[cell.strip() for cell in line.split("|")[2:-1]] for line in lines]


@pytest.mark.parametrize("variant", VARIANTS)
def test_the_ablations_counts(variant: str) -> None:
    rows = [run["rows"]["all"] for run in trainings(variant)]
    told = [", ".join(str(row[key]) for row in rows) for key in ("successes", "in_time")]
    told.append(", ".join(f"{100 * row['first_try_rate']:.1f}" for row in rows))
    told.append(" / ".join(str(sum(row[key] for row in rows)) for key in ("navigation", "body_adjustment", "logical")))
    assert ablation_cells(variant)[0] == told
    assert len({run["weights_digest"] for run in trainings(variant)}) == len(rows)


def test_what_motion_tokens_bring() -> None:
    _, in_time, first_tries, *_ = (f"{row['difference']} {row['95 % interval']}" for row in differences("motion_tokens"))
    assert f" is {in_time} in time, {first_tries} of first tries." in BENCHMARK


def test_the_ablation_that_trained_longer() -> None:
    row = LONGER["no_proprio-h1-easy-essential"]["rows"]["all"]
    told = f"solves {row['successes']}, {row['in_time']} in time, with {100 * row['first_try_rate']:.1f} % of first tries"
    assert told in BENCHMARK


@pytest.mark.parametrize("variant", [name for name in VARIANTS if name != "full"])
def test_the_ablations_differences(variant: str) -> None:
    compared = differences(VARIANTS[variant])
    cells = ablation_cells(variant)[1]
    assert cells[:-1] == [f"{row['difference']} {row['95 % interval']}" for row in compared]
    for key, row in zip(("solved", "in_time"), compared, strict=False):
        sides = [np.array([[(float(digit), 1.0) for digit in run[key]] for run in trainings(one)]) for one in ("full", variant)]
        told = [float(number) for number in re.findall(r"[-+\d.]+", f"{row['difference']} {row['95 % interval']}")]
        assert told == pytest.approx([100 * value for value in trained_interval(*sides)], abs=0.5)  # tasks in another order
    paper = paper_ablation()
    without = {"no_mpe": "without MPE", "no_cse": "without CSE", "no_mpe_cse": "without both"}.get(variant)
    lost = without and paper["Proprio-MLLM"]["success_percent"] - paper[without]["success_percent"]
    assert cells[-1] == (f"{lost:+.1f}" if lost else "")


def test_the_table_of_replanning() -> None:
    for reflection, label in (("", "with reflection"), ("-no_reflection", "without")):
        lines = [
            next(one for one in BENCHMARK.splitlines() if one.startswith(f"| {label}{end} |")) for end in ("", ": in time")
        ]
        told = zip(*(line.split("|")[2:-1] for line in lines), ("easy", "medium", "hard"), strict=True)
        for cell, in_time, difficulty in told:
            name = f"proprio-h1-{difficulty}-essential{reflection}"
            row = RESULTS[name if name in RESULTS else "proprio-h1-easy"]["rows"]["essential"]
            low, high = 100 * row["low"], 100 * row["high"]
            assert cell.strip() == f"{row['successes']} = {100 * row['success_rate']:.1f} % [{low:.1f}, {high:.1f}]"
            assert in_time.strip() == str(row["in_time"])


@pytest.mark.parametrize("planner", ["proprio", "blind", "base", "words", "scripted"])
def test_the_table_of_one_bit(planner: str) -> None:
    name = "proprio" if planner == "blind" else planner
    hidden, others = ("-blind_both", BLIND) if planner == "blind" else ("", RESULTS)
    codes = next(others[one] for end in ("", "-essential") if (one := f"{name}-h1-easy{end}{hidden}") in others)
    rows = [run["rows"]["essential"] for run in (codes, BIT[f"{name}-h1-easy-essential{hidden}-bit"])]
    cells = [
        cell
        for row in rows
        for cell in (
            f"{row['successes']} = {percent(row['success_rate'])}",
            str(row["in_time"]),
            percent(row["first_try_rate"]),
        )
    ]
    labels = {name: label for label, name in PLANNERS.items()}
    labels |= {"base": "base model (before stage `alignment`)", "blind": "Proprio-MLLM, picture and motion hidden"}
    assert f"| {labels[planner]} | {' | '.join(cells)} |" in BENCHMARK.splitlines()


def test_the_table_of_its_own_body() -> None:
    scores = read_json(ROOT / "docs" / "results" / "bodyqa" / "full.json")["scores"]
    assert len(scores) == 8
    for kind, one in scores.items():
        low, high = (100 * limit for limit in wilson(one["right"], one["asked"]))
        right, commonest, blind = (100 * one[name] / one["asked"] for name in ("right", "commonest", "blind"))
        row = f"| {kind} | {one['asked']} | {right:.1f} [{low:.1f}, {high:.1f}] | {commonest:.1f} | {blind:.1f} |"
        assert row in BENCHMARK.splitlines()


@pytest.mark.parametrize("robot", ["h1", "x1"])
def test_the_table_of_learning_from_itself(robot: str) -> None:
    whole, name = f"proprio-{robot}-easy", f"proprio-{robot}-easy-essential"
    runs = {"release before": BEFORE[whole], "after one round": ORACLE[name]}
    runs |= {"release": RESULTS[whole], "after 600 episodes": SELU[name]}
    for label, run in runs.items():
        assert f"| {label}, {robot.upper()} | {counts(run, 'essential')} |" in LEARNT.splitlines()


@pytest.mark.parametrize("robot", ["h1", "x1"])
def test_the_table_of_training_further(robot: str) -> None:
    name = f"proprio-{robot}-easy"
    for label, run in (("release before", BEFORE[name]), ("trained further", RESULTS[name])):
        assert f"| {label}, {robot.upper()} | {counts(run, 'all')} |" in LEARNT.splitlines()
    assert RESULTS[name]["weights_digest"] == weights_digest(ROOT / "weights/tiny/full"), "of the weights that are stored"


@pytest.mark.parametrize("robot", ["h1", "x1"])
def test_what_seeing_and_feeling_bring(robot: str) -> None:
    runs = [some[name] for some, name in ((RESULTS, f"proprio-{robot}-easy"), (BLIND, f"proprio-{robot}-easy-blind_both"))]
    assert len({run["weights_digest"] for run in runs}) == 1
    seeing, blind = (run["rows"]["all"] for run in runs)
    column = 2 if robot == "h1" else 3
    for label, key in (("success", "successes"), ("in time", "in_time")):
        (line,) = (line for line in LEARNT.splitlines() if line.startswith(f"| {label} | ") and "p" in line)
        cell = line.split("|")[column]
        assert f"({seeing[key]} and {blind[key]})" in cell
        assert f"{100 * (seeing[key] - blind[key]) / seeing['episodes']:+.1f} [" in cell
    (line,) = (line for line in LEARNT.splitlines() if line.startswith("| first tries in reach | "))
    shares = [100 * row["first_try_rate"] for row in (seeing, blind)]
    assert f"({shares[0]:.1f} and {shares[1]:.1f} %)" in line.split("|")[column]


def test_files_name_no_machine() -> None:
    folders = {"": RESULTS, "bit/": BIT, "selu/": SELU, "selu_oracle/": ORACLE, "before/": BEFORE, "blind/": BLIND}
    folders |= {f"ablations/{seed}/": one for seed, one in enumerate(ABLATIONS)} | {"ablations/240_steps/": LONGER}
    files = {f"{folder}{name}": one for folder, some in folders.items() for name, one in some.items()}
    for name, result in files.items():
        assert re.fullmatch(r"python eval\.py( [\w.]+=[\w,.-]+)+", result["command"]), name
        assert len(result["solved"]) == len(result["in_time"]) == result["rows"]["all"]["episodes"]
        assert result["solved"].count("1") == result["rows"]["all"]["successes"]
        assert result["physics"] == PHYSICS
