from pathlib import Path

import pytest

import configs
from configs.compose import compose
from configs.schema.model import ModelConfig
from configs.schema.train import TrainConfig
from configs.validate import build
from proprio_mllm.model.building import build_model, build_processor

FOLDER = Path(configs.__file__).parent / "model"
NAMES = sorted(path.stem for path in FOLDER.glob("*.yaml"))


def _load(name: str) -> ModelConfig:
    return build(TrainConfig, compose("train", [f"model={name}"])).model


def test_every_model_config_is_valid():
    assert NAMES == ["qwen2_5_vl_3b", "qwen2_5_vl_7b", "tiny"]
    for name in NAMES:
        assert _load(name).name == name


def test_configs_share_the_motion_features():
    motion = pytest.importorskip("data.motion")
    assert {_load(name).motion.features for name in NAMES} == {len(motion.FEATURES)}


def test_tiny_is_tiny_but_whole():
    cfg = _load("tiny")
    model = build_model(cfg, build_processor(cfg, ["put the mug into the fridge"] * 3, ["Mug"]))
    assert 5e6 < sum(parameter.numel() for parameter in model.parameters()) < 1e7
    assert model.cse is not None
    assert model.point_map is not None
