"""Figures: what bars say, and that every label can be read however many there are."""

from __future__ import annotations

import dataclasses
import itertools
from pathlib import Path

import pytest
from matplotlib.figure import Figure

from configs.schema.eval import ExperimentConfig
from interface.episode import EpisodeRecord, Outcome
from interface.failures import FailureCategory
from proprio_mllm.report import figures
from proprio_mllm.report.figures import failure_figure, plot_failures, task_distribution
from proprio_mllm.report.summary import Row, rows_of
from sim.scene.catalogue import load_catalogue
from sim.tasks.predicates import Predicate
from sim.tasks.task import Placement, Task, load_benchmark


def _tasks(types: int, families: int, count: int) -> list[Task]:
    """A benchmark of any size: tasks with the given numbers of object types and of single-arm families."""
    names = [f"{kind.name}" for kind in load_catalogue().types.values()]
    names = (names + [f"LongishTypeName{number}" for number in range(types)])[:types]
    base = load_benchmark()[0]
    tasks = []
    for number in range(count):
        kind, other = names[number % types], names[(7 * number + 3) % types]
        tasks.append(
            dataclasses.replace(
                base,
                id=f"t{number}",
                family=f"some_longish_family_{number % families}",
                category=("single", "single", "optional", "essential")[number % 4] if number >= families else "single",
                placements=tuple(Placement(f"{name}_1", name, "Desk_1") for name in {kind, other}),
                goals=(Predicate("held", f"{kind}_1"),),
            )
        )
    return tasks


def _drawn(monkeypatch: pytest.MonkeyPatch) -> list[Figure]:
    """Figures that are saved from now on."""
    saved: list[Figure] = []
    save = figures.save_figure
    monkeypatch.setattr(
        figures, "save_figure", lambda figure, path, source: (saved.append(figure), save(figure, path, source))[1]
    )
    return saved


@pytest.mark.parametrize(("types", "families", "count"), [(68, 40, 359), (26, 6, 36), (1, 1, 4)])
def test_no_label_of_the_distributions_overlaps_another(tmp_path, monkeypatch, types, families, count) -> None:
    saved = _drawn(monkeypatch)
    path = task_distribution(_tasks(types, families, count), tmp_path / "d.png")
    assert path.stat().st_size > 5000
    (figure,) = saved
    renderer = figure.canvas.get_renderer()  # type: ignore[attr-defined]
    boxes = [
        label.get_window_extent(renderer)
        for axes in figure.axes
        for label in [*axes.get_yticklabels(), *axes.texts, axes.title]
        if label.get_text()
    ]
    assert len(boxes) >= 2 * (types + families)
    for first, second in itertools.combinations(boxes, 2):
        assert not first.overlaps(second)
    width, height = figure.canvas.get_width_height()
    assert all(box.x0 >= 0 and box.y0 >= 0 and box.x1 <= width and box.y1 <= height for box in boxes)


def _row(kinds: list[FailureCategory | None]) -> Row:
    """A row of episodes that failed by type, or succeeded."""
    records: list[EpisodeRecord] = []
    for number, kind in enumerate(kinds):
        won = EpisodeRecord(
            "p", "h1", f"t{number}", "single", "easy", 0, 0, "x", Outcome.SUCCESS, None, 0, False, 1, 1, 1, 1, 0, 1, 0, 0, 1
        )
        records.append(won if kind is None else dataclasses.replace(won, outcome=Outcome.FAILURE, failure=kind))
    return next(row for row in rows_of(records, ["single"], None) if row.category == "all")


def test_failure_bars_carry_their_numbers() -> None:
    navigation, body, logical = FailureCategory
    rows = [("one", _row([navigation, navigation, body, logical, None])), ("two", _row([None, None]))]
    axes = Figure().subplots()
    plot_failures(axes, rows)
    heights = [[round(bar.get_height()) for bar in bars] for bars in axes.containers]
    assert heights == [[40, 0], [20, 0], [20, 0]]
    said = [text.get_text() for text in axes.texts if text.get_text()]
    assert sorted(said) == ["0/2", "1", "1", "2", "4/5"]


def test_a_figure_says_which_runs_it_shows(tmp_path: Path, monkeypatch, run) -> None:
    from proprio_mllm.report.stored import find_runs

    saved = _drawn(monkeypatch)
    run(tmp_path)
    runs = find_runs(tmp_path)
    cfg = ExperimentConfig("failure_figure", (runs[0].metadata["planner"], "expert"))
    failure_figure(cfg, runs, tmp_path)
    failure_figure(cfg, (), tmp_path)
    assert runs[0].folder.name in saved[0].get_supxlabel().replace("\n", "").replace(" ", "")
    assert "No run" in saved[1].get_supxlabel()
