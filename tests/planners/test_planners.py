"""Replies, the random planner, the registry, and models that stay apart from what they must not see."""

from __future__ import annotations

import ast
from pathlib import Path

import numpy as np
import pytest

from configs.compose import CONFIG_DIR, compose
from configs.schema.eval import EvalConfig
from configs.schema.planner import CHAT_KINDS, PLANNER_KINDS, BuiltInPlanner
from configs.validate import build
from interface.actions import ACTIONS
from interface.observation import Camera, Observation, Proprioception
from interface.steps import PlanStep
from proprio_mllm.planners.protocol import Planner, TaskInfo, WeightsError, check_weights, parse_reply
from proprio_mllm.planners.random_planner import RandomPlanner
from proprio_mllm.planners.registry import CHAT_PLANNERS, make_planner

INFO = TaskInfo("pick up the mug", "h1", 9)


def observation(visible: tuple[str, ...] = ("Mug_1",), known: tuple[str, ...] = ("Mug_1", "Fridge_1")) -> Observation:
    body = Proprioception(np.zeros((64, 48), np.float32), 20.0, np.zeros(3), np.zeros((14, 3)))
    camera = Camera(np.eye(3), np.eye(4), 112, 112)
    return Observation("pick up the mug", "h1", np.zeros((112, 112, 3), np.uint8), camera, visible, known, body, (), 0, 9)


def test_parse_reply_reads_the_first_line() -> None:
    reply = parse_reply("\n Pick(left, Mug_1) & Open(right, Fridge_1) \nbecause", 7, 0.5)
    assert reply.step == PlanStep.parse("Pick(left, Mug_1) & Open(right, Fridge_1)")
    assert (reply.tokens, reply.latency_s, reply.error) == (7, 0.5, "")


@pytest.mark.parametrize("text", ["", "pick the mug", "Pick(left, Mug_1); Done()", "Jump()"])
def test_parse_reply_keeps_what_it_cannot_read(text: str) -> None:
    reply = parse_reply(text)
    assert reply.step is None
    assert reply.text == text
    assert reply.error


def test_random_steps_are_legal_and_use_known_names() -> None:
    planner = RandomPlanner()
    planner.reset(INFO, np.random.default_rng(0))
    names: set[str] = set()
    for _ in range(400):
        reply = planner.step(observation(), None)
        assert reply.step is not None
        assert PlanStep.parse(reply.step.to_text()).to_text() == reply.step.to_text()
        for action in reply.step.actions:
            names.add(action.name)
            allowed = {"GoTo": ("Mug_1", "Fridge_1")}.get(action.name, ("Mug_1",))
            assert action.object_id is None or action.object_id in allowed
    assert names == set(ACTIONS) - {"Done"}


def test_random_depends_on_the_generator_only() -> None:
    def texts(seed: int) -> list[str]:
        planner = RandomPlanner()
        planner.reset(INFO, np.random.default_rng(seed))
        return [planner.step(observation(), None).text for _ in range(20)]

    assert texts(1) == texts(1)
    assert texts(1) != texts(2)


def test_random_without_any_name_moves_only() -> None:
    planner = RandomPlanner()
    planner.reset(INFO, np.random.default_rng(0))
    for _ in range(50):
        reply = planner.step(observation((), ()), None)
        assert reply.step is not None
        assert all(action.object_id is None for action in reply.step.actions)


def test_every_configured_planner_is_made_somewhere() -> None:
    kinds = set()
    for path in sorted((CONFIG_DIR / "planner").glob("*.yaml")):
        needs = ["backend.model=folder", "workers=0"] if path.stem in ("qwen2_5_vl", "internvl2_5") else []
        needs += ["planner.source=own.py:Own"] if path.stem == "file" else []
        cfg = build(EvalConfig, compose("eval", [f"planner={path.stem}", *needs]))
        assert cfg.planner.name == path.stem
        assert (cfg.backend is not None) == (cfg.planner.kind in CHAT_PLANNERS)
        kinds.add(cfg.planner.kind)
    assert kinds == set(PLANNER_KINDS)
    assert set(CHAT_KINDS) == set(CHAT_PLANNERS)


def test_registry() -> None:
    assert isinstance(make_planner(BuiltInPlanner("r", "random", "R", image_size=56)), Planner)
    with pytest.raises(ValueError, match=r"'expert' is not made here; allowed: file, mllm, random, scripted"):
        make_planner(BuiltInPlanner("e", "expert", "E"))


def test_weights_are_checked(tmp_path: Path) -> None:
    with pytest.raises(WeightsError, match=r"nothing.*make them with `python train\.py`"):
        check_weights(tmp_path / "nothing", "python train.py")
    (tmp_path / "config.json").write_text("{}")
    assert check_weights(tmp_path, "") == tmp_path


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"kind": "mllm"}, "planner.weights: missing"),
        ({"kind": "mllm", "weights": "x", "temperature": -1.0}, "temperature -1.0"),
        ({"name": "a b"}, "'a b'"),
        ({"weights": "x"}, "planner.weights: unknown key with kind 'random'; allowed: image_size, kind"),
        ({"kind": "file"}, "planner.source: missing"),
        ({"kind": "rap", "memory": "x", "examples": 0}, "examples 0 must be at least 1"),
        ({"kind": "plains"}, "planner.kind: 'plains' is not allowed; .*did you mean 'plain'"),
    ],
)
def test_config_refuses(change: dict, message: str) -> None:
    planner = {"name": "p", "kind": "random", "label": "P"} | change
    with pytest.raises(ValueError, match=message):
        build(EvalConfig, {"planner": planner, "robot": {"name": "h1"}})


def test_planners_never_import_the_simulator() -> None:
    folder = Path(__file__).parents[2] / "proprio_mllm" / "planners"
    for path in folder.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            names = [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            names += [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            assert not any(name.split(".")[0] in ("sim", "mujoco") or "evaluation" in name for name in names), path
