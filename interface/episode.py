"""How an episode ended, and its line in the ledger."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Final

from interface.failures import FailureCategory

#: Environment steps of an episode. Paper: 50.
STEP_LIMIT: Final = 50


class Outcome(StrEnum):
    """How an episode ended. `INFRASTRUCTURE_ERROR` is not a score: it is reported and re-run."""

    SUCCESS = "success"
    FAILURE = "failure"
    INFRASTRUCTURE_ERROR = "infrastructure_error"


@dataclass(frozen=True, slots=True)
class EpisodeRecord:
    """One line of the ledger.

    Attributes:
        planner, robot, task, category, difficulty, trial, seed, config_hash: the episode's key.
        outcome: how it ended; success is success within the run's step limit.
        failure: the one category of a failed episode, None otherwise.
        invalid_output: number of planner replies outside the grammar.
        budget_exhausted: whether the step limit ended a failed episode.
        goal_conditions_met: fraction of goal predicates that held at the end, in [0, 1].
        steps: environment steps taken.
        makespan_s: simulated seconds.
        path_length_m: length of the base's path.
        arm_utilisation: mean fraction of arm-steps in which an arm acted, in [0, 1].
        planner_calls, planner_tokens, planner_s, wall_s: cost.
        trace: per step, the step text, its outcome codes and margins.
        message: error text of an infrastructure error.
        cached_calls: calls that a reply cache answered.
        reflections: calls that reflected on a failure.
        planner_usd: price of all calls when they were made, None where it is not known.
        models: exact language models that answered.
        in_time: whether it succeeded within the task's own time limit.
        stuck: whether it was ended because it only repeated itself.
    """

    planner: str
    robot: str
    task: str
    category: str
    difficulty: str
    trial: int
    seed: int
    config_hash: str
    outcome: Outcome
    failure: FailureCategory | None
    invalid_output: int
    budget_exhausted: bool
    goal_conditions_met: float
    steps: int
    makespan_s: float
    path_length_m: float
    arm_utilisation: float
    planner_calls: int
    planner_tokens: int
    planner_s: float
    wall_s: float
    trace: tuple[Mapping[str, object], ...] = ()
    message: str = ""
    cached_calls: int = 0
    reflections: int = 0
    planner_usd: float | None = 0.0
    models: tuple[str, ...] = ()
    in_time: bool = False
    stuck: bool = False
