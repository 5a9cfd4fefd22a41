"""Runs on disk with a readable configuration, real tasks and any traces: what reports are made of, without a simulator."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from configs.schema.eval import EvalConfig
from configs.schema.planner import BuiltInPlanner, FilePlanner
from configs.schema.robot import RobotConfig
from interface.episode import EpisodeRecord, Outcome
from interface.failures import FailureCategory
from proprio_mllm.evaluation.ledger import Ledger
from proprio_mllm.evaluation.run import evaluate, plan_episodes
from sim.tasks.predicates import Predicate
from sim.tasks.task import Placement, Start, Task, write_tasks

__all__ = ["HOSTILE", "LAMP", "PLANT", "PLANT_REPLIES", "failed", "fine", "record_of", "scripted_run", "step", "write_run"]

#: What a model may write: it would end the page's data and start a script of its own if it were not escaped.
HOSTILE = "</script><img src=x onerror=\"document.title='taken'\"><!-- {{ 7 * 7 }} 'quoted' & \u2028"

LAMP = Task(
    id="lamp",
    room="living_room_1",
    category="single",
    family="pick",
    instruction="Pick up the <b>mug</b>.",
    start=Start(0.0, 0.0, 0.0, {"h1": 0.95, "x1": 0.7}),
    placements=(Placement("Mug_1", "Mug", "CoffeeTable_1"),),
    goals=(Predicate("held", "Mug_1"), Predicate("not", of=(Predicate("open", "Drawer_1"),))),
    time_limit=6,
    split="seen",
    seed=4,
)


#: One reply is no action, then the body is too low for H1's arms, then it is not.
PLANT = Task(
    id="plant",
    room="kitchen_1",
    category="essential",
    family="lift",
    instruction="Lift the <b>plant</b> with both hands.",
    start=Start(2.6, 0.1, -110.0, {"h1": 0.7, "x1": 0.43}),
    placements=(Placement("HousePlant_1", "HousePlant", "DiningTable_1", (2.29, -0.83)),),
    goals=(Predicate("lifted", "HousePlant_1"), Predicate("not", of=(Predicate("open", "Fridge_1"),))),
    time_limit=7,
    split="seen",
    seed=21001,
)
PLANT_REPLIES = ("GoTo(HousePlant_1)", HOSTILE, "Lift(HousePlant_1)", "MoveUp(0.05)", "Lift(HousePlant_1)")


def fine(action: str) -> dict[str, Any]:
    return {"action": action, "ok": True, "code": "", "category": None, "margins": {}, "contingency": ""}


def failed(action: str, code: str, category: str, contingency: str = "", **margins: float) -> dict[str, Any]:
    outcome = {"action": action, "ok": False, "code": code, "category": category}
    return outcome | {"margins": margins, "contingency": contingency}


def step(*outcomes: dict[str, Any], text: str = "") -> dict[str, Any]:
    words = text or " & ".join(outcome["action"] for outcome in outcomes)
    return {"step": words, "outcomes": list(outcomes), "duration_s": 1.5}


def _config(tmp_path: Path, tasks: Sequence[Task], robot: str, source: str | None = None) -> EvalConfig:
    tmp_path.mkdir(parents=True, exist_ok=True)
    write_tasks(tasks, tmp_path / "tasks.jsonl")
    planner = BuiltInPlanner("random", "random", "Random")
    if source is not None:
        planner = FilePlanner("own", "file", f"Own {HOSTILE}", source=source)
    return EvalConfig(planner, RobotConfig(robot), workers=0, tasks=str(tmp_path / "tasks.jsonl"), output=str(tmp_path))


def record_of(task: Task, robot: str, config_hash: str, success: bool, trace: Sequence[Any], **change: Any) -> EpisodeRecord:
    values: dict[str, Any] = {
        "planner": "random", "robot": robot, "task": task.id, "category": task.category, "difficulty": "easy", "trial": 0,
        "seed": 0, "config_hash": config_hash, "outcome": Outcome.SUCCESS if success else Outcome.FAILURE,
        "failure": None if success else FailureCategory.LOGICAL, "invalid_output": 0, "budget_exhausted": not success,
        "goal_conditions_met": float(success), "steps": len(trace), "makespan_s": 1.5 * len(trace), "path_length_m": 1.0,
        "arm_utilisation": 0.25, "planner_calls": len(trace), "planner_tokens": 40, "planner_s": 0.5, "wall_s": 1.0,
        "trace": tuple(trace),
    }  # fmt: skip
    return EpisodeRecord(**(values | change))


def write_run(
    folder: Path, tasks: Sequence[Task], traces: Sequence[tuple[bool, Sequence[Any]]], robot: str = "x1", **change: Any
) -> Path:
    """A run with one episode per task; `traces` says whether it succeeded, and its steps."""
    cfg = _config(folder.parent, tasks, robot)
    jobs = plan_episodes(cfg, tasks, "")
    records = [
        record_of(task, robot, job.fields.config_hash, success, trace, **change)
        for task, job, (success, trace) in zip(tasks, jobs, traces, strict=True)
    ]
    with Ledger(folder / "ledger.jsonl") as ledger:
        for record in records:
            ledger.append(record)
    meta = {
        "version": 1, "planner": "random", "label": "Random", "privileged": False, "robot": robot, "difficulty": "easy",
        "contingencies": "default", "category": "all", "trials": 1, "limit": None, "start": "fixed", "steps": 50,
        "stuck": 8, "seed": 0,
        "tasks": cfg.tasks, "weights": None, "weights_digest": "", "config_hash": "c",
        "command": "python eval.py planner=random",
        "planned": [[record.task, record.category, record.trial, record.config_hash] for record in records],
        "config": dataclasses.asdict(cfg),
    }  # fmt: skip
    (folder / "run.json").write_text(json.dumps(meta))
    return folder


_SCRIPTED = """
from proprio_mllm.planners.protocol import parse_reply

REPLIES = {replies!r}


class Scripted:
    privileged, image_size = False, 112

    def reset(self, task, rng):
        self.number = 0

    def step(self, observation, feedback):
        self.number += 1
        return parse_reply(REPLIES[self.number - 1], tokens=7)
"""


def scripted_run(tmp_path: Path, replies: Sequence[str] = PLANT_REPLIES, task: Task = PLANT, robot: str = "h1") -> Path:
    """A run in the real simulator by a planner that says what it was told to."""
    tmp_path.mkdir(parents=True, exist_ok=True)
    source = tmp_path / "scripted.py"
    source.write_text(_SCRIPTED.format(replies=list(replies)))
    return evaluate(_config(tmp_path, [task], robot, f"{source}:Scripted")).folder
