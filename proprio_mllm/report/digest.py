"""Everything a report shows of one episode, as plain data: the page and the exported traces are made of it.

`docs/evaluation.md` lists the keys of `episode_digest` (exports). A value that needs acting the episode out (`goals[].held`,
`trace[].codes_now`) is null where that was not done.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from typing import Any, Final

from data.files import file_hash
from interface.episode import EpisodeRecord, Outcome
from interface.failures import INVALID_OUTPUT
from proprio_mllm.evaluation.attribution import Deciding, deciding_failure, unmet_objects
from proprio_mllm.report.frames import ActedOut, episode_id
from proprio_mllm.report.stored import Run
from proprio_mllm.report.words import code_in_words, margins_in_words
from sim.tasks.task import Task

#: Fields of a record that are shown as they are.
_FIELDS: Final = (
    "planner", "robot", "task", "category", "difficulty", "trial", "seed", "config_hash", "invalid_output", "budget_exhausted",
    "stuck", "in_time",
    "goal_conditions_met", "steps", "makespan_s", "path_length_m", "arm_utilisation", "planner_calls", "planner_tokens",
    "planner_s", "wall_s", "message",
)  # fmt: skip
_PROVENANCE: Final = (
    "planner", "label", "privileged", "physics", "robot", "difficulty", "contingencies", "category", "trials", "limit", "start",
    "steps", "stuck", "seed", "tasks", "weights_digest", "config_hash", "command",
)  # fmt: skip


_ABOUT: Final = {
    "goal": "it is about a goal that stayed open",
    "nothing": "nothing got the robot further after it",
    "other": "no standing failure is about an open goal",
}


def run_digest(run: Run) -> dict[str, Any]:
    """Where a run comes from: name, settings, command, digest of the weights, and a hash of its ledger."""
    ledger = run.folder / "ledger.jsonl"
    return {
        "name": run.folder.resolve().name,
        "title": run.title,
        **{name: run.metadata.get(name) for name in _PROVENANCE},
        "planned": len(run.metadata["planned"]),
        "scored": len(run.records),
        "infrastructure_errors": len(run.broken),
        "ledger_sha256": file_hash(ledger) if ledger.is_file() else hashlib.sha256(b"").hexdigest(),
    }


def episode_digest(record: EpisodeRecord, task: Task | None, acted: ActedOut | None, note: str = "") -> dict[str, Any]:
    """One episode.

    Args:
        record: its ledger line.
        task: its task; None when it is not there any more.
        acted: the episode acted out again; None when that was not done.
        note: what else there is to say, such as why it could not be acted out.
    """
    fine = acted is not None and not acted.error
    trace = [
        _step(record.robot, entry, acted.codes[number] if acted is not None and fine else None)
        for number, entry in enumerate(record.trace)
    ]
    goals = _goals(task, acted if fine else None)
    return {
        "id": episode_id(record),
        **{name: getattr(record, name) for name in _FIELDS},
        "outcome": record.outcome.value,
        "failure": None if record.failure is None else record.failure.value,
        "instruction": "" if task is None else task.instruction,
        "family": "" if task is None else task.family,
        "room": "" if task is None else task.room,
        "time_limit": None if task is None else task.time_limit,
        "struck": sum(any(outcome["contingency"] for outcome in step["outcomes"]) for step in trace),
        "why": _why(record, trace, goals, task),
        "goals": goals,
        "trace": trace,
        "note": acted.error if acted is not None and acted.error else note,
    }


def _step(robot: str, entry: Mapping[str, Any], now: Sequence[str] | None) -> dict[str, Any]:
    outcomes = [_outcome(robot, outcome) for outcome in entry["outcomes"]]
    codes = [outcome["code"] for outcome in outcomes]
    return {
        "step": entry["step"],
        "duration_s": entry["duration_s"],
        "outcomes": outcomes,
        "codes_now": None if now is None else list(now),
        "differs": now is not None and list(now) != codes,
    }


def _outcome(robot: str, outcome: Mapping[str, Any]) -> dict[str, Any]:
    code = str(outcome["code"])
    invalid = code == INVALID_OUTPUT
    meaning = str(outcome.get("message", "")) or "the reply is outside the grammar" if invalid else code_in_words(code)
    return {
        **{name: outcome[name] for name in ("action", "ok", "code", "category", "margins", "contingency")},
        "meaning": meaning,
        "margins_in_words": margins_in_words(robot, code, outcome["margins"]),
    }


def _goals(task: Task | None, acted: ActedOut | None) -> list[dict[str, Any]]:
    if task is None:
        return []
    found = []
    for number, goal in enumerate(task.goals):
        held = None if acted is None else [row[number] for row in acted.goals]
        found.append({"text": goal.to_text(), "goal": goal.to_json(), "held": held, "since": _since(held)})
    return found


def _since(held: Sequence[bool] | None) -> int | None:
    """The step from which on a goal held to the end, 0 at the start; None when it did not hold at the end, or is not known."""
    if held is None or not held[-1]:
        return None
    first = len(held) - 1
    while first and held[first - 1]:
        first -= 1
    return first


def _why(
    record: EpisodeRecord, trace: Sequence[Mapping[str, Any]], goals: Sequence[Mapping[str, Any]], task: Task | None
) -> dict[str, Any] | None:
    """The deciding failure of a failed episode with a sentence; None for other episodes."""
    if record.outcome is not Outcome.FAILURE:
        return None
    unmet = _unmet_objects(record, goals, task)
    if unmet is None:
        return {"step": None, "outcome": None, "text": "Which goals were open at the end is known once it is acted out again."}
    found = deciding_failure(trace, unmet)
    if found is None:
        end = "the planner said Done()"
        if record.budget_exhausted or record.stuck:
            end = "the steps ran out" if record.budget_exhausted else "the same steps changed nothing any more"
        return {"step": None, "outcome": None, "text": f"No failure stands: the plan was wrong or ended too early; {end}."}
    return {"step": found.step + 1, "outcome": found.outcome, "text": _sentence(found, trace)}


def _sentence(found: Deciding, trace: Sequence[Mapping[str, Any]]) -> str:
    step = trace[found.step]
    outcome = step["outcomes"][found.outcome]
    if outcome["code"] == INVALID_OUTPUT:
        return f"Step {found.step + 1}: the reply was outside the grammar, and nothing got the robot further after it."
    about = _ABOUT[found.about]
    failed = f"{outcome['action']} failed with {outcome['code']} ({outcome['meaning']})"
    return f"Step {found.step + 1}: {failed} and was not made good; {about}."


def _unmet_objects(record: EpisodeRecord, goals: Sequence[Mapping[str, Any]], task: Task | None) -> frozenset[str] | None:
    """Ids that goals open at the end are about; None where neither ledger nor acting out tells."""
    if task is None:
        return None
    if record.goal_conditions_met == 0.0:  # the ledger has the share of goals, not which ones
        return unmet_objects(task, [False] * len(task.goals))
    held = [goal["held"] for goal in goals]
    if any(one is None for one in held):
        return None
    return unmet_objects(task, [one[-1] for one in held])
