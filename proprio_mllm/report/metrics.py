"""Figures of episodes beyond success: path-length weighting, steps against the expert's, recovery from contingencies, regret.

With S the success of an episode (0 or 1), l the length of the base's path in the certificate and p the episode's own:

* SPL: mean of S · l' / max(p', l') with l' = max(l, 0.1 m) and p' = max(p, 0.1 m). Certificates are rounded to 0.1 m, and some
  tasks need no walking at all: below 0.1 m a path counts as 0.1 m, so that standing still on a task without a way gives 1 and
  walking there costs. The expert's path is not proven shortest; a shorter own path counts as 1.
* step optimality: mean of certificate steps / own steps over successes; above 1 where an episode needed fewer steps.
* recovery: an event is an action whose draw of the contingency was not success. It is recovered when its episode succeeds, and
  made good when the same verb on the same object succeeds later in the episode, with either arm (the rule of `attribution`).
* regret: success of the same planner in the same episodes at `easy` minus success here; and mean own steps minus the expert's
  over episodes that both solved at this difficulty with these contingencies.

* first tries: the first time in an episode that a verb is tried at a target with an arm, or with both, and not refused by what
  the hands and the target are. It is in reach unless its code is `TooFar` (wrong by stance), `BodyTooHigh` or `BodyTooLow` (by
  height); by arm, when the other arm then reaches the target before the robot has moved.

Paper: path-length weighting after Anderson et al. 2018; none of these is in the paper.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final, Literal, get_args

import numpy as np

from interface.actions import ActionKind
from interface.episode import EpisodeRecord, Outcome
from interface.failures import FailureCode
from interface.steps import Action, ActionError
from proprio_mllm.report.statistics import cluster_bootstrap

SHORTEST_M: Final = 0.1
Reach = Literal["reached", "stance", "height", "arm"]
_OUT_OF_REACH: Final[Mapping[str, Reach]] = {
    FailureCode.TOO_FAR: "stance",
    FailureCode.BODY_TOO_HIGH: "height",
    FailureCode.BODY_TOO_LOW: "height",
}


@dataclass(frozen=True, slots=True)
class Certificate:
    """The expert's plan for a task: its number of steps and the length of the base's path in metres."""

    steps: int
    path_length_m: float


@dataclass(frozen=True, slots=True)
class References:
    """What is known besides the run itself; empty where there is nothing to compare with.

    Attributes:
        certificates: by task, for the run's robot.
        easy: whether the same planner succeeded in the same episode at `easy`, by task and trial.
        expert: the expert's steps in the same episode at the same difficulty, where it succeeded, by task and trial.
    """

    certificates: Mapping[str, Certificate] = field(default_factory=dict)
    easy: Mapping[tuple[str, int], bool] = field(default_factory=dict)
    expert: Mapping[tuple[str, int], int] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Extras:
    """The figures of some episodes; NaN where there is nothing to count. See the module for the definitions.

    Attributes:
        certified: episodes with a certificate.
        spl, spl_low, spl_high: over the certified episodes, with a cluster bootstrap over tasks (95 %).
        step_optimality: over the certified successes.
        contingencies: events.
        recovery, made_good: shares of the events.
        regret_episodes: episodes that the same planner also ran at `easy`.
        regret: over those.
        regret_steps_episodes: episodes that both this planner and the expert solved.
        regret_steps: over those.
        first_tries: how many.
        first_try_rate: share of them in reach.
        wrong_stance, wrong_height, wrong_arm: shares of them that are not, by what was wrong; the four add up to 1.
    """

    certified: int
    spl: float
    spl_low: float
    spl_high: float
    step_optimality: float
    contingencies: int
    recovery: float
    made_good: float
    regret_episodes: int
    regret: float
    regret_steps_episodes: int
    regret_steps: float
    first_tries: int
    first_try_rate: float
    wrong_stance: float
    wrong_height: float
    wrong_arm: float


def path_efficiency(own_m: float, shortest_m: float) -> float:
    """l' / max(p', l') in (0, 1]; see the module.

    Raises:
        ValueError: on a negative length.
    """
    if own_m < 0.0 or shortest_m < 0.0:
        raise ValueError(f"path lengths must not be negative, got {own_m} and {shortest_m} m")
    shortest = max(shortest_m, SHORTEST_M)
    return shortest / max(own_m, shortest)


def recoveries(trace: Sequence[Mapping[str, Any]]) -> list[bool]:
    """Per contingency event of an episode, in order, whether the action was made good later."""
    done: set[tuple[str, str | None]] = set()
    found: list[bool] = []
    for step in reversed(trace):
        for outcome in reversed(step["outcomes"]):
            action = _parsed(outcome)
            if action is None:
                continue
            key = (action.name, action.object_id)
            if outcome["contingency"] not in ("", "success"):
                found.append(key in done)
            if outcome["ok"]:
                done.add(key)
    return found[::-1]


def first_tries(trace: Sequence[Mapping[str, Any]]) -> list[Reach]:
    """What came of each first try of an episode, in order; see the module."""
    done = [(outcome, action) for step in trace for outcome in step["outcomes"] if (action := _parsed(outcome)) is not None]
    tried: set[tuple[str, str | None]] = set()
    found: list[Reach] = []
    for number, (outcome, action) in enumerate(done):
        reach, key = _reach(outcome, action), (action.name, action.object_id)
        if reach is None or key in tried:
            continue
        tried.add(key)
        if reach != "reached" and _other_arm_reaches(done[number + 1 :], action):
            reach = "arm"
        found.append(reach)
    return found


def _parsed(outcome: Mapping[str, Any]) -> Action | None:
    """The action; None for a reply outside the grammar, today's or that of the ledger's time."""
    try:
        return Action.parse(outcome["action"])
    except ActionError:
        return None


def _reach(outcome: Mapping[str, Any], action: Action) -> Reach | None:
    """Whether an action came as far as its target; None when it aims at none, or was refused before."""
    if action.object_id is None or not action.spec.arms:
        return None
    if outcome["code"] in _OUT_OF_REACH:
        return _OUT_OF_REACH[outcome["code"]]
    return "reached" if outcome["ok"] or outcome["code"] in action.spec.meets else None


def _other_arm_reaches(later: Sequence[tuple[Mapping[str, Any], Action]], action: Action) -> bool:
    """Whether the other arm reaches the target of an action before the robot moves."""
    for outcome, after in later:
        if after.spec.kind is ActionKind.BODY and outcome["ok"]:
            return False
        if (after.name, after.object_id) == (action.name, action.object_id) and after.arm is not action.arm:
            return _reach(outcome, after) == "reached"
    return False


def _mean(values: Sequence[float]) -> float:
    return float(np.mean(values)) if values else float("nan")


def _spl(records: Sequence[EpisodeRecord], certificates: Mapping[str, Certificate]) -> tuple[float, float, float]:
    clusters: dict[str, list[float]] = {}
    for record in records:
        won = record.outcome is Outcome.SUCCESS
        share = path_efficiency(record.path_length_m, certificates[record.task].path_length_m) if won else 0.0
        clusters.setdefault(record.task, []).append(share)
    if not clusters:
        return float("nan"), float("nan"), float("nan")
    low, high = cluster_bootstrap([clusters[task] for task in sorted(clusters)], np.random.default_rng(0))
    return _mean([value for values in clusters.values() for value in values]), low, high


def extras_of(records: Sequence[EpisodeRecord], references: References) -> Extras:
    """The figures of some episodes.

    Args:
        records: scored episodes.
        references: what they are measured against.
    """
    certificates, easy, expert = references.certificates, references.easy, references.expert
    won = {(record.task, record.trial): record.outcome is Outcome.SUCCESS for record in records}
    certified = [record for record in records if record.task in certificates]
    spl, low, high = _spl(certified, certificates)
    events = [(won[record.task, record.trial], good) for record in records for good in recoveries(record.trace)]
    at_easy = [float(easy[key]) - float(success) for key, success in won.items() if key in easy]
    solved = [record for record in records if won[record.task, record.trial]]
    to_expert = [r.steps - expert[r.task, r.trial] for r in solved if (r.task, r.trial) in expert]
    tries = [reach for record in records for reach in first_tries(record.trace)]
    share = {name: _mean([float(one == name) for one in tries]) for name in get_args(Reach)}
    return Extras(
        certified=len(certified),
        spl=spl,
        spl_low=low,
        spl_high=high,
        step_optimality=_mean([certificates[r.task].steps / r.steps for r in solved if r.task in certificates]),
        contingencies=len(events),
        recovery=_mean([float(success) for success, _ in events]),
        made_good=_mean([float(good) for _, good in events]),
        regret_episodes=len(at_easy),
        regret=_mean(at_easy),
        regret_steps_episodes=len(to_expert),
        regret_steps=_mean(to_expert),
        first_tries=len(tries),
        first_try_rate=share["reached"],
        wrong_stance=share["stance"],
        wrong_height=share["height"],
        wrong_arm=share["arm"],
    )
