"""What an episode is measured against: its certificate, the same planner at `easy`, the expert with the same contingencies.

A certificate (`sim/tasks/certificates.jsonl`) is the expert's plan for a task's own start and the robot as shipped. It stands
for an episode only when the run had this task with this content, `start=fixed` and no robot description of the user's own.

Paper: none of this.
"""

from __future__ import annotations

import functools
import json
import logging
from pathlib import Path
from typing import Final

import sim.tasks
from interface.episode import EpisodeRecord, Outcome
from proprio_mllm.evaluation.run import task_key
from proprio_mllm.report.metrics import Certificate, References
from proprio_mllm.report.stored import Run, load_run, read_metadata
from sim.tasks.task import load_benchmark

CERTIFICATES_PATH: Final = Path(sim.tasks.__file__).parent / "certificates.jsonl"

logger = logging.getLogger(__name__)

#: (task, trial)
Episode = tuple[str, int]


def read_certificates(path: Path = CERTIFICATES_PATH) -> dict[tuple[str, str], Certificate]:
    """Certificates by (task, robot).

    Raises:
        ValueError: on a line that is no certificate; the message names file and line.
    """
    found: dict[tuple[str, str], Certificate] = {}
    for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), start=1):
        try:
            raw = json.loads(line)
            own = Certificate(int(raw["steps"]), float(raw["path_length_m"]))
            found[raw["task"], raw["robot"]] = own
        except (ValueError, TypeError, KeyError) as error:
            raise ValueError(f"{path}, line {number}: expected task, robot, steps and path_length_m ({error!r})") from error
    return found


@functools.cache
def _shipped() -> dict[tuple[str, str, str], Certificate]:
    """Certificates of the benchmark by task, hash of its content, and robot."""
    keys = {task.id: task_key(task) for task in load_benchmark()}
    return {(task, keys[task], robot): one for (task, robot), one in read_certificates().items() if task in keys}


def _certificates(run: Run) -> dict[str, Certificate]:
    if run.metadata["start"] != "fixed" or run.robot_config.get("spec") is not None:
        return {}
    shipped, robot = _shipped(), str(run.metadata["robot"])
    found = {task: shipped.get((task, content, robot)) for task, content in run.contents().items()}
    return {task: one for task, one in found.items() if one is not None}


def _same_episodes(run: Run, other: Run) -> dict[Episode, EpisodeRecord]:
    """Scored episodes of another run on tasks whose content is the same."""
    ours, theirs = run.contents(), other.contents()
    return {(r.task, r.trial): r for r in other.records if ours.get(r.task) == theirs[r.task]}


def _beside(run: Run, **wanted: object) -> dict[Episode, EpisodeRecord]:
    """Episodes of runs beside a run with these settings and its robot, start, seed and contingencies; the newest stand.

    A neighbour that cannot be read is passed by with a warning: it must not cost a finished run its report.
    """
    same = ("robot", "start", "steps", "seed", "contingencies", "contingencies_hash")
    wanted |= {name: run.metadata.get(name) for name in same}
    found: dict[Episode, EpisodeRecord] = {}
    paths = sorted(run.folder.parent.glob("*/run.json"), key=lambda path: (path.stat().st_mtime, path.parent.name))
    for path in paths:
        try:
            metadata = read_metadata(path.parent)
            fits = path.parent != run.folder and all(metadata.get(name) == value for name, value in wanted.items())
            other = load_run(path.parent) if fits else None
        except (OSError, ValueError) as error:
            logger.warning("left out as a reference: %s", error)
            continue
        if other is not None and other.robot_config == run.robot_config:
            found |= _same_episodes(run, other)
    return found


def references_of(run: Run) -> References:
    """Everything that a run can be measured against: the shipped certificates and the runs in the folders beside it."""
    easy: dict[Episode, EpisodeRecord] = {}
    if run.metadata["difficulty"] != "easy":  # the hash covers planner, weights, robot and start, not the difficulty
        easy = _beside(run, difficulty="easy", config_hash=run.metadata["config_hash"])
    expert: dict[Episode, EpisodeRecord] = {}
    if not run.metadata["privileged"]:
        expert = _beside(run, difficulty=run.metadata["difficulty"], planner="expert", privileged=True)
    return References(
        _certificates(run),
        {key: record.outcome is Outcome.SUCCESS for key, record in easy.items()},
        {key: record.steps for key, record in expert.items() if record.outcome is Outcome.SUCCESS},
    )
