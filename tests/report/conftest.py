"""Runs on disk, made without a simulator."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from interface.episode import EpisodeRecord, Outcome
from interface.failures import FailureCategory
from proprio_mllm.evaluation.ledger import Ledger
from tests.report.ledgers import scripted_run

CATEGORIES = ("single", "optional", "essential")


def make_record(task: str, category: str, success: bool, trial: int = 0, **change: object) -> EpisodeRecord:
    values: dict = {
        "planner": "random",
        "robot": "h1",
        "task": task,
        "category": category,
        "difficulty": "easy",
        "trial": trial,
        "seed": 0,
        "config_hash": "c",
        "outcome": Outcome.SUCCESS if success else Outcome.FAILURE,
        "failure": None if success else FailureCategory.NAVIGATION,
        "invalid_output": 1,
        "budget_exhausted": not success,
        "goal_conditions_met": 1.0 if success else 0.5,
        "steps": 4,
        "makespan_s": 8.0,
        "path_length_m": 1.5,
        "arm_utilisation": 0.25,
        "planner_calls": 5,
        "planner_tokens": 200,
        "planner_s": 0.5,
        "wall_s": 1.0,
    }
    return EpisodeRecord(**(values | change))


def store_run(folder: Path, records: list[EpisodeRecord], **change: object) -> Path:
    """A run's folder with these records, planned and scored; `change` replaces entries of run.json."""
    first = records[0]
    with Ledger(folder / "ledger.jsonl") as ledger:
        for record in records:
            ledger.append(record)
    meta = {
        "version": 1,
        "planner": first.planner,
        "label": first.planner.title(),
        "privileged": first.planner == "expert",
        "robot": first.robot,
        "difficulty": first.difficulty,
        "contingencies": "default",
        "category": "all",
        "trials": 1,
        "limit": None,
        "start": "fixed",
        "steps": 50,
        "stuck": 8,
        "seed": 0,
        "tasks": "benchmark",
        "weights": None,
        "weights_digest": "",
        "config_hash": "c",
        "command": f"python eval.py planner={first.planner} robot={first.robot}",
        "planned": [[record.task, record.category, record.trial, record.config_hash] for record in records],
        "config": {},
    }
    (folder / "run.json").write_text(json.dumps(meta | change))
    return folder


def make_run(
    output: Path, planner: str = "random", robot: str = "h1", difficulty: str = "easy", seed: int = 0, **change: object
) -> Path:
    rng = np.random.default_rng(seed)
    folder = output / "eval" / f"{planner}-{robot}-{difficulty}"
    kinds = list(FailureCategory)
    records = []
    for i in range(12):
        success = bool(rng.random() < 0.5)
        failure = None if success else kinds[int(rng.integers(3))]
        own = {"planner": planner, "robot": robot, "difficulty": difficulty, "failure": failure}
        records.append(make_record(f"t{i}", CATEGORIES[i % 3], success, **own))
    return store_run(folder, records, **change)


@pytest.fixture
def record() -> Callable[..., EpisodeRecord]:
    return make_record


@pytest.fixture
def run() -> Callable[..., Path]:
    return make_run


@pytest.fixture(scope="session")
def acted_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run in the simulator: what a model wrote is hostile, then the body is too low for the plant, then it is lifted."""
    return scripted_run(tmp_path_factory.mktemp("acted"))


@pytest.fixture
def store() -> Callable[..., Path]:
    return store_run
