"""Supervised fine-tuning rows from the episodes of runs: what the planner saw before a step, as a chat, and the step it took.

Episodes are acted out again from their ledger lines. One whose steps end otherwise than in the ledger is left out with a
warning: its success would be another episode's. Replies outside the grammar are never targets; they stay in the history of
later steps.

Columns (`SFT_COLUMNS`): `messages` is a chat as `apply_chat_template` takes it (system, user with one image, assistant), and
`images` has its picture; the other columns are what it was made of. Proprioception is a choice: `motion` is flat (T·F,) float32
(`data.shards.decode_motion`), `key_bodies` flat (K·3,) metres in the pelvis heading frame, `joint_positions` (J,) radians.
"""

from __future__ import annotations

import functools
import logging
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import datasets
import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from data.shards import encode_png
from interface.episode import Outcome
from interface.manual import action_manual, code_manual
from interface.observation import HistoryItem, Observation
from proprio_mllm.evaluation.pool import run_jobs
from proprio_mllm.model.chat import Message, to_chat
from proprio_mllm.model.prompts import answers, last_steps, with_answer
from proprio_mllm.report.frames import episode_id
from proprio_mllm.report.reenact import Episode, Moment, Reenactment

logger = logging.getLogger(__name__)

_TEXT, _INT, _FLOAT, _BOOL = (datasets.Value(name) for name in ("string", "int64", "float32", "bool"))
#: Columns of every row.
SFT_COLUMNS: Final[Mapping[str, Any]] = {
    "messages": datasets.List({"role": _TEXT, "content": datasets.List({"type": _TEXT, "text": _TEXT})}),
    "images": datasets.List(datasets.Image()),
    "run": _TEXT,
    "episode": _TEXT,
    "task": _TEXT,
    "category": _TEXT,
    "family": _TEXT,
    "room": _TEXT,
    "robot": _TEXT,
    "difficulty": _TEXT,
    "planner": _TEXT,
    "trial": _INT,
    "seed": _INT,
    "episode_success": _BOOL,
    "step": _INT,
    "time_limit": _INT,
    "step_success": _BOOL,
    "instruction": _TEXT,
    "visible": datasets.List(_TEXT),
    "known": datasets.List(_TEXT),
    "history": datasets.List({"step": _TEXT, "feedback": _TEXT}),
    "target": _TEXT,
}
#: Columns of rows with the robot's own state.
PROPRIOCEPTION_COLUMNS: Final[Mapping[str, Any]] = {
    name: datasets.List(_FLOAT) for name in ("motion", "key_bodies", "joint_positions")
}


def plan_prompt(
    instruction: str,
    robot: str,
    visible: Sequence[str],
    known: Sequence[str],
    history: Sequence[HistoryItem],
    step: int,
    time_limit: int,
    last: int = 4,
) -> tuple[Message, ...]:
    """A planner's prompt about one image, for models that read English; the reply is `PlanStep` text.

    Args:
        instruction: the task.
        robot: robot name.
        visible: ids in view.
        known: ids seen so far; those in view are not repeated.
        history: earlier steps, oldest first; the newest `last` are shown.
        step: index of the coming step, from 0.
        time_limit: steps that the task allows.
        last: number of earlier steps shown.
    """
    system = (
        f"You plan for a dual-arm humanoid household robot. Reply with the next step only.\n{action_manual()}\n{code_manual()}"
    )
    elsewhere = [name for name in known if name not in set(visible)]
    lines = (
        f"Robot: {robot}. Step {step + 1} of {time_limit}.",
        f"Task: {instruction}",
        f"In view: {answers(visible)}",
        f"Known elsewhere: {answers(elsewhere)}",
        f"Last steps:\n{last_steps(history, last, 'full')}",
        "Next step?",
    )
    return Message("system", system), Message("user", "\n".join(lines), 1)


@dataclass(frozen=True, slots=True)
class RowChoice:
    """What becomes a row.

    Attributes:
        size: side of the pictures, pixels.
        history: newest earlier steps shown in the prompt.
        failed_steps: whether steps with a failed action are targets too.
        proprioception: whether the robot's own state is kept.
    """

    size: int = 224
    history: int = 8
    failed_steps: bool = False
    proprioception: bool = False


def sft_features(choice: RowChoice) -> datasets.Features:
    """Columns of the dataset."""
    return datasets.Features({**SFT_COLUMNS, **(PROPRIOCEPTION_COLUMNS if choice.proprioception else {})})


def sft_rows(episodes: Sequence[tuple[str, Episode]], choice: RowChoice, workers: int) -> Iterator[list[dict[str, Any]]]:
    """Rows of each episode, in the order given; none for an episode that went otherwise than in the ledger.

    Args:
        episodes: name of the run, and an episode of it.
        choice: what becomes a row.
        workers: processes; 0 acts out in this one.
    """
    jobs = [_Job(number, run, episode) for number, (run, episode) in enumerate(episodes)]
    waiting: dict[int, list[dict[str, Any]]] = {}
    following = 0
    with tqdm(total=len(jobs), desc="acting out", unit="episode") as bar:
        for result in run_jobs(functools.partial(_Maker, choice), jobs, workers, _never, _lost):
            if result.error:
                logger.warning("%s is left out: %s", jobs[result.number].episode.record.task, result.error)
            waiting[result.number] = result.rows
            bar.update(1)
            while following in waiting:
                yield waiting.pop(following)
                following += 1


@dataclass(frozen=True, slots=True)
class _Job:
    number: int
    run: str
    episode: Episode


@dataclass(frozen=True, slots=True)
class _Result:
    number: int
    rows: list[dict[str, Any]]
    error: str = ""


class _Maker:
    """Makes the rows of episodes in a worker process."""

    def __init__(self, choice: RowChoice) -> None:
        self._choice = choice

    def __call__(self, job: _Job) -> _Result:
        try:
            return self._rows(job)
        except (ValueError, RuntimeError) as error:  # the simulator or its grammar has changed
            return _Result(job.number, [], f"could not be acted out again: {error}")

    def _rows(self, job: _Job) -> _Result:
        size, rows = self._choice.size, []
        reenactment = Reenactment(job.episode)
        before: tuple[Observation, NDArray[np.uint8]] | None = None
        for moment in reenactment.moments():
            if moment.differs:
                again, ledger = (", ".join(code or "ok" for code in codes) for codes in (moment.codes, moment.expected))
                return _Result(job.number, [], f"step {moment.number} gave {again}, the ledger says {ledger}")
            if before is not None and moment.feedback is not None and (moment.feedback.success or self._choice.failed_steps):
                rows.append(self._row(job, before, moment, moment.feedback.success))
            before = (moment.observation, reenactment.session.world.cameras.render("head", size, size).rgb)
        return _Result(job.number, rows)

    def _row(self, job: _Job, before: tuple[Observation, NDArray[np.uint8]], moment: Moment, success: bool) -> dict[str, Any]:
        seen, picture = before
        record, task = job.episode.record, job.episode.task
        prompt = plan_prompt(
            seen.instruction, seen.robot, seen.visible_objects, seen.known_objects, seen.history, seen.step, seen.time_limit,
            self._choice.history,
        )  # fmt: skip
        row: dict[str, Any] = {
            "messages": to_chat(with_answer(prompt, moment.text)),
            "images": [{"bytes": encode_png(picture), "path": None}],
            "run": job.run,
            "episode": episode_id(record),
            **{name: getattr(record, name) for name in ("task", "category", "robot", "difficulty", "planner", "trial", "seed")},
            "family": task.family,
            "room": task.room,
            "episode_success": record.outcome is Outcome.SUCCESS,
            "step": seen.step,
            "time_limit": seen.time_limit,
            "step_success": success,
            "instruction": seen.instruction,
            "visible": list(seen.visible_objects),
            "known": list(seen.known_objects),
            "history": [{"step": item.step, "feedback": item.feedback} for item in seen.history],
            "target": moment.text,
        }
        if self._choice.proprioception:
            own = seen.proprioception
            arrays = {"motion": own.motion, "key_bodies": own.key_bodies_in_pelvis, "joint_positions": own.joint_positions}
            row |= {name: np.asarray(array, dtype=np.float32).ravel().tolist() for name, array in arrays.items()}
        return row


def _never(result: _Result) -> bool:
    return False


def _lost(job: _Job, message: str) -> _Result:
    return _Result(job.number, [], message)
