"""Two runs side by side: on the same tasks and contingencies, or one planner on two bodies.

A pair is an episode (task, trial) that both runs have scored. Values of a task's trials are averaged, tasks are the sample:
the difference is the mean over tasks, its interval a cluster bootstrap over tasks, and the p-value an exact sign test over the
tasks on which the two differ, which with one trial and success is McNemar's exact test. Runs that did not meet the same tasks
and contingencies are refused. Two bodies do not share their contingencies, since the robot is part of an episode's seed: there
tasks are paired, draws are not.

Paper: gives no paired comparison.
"""

from __future__ import annotations

import dataclasses
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

from interface.episode import EpisodeRecord, Outcome
from proprio_mllm.report.statistics import Comparison, compare
from proprio_mllm.report.stored import Run
from proprio_mllm.report.summary import CATEGORIES
from proprio_mllm.report.table import Table

Pair = tuple[EpisodeRecord, EpisodeRecord]

_FIGURES: Final[Mapping[str, Callable[[EpisodeRecord], float]]] = {
    "success": lambda record: float(record.outcome is Outcome.SUCCESS),
    "in_time": lambda record: float(record.in_time),
    "goal_conditions": lambda record: record.goal_conditions_met,
    "steps": lambda record: float(record.steps),
}
_SAME_DRAWS: Final = ("robot", "difficulty", "start", "steps", "seed", "contingencies")


@dataclass(frozen=True, slots=True)
class RunComparison:
    """A comparison of two runs.

    Attributes:
        kind: `planners` (same body, tasks and contingencies) or `bodies`.
        names: label, robot and folder of the two.
        rows: by category and `all`, then by figure: `success`, `in_time`, `goal_conditions`, `steps`, and `steps_both_solved`,
            which is left out where no episode was solved by both.
        pairs: the episodes behind it.
        left_out: planned episodes of either run that are not part of it.
    """

    kind: str
    names: tuple[dict[str, str], dict[str, str]]
    rows: Mapping[str, Mapping[str, Comparison]]
    pairs: tuple[Pair, ...]
    left_out: int

    def to_json(self) -> dict[str, Any]:
        """Plain form, every pair of episodes included."""
        return {
            "kind": self.kind,
            "first": self.names[0],
            "second": self.names[1],
            "rows": {
                category: {figure: dataclasses.asdict(one) for figure, one in figures.items()}
                for category, figures in self.rows.items()
            },
            "left_out": self.left_out,
            "episodes": [
                {"task": a.task, "trial": a.trial, "category": a.category}
                | {figure: [of(a), of(b)] for figure, of in _FIGURES.items()}
                for a, b in self.pairs
            ],
        }


def compare_runs(a: Run, b: Run) -> RunComparison:
    """Compares two planners on one body.

    Raises:
        ValueError: when robot, difficulty, start, seed, contingencies or the content of a common task differ, or no episode is
            common; the message names what differs.
    """
    return _compared("planners", a, b, other_draws(a, b))


def compare_bodies(a: Run, b: Run) -> RunComparison:
    """Compares one planner on two bodies.

    Raises:
        ValueError: when the bodies are the same, or planner, weights, difficulty, start, seed, contingencies or the content of
            a common task differ, or no episode is common; the message names what differs.
    """
    differing = [
        f"{name}: {a.metadata[name]!r} and {b.metadata[name]!r}"
        for name in ("planner", "weights_digest", "difficulty", "start", "steps", "seed", "contingencies")
        if a.metadata.get(name) != b.metadata.get(name)
    ]
    if a.metadata["robot"] == b.metadata["robot"]:
        differing.append(f"robot: both runs are of {a.metadata['robot']!r}, a gap needs two bodies")
    return _compared("bodies", a, b, differing)


def other_draws(a: Run, b: Run) -> list[str]:
    """In what two runs on one body differ besides their planner."""
    differing = [
        f"{name}: {a.metadata[name]!r} and {b.metadata[name]!r}"
        for name in _SAME_DRAWS
        if a.metadata.get(name) != b.metadata.get(name)
    ]
    hashes = [run.metadata.get("contingencies_hash") for run in (a, b)]
    if None not in hashes and hashes[0] != hashes[1] and a.metadata["contingencies"] == b.metadata["contingencies"]:
        differing.append(f"contingencies: the rules of {a.metadata['contingencies']!r} were edited between the runs")
    if a.metadata["robot"] == b.metadata["robot"] and a.robot_config != b.robot_config:
        differing.append(f"robot description: {dict(a.robot_config)} and {dict(b.robot_config)}")
    if a.metadata["robot"] != b.metadata["robot"]:
        differing.append("two bodies are compared by `python -m proprio_mllm report gap`")
    return differing


def require_comparable(a: Run, b: Run, differing: Sequence[str]) -> None:
    """Refuses runs that differ in what is named, or whose common tasks are not the same.

    Raises:
        ValueError: naming what differs.
    """
    ours, theirs = a.contents(), b.contents()
    edited = sorted(task for task in ours if theirs.get(task, ours[task]) != ours[task])
    if edited:
        more = f" and {len(edited) - 3} more" if len(edited) > 3 else ""
        differing = [*differing, f"content of the tasks {', '.join(edited[:3])}{more}"]
    if differing:
        raise ValueError(f"{a.folder} and {b.folder} cannot be compared: they differ in {'; '.join(differing)}")


def in_order(categories: set[str]) -> list[str]:
    """Categories as every table has them, those of the user's own after them."""
    return [*(name for name in CATEGORIES if name in categories), *sorted(categories - set(CATEGORIES))]


def _compared(kind: str, a: Run, b: Run, differing: Sequence[str]) -> RunComparison:
    require_comparable(a, b, differing)
    other = {(record.task, record.trial): record for record in b.records}
    pairs = tuple((record, other[record.task, record.trial]) for record in a.records if (record.task, record.trial) in other)
    if not pairs:
        raise ValueError(f"{a.folder} and {b.folder} have no scored episode in common")
    planned = {(task, trial) for run in (a, b) for task, _, trial, _ in run.metadata["planned"]}
    order = in_order({first.category for first, _ in pairs})
    rows = {category: _figures([pair for pair in pairs if pair[0].category == category]) for category in order}
    names = tuple(
        {"label": _label(run, than), "robot": str(run.metadata["robot"]), "folder": str(run.folder)}
        for run, than in ((a, b), (b, a))
    )
    return RunComparison(kind, (names[0], names[1]), rows | {"all": _figures(pairs)}, pairs, len(planned) - len(pairs))


def _label(run: Run, than: Run) -> str:
    """A run's label, with what it did that the other did not; of runs that would be called the same, who answered."""
    named = [_named(one, other) for one, other in ((run, than), (than, run))]
    same = named[0] == named[1] and run.metadata["robot"] == than.metadata["robot"] and run.model != than.model
    return f"{named[0]}, {run.model}" if same else named[0]


def _named(run: Run, than: Run) -> str:
    return ", ".join([str(run.metadata["label"]), *(option for option in run.options if option not in than.options)])


def _figures(pairs: Sequence[Pair]) -> dict[str, Comparison]:
    found = {name: _over_tasks(pairs, of) for name, of in _FIGURES.items()}
    solved = [pair for pair in pairs if all(record.outcome is Outcome.SUCCESS for record in pair)]
    if solved:
        found["steps_both_solved"] = _over_tasks(solved, _FIGURES["steps"])
    return found


def _over_tasks(pairs: Sequence[Pair], of: Callable[[EpisodeRecord], float]) -> Comparison:
    sides: tuple[dict[str, list[float]], ...] = (defaultdict(list), defaultdict(list))
    for pair in pairs:
        for side, record in zip(sides, pair, strict=True):
            side[record.task].append(of(record))
    return compare(*sides)


def comparison_table(result: RunComparison) -> Table:
    """The comparison as a table: one line per category and figure, first minus second."""
    labels = [f"{one['label']} ({one['robot']})" for one in result.names]
    columns = ("category", "figure", "tasks", labels[0], labels[1], "difference", "95 % interval", "p", "higher", "lower")
    body: list[tuple[str, ...]] = []
    for category, figures in result.rows.items():
        for figure, one in figures.items():
            scale, unit = (1.0, "") if figure.startswith("steps") else (100.0, " %")
            body.append(
                (
                    category, figure.replace("_", " ") + unit, str(one.tasks),
                    f"{scale * one.first:.1f}", f"{scale * one.second:.1f}", f"{scale * one.difference:+.1f}",
                    f"[{scale * one.low:+.1f}, {scale * one.high:+.1f}]", f"{one.p_value:.3g}",
                    str(len(one.above)), str(len(one.below)),
                )
            )  # fmt: skip
    success = result.rows["all"]["success"]
    notes = [
        "difference: first minus second, over tasks; interval: bootstrap over tasks; p: exact sign test on differing tasks.",
        f"gained, {labels[0]} succeeds more often: {', '.join(success.above) or 'none'}.",
        f"lost, {labels[0]} succeeds less often: {', '.join(success.below) or 'none'}.",
    ]
    if result.kind == "bodies":
        notes.append("Two bodies: tasks are paired, the contingencies of their trials are not.")
    if result.left_out:
        notes.append(f"{result.left_out} planned episodes are not scored in both runs and left out.")
    return Table(f"{labels[0]} against {labels[1]}", columns, tuple(body), tuple(notes))
