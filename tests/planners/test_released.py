"""The weights in the repository: each is what its name says, says where it comes from, and plans."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from pathlib import Path

import numpy as np
import pytest
import yaml
from peft import PeftModel

from configs.compose import compose
from configs.schema.eval import EvalConfig
from configs.schema.planner import ModelPlanner
from configs.schema.robot import RobotConfig
from configs.schema.train import TrainConfig
from configs.validate import build
from data.files import read_json
from interface.observation import Observation
from proprio_mllm.evaluation.run import evaluate
from proprio_mllm.evaluation.sessions import open_session
from proprio_mllm.model.building import build_point_map, load_model
from proprio_mllm.model.tensors import read_tensors
from proprio_mllm.planners.protocol import TaskInfo
from proprio_mllm.planners.random_planner import RandomPlanner
from proprio_mllm.planners.registry import make_planner
from proprio_mllm.planners.words import WordsPlanner
from proprio_mllm.training.card import model_card
from sim.tasks.task import load_benchmark, write_tasks

WEIGHTS = Path(__file__).parents[2] / "weights" / "tiny"
#: Position embedding, cross-spatial encoder, motion tokens.
PARTS = {
    "base": ("mrope", False, False),
    "full": ("rope_sign", True, True),
}
EPISODES = ["words", "practice", "base", "pointmap", "tokenizer", "alignment"]


@pytest.fixture(scope="module")
def first() -> Observation:
    """What a planner sees at the start of the benchmark's first task."""
    task = load_benchmark()[0]
    return open_session(RobotConfig("h1"), "easy", "fixed", task, 0, RandomPlanner(112)).reset(0)


def test_every_folder_is_known() -> None:
    assert sorted(path.name for path in WEIGHTS.iterdir()) == sorted((*PARTS, "words", "pointmap"))


def test_the_point_map_knows_the_words_of_the_released_planner() -> None:
    about, words = read_json(WEIGHTS / "pointmap" / "config.json"), load_model(WEIGHTS / "words")
    assert about["words"] == hashlib.sha256(words.table.detach().half().numpy().tobytes()).hexdigest()
    cfg = build(TrainConfig, compose("train", ["model=tiny"])).model
    encoder = build_point_map(cfg)
    assert encoder is not None
    encoder.load_state_dict(read_tensors(WEIGHTS / "pointmap" / "model.safetensors"))
    told = json.loads((WEIGHTS / "pointmap" / "provenance.json").read_text())["stages"]
    assert list(told) == ["words", "practice", "pointmap"]
    assert told["pointmap"]["metrics"]["names_accuracy"] > 0.9


def test_words_alone_plan(first: Observation) -> None:
    planner = WordsPlanner.load(WEIGHTS / "words")
    planner.reset(TaskInfo(first.instruction, first.robot, first.time_limit), np.random.default_rng(0))
    reply = planner.step(first, None)
    assert reply.step is not None
    assert reply.step.actions[0].name != "Done"
    about = json.loads((WEIGHTS / "words" / "provenance.json").read_text())
    assert list(about["stages"]) == ["words", "practice"]
    assert about["stages"]["practice"]["metrics"]["held_out_exact_logged"] > 0.8


@pytest.mark.parametrize("name", PARTS)
def test_it_plans_with_the_parts_of_its_name(name: str, first: Observation) -> None:
    planner = make_planner(ModelPlanner("m", "mllm", "M", str(WEIGHTS / name)))
    assert isinstance(planner, WordsPlanner)
    cfg = planner.model.cfg
    assert not isinstance(planner.model.vlm, PeftModel), "its adapter is folded in"
    assert cfg.sees
    assert (cfg.mpe.mode, cfg.cse.enabled, cfg.proprioception) == PARTS[name]
    planner.reset(TaskInfo(first.instruction, first.robot, first.time_limit), np.random.default_rng(0))
    reply = planner.step(first, None)
    assert reply.step is not None, reply.text


@pytest.mark.parametrize("name", PARTS)
def test_it_says_where_it_comes_from(name: str) -> None:
    files = [path for path in (WEIGHTS / name).rglob("*") if path.is_file()]
    assert sum(path.stat().st_size for path in files) < 30e6
    assert {path.suffix for path in files} <= {".json", ".jinja", ".md", ".safetensors"}
    note = json.loads((WEIGHTS / name / "provenance.json").read_text())
    assert note["seed"] == 0
    assert {"views", "clips"} <= set(note["shards"])
    assert list(note["stages"]) == (EPISODES[:3] if name == "base" else EPISODES)
    for stage in note["stages"].values():
        assert stage["command"].startswith("python train.py stage=")
        assert stage["metrics"]["seconds"] > 0
    assert note["variant"] == ("full" if name == "base" else name)


@pytest.mark.parametrize("name", ["words", *PARTS])
def test_its_card_says_what_its_provenance_does(name: str) -> None:
    text = (WEIGHTS / name / "README.md").read_text()
    assert text == model_card(json.loads((WEIGHTS / name / "provenance.json").read_text()))
    _, front, body = text.split("---\n", 2)
    assert (
        yaml.safe_load(front)["license"] == "apache-2.0" and f"# Proprio-MLLM tiny, {name.removesuffix('-alignment')}\n" in body
    )
    (command,) = (line.split("eval.py ")[1].split() for line in body.splitlines() if line.startswith("    python eval.py"))
    assert build(EvalConfig, compose("eval", command)).planner.kind == "mllm"


def test_the_model_plans_alike_alone_and_in_a_batch(tmp_path: Path) -> None:
    """Rows are not equal to the last bit (sums are rounded in another order); the plans are, over whole episodes."""
    everything = load_benchmark()
    tasks = [dataclasses.replace(everything[i * len(everything) // 3], time_limit=1 + i) for i in range(3)]
    write_tasks(tasks, tmp_path / "tasks.jsonl")
    planner = ModelPlanner("proprio", "mllm", "P", str(WEIGHTS / "full"))
    cfg = EvalConfig(planner, RobotConfig("h1"), workers=0, tasks=str(tmp_path / "tasks.jsonl"), output=str(tmp_path / "1"))
    runs = [evaluate(cfg), evaluate(dataclasses.replace(cfg, batch=3, output=str(tmp_path / "3")))]
    alone, together = ([dataclasses.replace(r, planner_s=0.0, wall_s=0.0) for r in run.records] for run in runs)
    assert len(alone) == 3
    assert together == alone
