"""Every YAML below configs/ is composed and validated, and counted, so that a new one cannot escape."""

from __future__ import annotations

from pathlib import Path

import pytest

from configs.compose import CONFIG_DIR, compose, groups
from configs.schema.eval import EvalConfig
from configs.schema.train import TrainConfig
from configs.validate import ConfigError, build
from sim.session.contingency import load_contingency

ROOTS = {"train": TrainConfig, "eval": EvalConfig}
#: Which root a group belongs to; `contingency` is data that the simulator reads.
GROUP_ROOT = {
    "model": "train",
    "budget": "train",
    "data": "train",
    "planner": "eval",
    "backend": "eval",
    "robot": "eval",
    "experiment": "eval",
}
#: What a user must add to a configuration that has no default for it.
NEEDS = {
    "humanml3d": ("data.path=HumanML3D",),
    "amass": ("data.path=AMASS", "data.body_models=models"),
    "folder": ("data.path=motions",),
    "qwen2_5_vl": ("backend.model=folder", "workers=0"),
    "internvl2_5": ("backend.model=folder", "workers=0"),
    "backend/vllm": ("backend.model=model",),
    "file": ("planner.source=examples/own_planner.py:Nearby",),
    "backend/scripted": ("backend.source=answers.py:answer",),
}
ALL = sorted(path.relative_to(CONFIG_DIR) for path in CONFIG_DIR.rglob("*.yaml"))


def test_count() -> None:
    assert len(ALL) == 45, f"configs/ holds {len(ALL)} YAML files: {[str(path) for path in ALL]}"
    assert set(groups()) == {*GROUP_ROOT, "contingency"}


@pytest.mark.parametrize("path", ALL, ids=str)
def test_every_yaml_composes(path: Path) -> None:
    if path.parent == Path():
        build(ROOTS[path.stem], compose(path.stem))
        return
    group, name = path.parent.name, path.stem
    if group == "contingency":
        load_contingency(name)
        return
    root = GROUP_ROOT[group]
    planner = ["planner=dag_plan"] if group == "backend" else []
    build(ROOTS[root], compose(root, [*planner, f"{group}={name}", *NEEDS.get(f"{group}/{name}", NEEDS.get(name, ()))]))


@pytest.mark.parametrize(
    ("root", "override", "message"),
    [
        ("train", "stage=nap", r"stage: 'nap' is not allowed; allowed: all, data"),
        ("train", "model=giant", r"model='giant' is not allowed; allowed: qwen2_5_vl_3b, qwen2_5_vl_7b, tiny"),
        ("train", "stagee=all", r"stagee: unknown key in 'stagee=all'; allowed: .*stage"),
        ("train", "model.mpe.mode=none", r"model\.mpe: mode|model\.mpe\.mode: 'none' is not allowed; allowed: mrope"),
        ("eval", "planner=oracle", r"planner='oracle' is not allowed; allowed: base, dag_plan, expert"),
        ("eval", "robot=atlas", r"robot='atlas' is not allowed; allowed: h1, x1"),
        ("eval", "backend=none", r"backend='none' is not allowed; allowed: gemini, gpt4o"),
        ("eval", "backend=vllm", r"backend\.model has no value; set backend\.model=… \(vllm: .*give the name"),
        ("eval", "planner=qwen2_5_vl", r"backend\.model has no value; set .* \(qwen2_5_vl: .*backend\.model=FOLDER"),
        ("eval", "backend=serve", r"backend 'serve' with planner kind 'mllm', which asks none; allowed: none, or a planner of"),
        ("eval", "planner.horizon=2", r"planner\.horizon: unknown key with kind 'mllm'; allowed: adapter, blind, insist, kind"),
        ("eval", "planner.kind=plainn", r"planner\.kind: 'plainn' is not allowed; .*did you mean 'plain'"),
        ("eval", "planner=random planner.image_size=8", r"image_size 8 outside \[16, 2048\]"),
        ("eval", "planner=random cost_cap_usd=1", r"cost_cap_usd 1\.0 with planner kind 'random', which asks no backend"),
        (
            "eval",
            "planner=gpt4o backend.constrained=true",
            r"kind 'openai' with constrained True; allowed: False, others with local",
        ),
        (
            "eval",
            "planner=qwen2_5_vl backend.model=x backend.retries=1",
            r"kind 'local' with retries 1; allowed: 4, others with openai",
        ),
        ("eval", "cost_cap_usd=nan", r"cost_cap_usd nan must be null or a finite number of at least 0"),
        ("eval", "cost_cap_usd=-1", r"cost_cap_usd -1\.0 must be null or a finite number"),
        ("eval", "trials=0", r"trials 0 must be positive"),
        ("train", "alignment.mask=1.5", r"mask 1\.5 outside \[0, 1\]"),
        ("eval", "trials", r"override 'trials': expected key=value"),
        ("eval", "=3", r"override '=3': expected key=value"),
        ("eval", "~=3", r"override '~=3': expected key=value"),
        ("eval", "output=/home/josé/runs", r"override 'output=/home/josé/runs' cannot be read; .*quotes: \"key='value'\""),
        ("eval", "planner=gpt4o backend.model=a(b", r"override 'backend\.model=a\(b' cannot be read"),
        ("eval", "planner=gpt4o planner.replans=${absent}", r"Interpolation key 'absent' not found"),
        (
            "eval",
            "planner=random planner.reflection=off",
            r"planner\.reflection: unknown key with kind 'random'",
        ),
        ("eval", "planner=gpt4o backend.timeout_s=inf", r"timeout_s inf outside \(0, 86400\]"),
        ("train", "seed=12345", r"seed 12345 outside \[0, 2000\]"),
        ("train", "selu.rounds=0", r"rounds 0 must be positive"),
        ("train", "selu.temperature=0", r"temperature 0\.0 must be positive"),
        ("train", "model.motion.window=128", r"window 128 must be at most 64"),
        ("eval", "planner.colour=red", r"planner\.colour: unknown key"),
        ("eval", "experiment=main_table experiment.robots=[]", r"experiment: robots \(\) must name at least one"),
        ("eval", "experiment=main_table experiment.difficulties=[]", r"difficulties \(\) must name at least one"),
    ],
)
def test_wrong_entries_stop_at_once(root: str, override: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        build(ROOTS[root], compose(root, override.split()))


def test_unknown_root() -> None:
    with pytest.raises(ConfigError, match="no root config 'sleep'; allowed: eval, train"):
        compose("sleep")


@pytest.mark.parametrize(
    "override",
    [
        "tokenizer.checkpoint_every=7",
        "alignment.joint.minutes=3",
        "selu.rollouts.workers=64",
        "practice.workers=1",
        "logger.project=mine",
        "model.point_map.size=64",
    ],
)
def test_fields_that_a_file_leaves_at_their_defaults_may_be_set(override: str) -> None:
    name, _, value = override.partition("=")
    field: object = build(TrainConfig, compose("train", [override]))
    for part in name.split("."):
        field = getattr(field, part)
    assert str(field) in (value, f"{value}.0")
