"""How well the failure types name the true reason: scripted episodes with a known mistake, and what the rule makes of them.

    python -m benchmarks.attribution robot=all seed=1 workers=2 out=outputs/validation

The episodes (`benchmarks.fault_episodes`) are acted out in the simulator; agreement gets Wilson's interval over
episodes, and the confusion matrix has the true type in its rows. Exit code 0; 1 when fewer than 95 % agree, a flag is wrong or
too few episodes count; 2 on wrong arguments.

Paper: none; it does not say how its failure types were found.
"""

from __future__ import annotations

import dataclasses
import logging
import sys
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal

from rich.progress import Progress

from benchmarks.fault_episodes import Cell, CellRunner, ScriptedResult, cells
from configs.arguments import command, read_arguments
from data.files import write_text
from interface.episode import Outcome
from interface.failures import FailureCategory
from proprio_mllm.evaluation.pool import run_jobs
from proprio_mllm.report.statistics import wilson
from proprio_mllm.report.summary import write_json
from proprio_mllm.report.table import Table

#: Share of episodes that must get the type of their cause, and how many episodes there must be with both robots.
AGREEMENT: Final = 0.95
EPISODES: Final = 60
VERSION: Final = 1
_TYPES: Final = tuple(FailureCategory)


@dataclass(frozen=True, slots=True)
class ValidationConfig:
    """Options of the command line.

    Attributes:
        robot: who acts.
        seed: of the draws of tasks and mistakes.
        per_cause: episodes per cause and robot; None for 3 of each navigation and body cause and 2 of each logical one.
        workers: processes; 0 runs in the main one.
        out: folder of the results.
    """

    robot: Literal["all", "h1", "x1"] = "all"
    seed: int = 1
    per_cause: int | None = None
    workers: int = 2
    out: str = "outputs/validation"

    def __post_init__(self) -> None:
        if not 0 <= self.workers <= 64:
            raise ValueError(f"workers {self.workers} outside 0..64")
        if self.per_cause is not None and not 1 <= self.per_cause <= 100:
            raise ValueError(f"per_cause {self.per_cause} outside 1..100")

    @property
    def robots(self) -> tuple[str, ...]:
        """Names of the robots."""
        return ("h1", "x1") if self.robot == "all" else (self.robot,)


@dataclass(frozen=True, slots=True)
class Validation:
    """Counts over the episodes that count.

    Attributes:
        matrix: episodes by (true type, type given).
        invalid: episodes by (must be flagged for invalid output, is flagged).
        exhausted: episodes by (ended without the planner's Done, is flagged as budget exhausted).
        robots, families, causes: how many different ones.
        left_out: reasons why episodes do not count, with their numbers.
    """

    matrix: Counter[tuple[FailureCategory, FailureCategory]]
    invalid: Counter[tuple[bool, bool]]
    exhausted: Counter[tuple[bool, bool]]
    robots: int
    families: int
    causes: int
    left_out: Counter[str]

    @property
    def episodes(self) -> int:
        """Episodes that count."""
        return sum(self.matrix.values())

    @property
    def agreed(self) -> int:
        """Episodes that were given the type of their cause."""
        return sum(count for (true, given), count in self.matrix.items() if true is given)

    @property
    def flags_agree(self) -> bool:
        """Whether every episode has the flags that it must have."""
        return all(true == flag for counts in (self.invalid, self.exhausted) for true, flag in counts)

    @property
    def passed(self) -> bool:
        """Whether enough episodes agree."""
        return self.episodes > 0 and self.agreed >= AGREEMENT * self.episodes


def run_cells(wanted: Sequence[Cell], workers: int, progress: Progress | None = None) -> list[ScriptedResult]:
    """Fills cells and returns their episodes, in the order of the cells.

    Raises:
        RuntimeError: when a process died for good.
    """

    def lost(cell: Cell, message: str) -> list[ScriptedResult]:
        raise RuntimeError(f"{cell.cause} on {cell.robot}: {message}")

    bar = None if progress is None else progress.add_task("scripted episodes", total=sum(cell.count for cell in wanted))
    order = {(cell.cause, cell.robot): number for number, cell in enumerate(wanted)}
    found: list[ScriptedResult] = []
    for results in run_jobs(CellRunner, wanted, workers, lambda _: False, lost):
        found += results
        if progress is not None and bar is not None:
            progress.update(bar, completed=sum(result.counts for result in found))
    return sorted(found, key=lambda result: order[result.episode.cause, result.episode.robot])


def validate(results: Sequence[ScriptedResult]) -> Validation:
    """Compares the types and flags of scripted episodes with their causes."""
    counted = [result for result in results if result.counts]
    return Validation(
        matrix=Counter((result.expected, FailureCategory(result.record.failure or "")) for result in counted),
        invalid=Counter((result.expected_invalid, result.record.invalid_output > 0) for result in counted),
        exhausted=Counter((_ran_out(result), result.record.budget_exhausted) for result in counted),
        robots=len({result.episode.robot for result in counted}),
        families=len({result.episode.family for result in counted}),
        causes=len({result.episode.cause for result in counted}),
        left_out=Counter(_why_left_out(result) for result in results if not result.counts),
    )


def _ran_out(result: ScriptedResult) -> bool:
    return not result.record.trace or result.record.trace[-1]["step"] != "Done()"


def _why_left_out(result: ScriptedResult) -> str:
    if result.record.outcome is Outcome.INFRASTRUCTURE_ERROR:
        return "broke"
    return "the mistake was not made where it matters" if not result.mattered else "the task was solved all the same"


def _tables(found: Validation, results: Sequence[ScriptedResult]) -> list[Table]:
    low, high = wilson(found.agreed, found.episodes)
    rate = f"{100 * found.agreed / found.episodes:.1f} [{100 * low:.1f}, {100 * high:.1f}] {found.agreed}/{found.episodes}"
    left = "; ".join(f"{count} {why}" for why, count in sorted(found.left_out.items()))
    matrix = Table(
        f"Failure types: agreement {rate}",
        ("true cause", *(kind.replace("_", " ") for kind in _TYPES), "episodes"),
        tuple(
            (
                true.replace("_", " "),
                *(str(found.matrix[true, given]) for given in _TYPES),
                str(sum(found.matrix[true, given] for given in _TYPES)),
            )
            for true in _TYPES
        ),
        (
            "Rows: type of the cause; columns: type given. Agreement in % with Wilson's 95 % interval over episodes.",
            f"{found.causes} causes, {found.families} families, {found.robots} robots. Tried and left out: {left or 'none'}.",
        ),
    )
    flags = Table(
        "Flags",
        ("flag", "rightly set", "rightly not set", "wrongly set", "missing"),
        tuple(
            (name, *(str(counts[pair]) for pair in ((True, True), (False, False), (False, True), (True, False))))
            for name, counts in (("invalid output", found.invalid), ("budget exhausted", found.exhausted))
        ),
    )
    rows: Counter[tuple[str, str]] = Counter((r.episode.cause, r.episode.robot) for r in results if r.counts)
    right: Counter[tuple[str, str]] = Counter(
        (r.episode.cause, r.episode.robot) for r in results if r.counts and r.record.failure is r.expected
    )
    kinds = {result.episode.cause: result.expected for result in results}
    robots = sorted({result.episode.robot for result in results})
    causes = Table(
        "By cause: agreeing / episodes",
        ("cause", "type", *robots),
        tuple(
            (cause, kind.replace("_", " "), *(f"{right[cause, robot]}/{rows[cause, robot]}" for robot in robots))
            for cause, kind in kinds.items()
        ),
    )
    return [matrix, flags, causes]


def _to_json(config: ValidationConfig, found: Validation, results: Sequence[ScriptedResult]) -> dict[str, Any]:
    low, high = wilson(found.agreed, found.episodes)
    return {
        "schema_version": VERSION,
        "config": dataclasses.asdict(config),
        "episodes": found.episodes,
        "agreed": found.agreed,
        "agreement": [found.agreed / found.episodes, low, high],
        "matrix": {true: {given: found.matrix[true, given] for given in _TYPES} for true in _TYPES},
        "flags_agree": found.flags_agree,
        "left_out": dict(sorted(found.left_out.items())),
        "runs": [
            {
                **dataclasses.asdict(result.episode),
                "counts": result.counts,
                "mattered": result.mattered,
                "slipped": result.slipped,
                "expected": result.expected,
                "given": result.record.failure,
                "outcome": result.record.outcome,
                "invalid_output": result.record.invalid_output,
                "budget_exhausted": result.record.budget_exhausted,
                "unmet_objects": list(result.unmet),
                "trace": list(result.record.trace),
                "message": result.record.message,
            }
            for result in results
        ],
    }


@command()
def main(arguments: Sequence[str]) -> int:
    """Command line; returns the exit code."""
    logging.basicConfig(level=logging.WARNING, format="%(message)s")
    config = read_arguments(ValidationConfig, arguments)
    with Progress() as progress:
        results = run_cells(cells(config.robots, config.seed, config.per_cause), config.workers, progress)
    found = validate(results)
    if not found.episodes:
        sys.stderr.write(f"validation: no episode counts of {len(results)} that were tried\n")
        return 1
    folder = Path(config.out)
    folder.mkdir(parents=True, exist_ok=True)
    tables = _tables(found, results)
    write_text(folder / "validation.md", "\n\n".join(table.to_markdown().strip() for table in tables) + "\n")
    write_json(folder / "validation.json", _to_json(config, found, results))
    for table in tables:
        table.show()
    for result in results:
        if result.counts and result.record.failure is not result.expected:
            one = result.episode
            sys.stdout.write(f"{one.cause} on {one.robot}, {one.task}: {result.record.failure}, not {result.expected}\n")
    sys.stdout.write(f"{folder}/validation.md, validation.json\n")
    enough = config.robot != "all" or config.per_cause is not None or found.episodes >= EPISODES
    return 0 if found.passed and found.flags_agree and enough else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
