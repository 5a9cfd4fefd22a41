"""Small synthetic shards and a small model, so that every stage runs in seconds."""

from __future__ import annotations

import dataclasses
import json
import shutil
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from configs.compose import compose
from configs.schema.model import (
    LoraConfig,
    ModelConfig,
    MotionTokenizerConfig,
    PointMapConfig,
    TinyTextConfig,
    TinyVisionConfig,
)
from configs.schema.train import TrainConfig
from configs.validate import build
from data.motion import N_FEATURES
from data.shards import ShardReader, ShardWriter, encode_png
from interface.observation import Camera, Observation, Proprioception
from proprio_mllm.evaluation.lessons import Lessons
from proprio_mllm.training.pipeline import Pipeline
from proprio_mllm.training.rollouts import DaggerRequest, RolloutRequest, rollout_row
from proprio_mllm.training.stages import STAGES

TYPES = ("Mug", "Plate", "Fridge", "CoffeeTable", "Lamp")
SIZE = 112
COLOURS = np.array([[220, 40, 40], [40, 220, 40], [40, 40, 220], [200, 180, 40], [40, 200, 200]], dtype=np.uint8)
POSE = np.array([[0, 0, 1, 0.1], [-1, 0, 0, 0.0], [0, -1, 0, 0.6], [0, 0, 0, 1]], dtype=np.float64)
K = np.array([[60.0, 0, 56], [0, 60, 56], [0, 0, 1]])


def motion_window(rng: np.random.Generator, frames: int = 64) -> NDArray[np.float32]:
    """A smooth window whose key bodies form a plausible body."""
    base = np.zeros(N_FEATURES, dtype=np.float32)
    left = [[0, 0.2, 0.45], [0.1, 0.25, 0.2], [0.3, 0.25, 0.1]]
    leg = [[0, 0.1, 0], [0.05, 0.1, -0.4], [0, 0.1, -0.8]]
    mirror = np.array([1, -1, 1])
    keys = np.concatenate([[[0, 0, 0.3], [0, 0, 0.7]], left, np.array(left) * mirror, leg, np.array(leg) * mirror])
    base[:42] = keys.ravel()
    base[42] = 0.95
    wave = np.sin(np.linspace(0, rng.uniform(1, 6), frames) + rng.uniform(0, 6))[:, None] * rng.normal(0, 0.03, N_FEATURES)
    return (base + wave).astype(np.float32)


def scene(
    rng: np.random.Generator,
) -> tuple[NDArray[np.uint8], NDArray[np.int16], NDArray[np.float32], list[dict[str, object]]]:
    """Coloured squares in front of a wall 3 m away: image, segmentation, depth, objects."""
    image = np.full((SIZE, SIZE, 3), 120, dtype=np.uint8)
    segmentation = np.full((SIZE, SIZE), -1, dtype=np.int16)
    depth = np.full((SIZE, SIZE), 3.0, dtype=np.float32)
    objects: list[dict[str, object]] = []
    for kind in rng.permutation(len(TYPES))[:3]:
        row, col = (int(v) for v in rng.integers(0, SIZE - 24, 2))
        z = float(rng.uniform(0.6, 2.5))
        image[row : row + 24, col : col + 24] = COLOURS[kind]
        segmentation[row : row + 24, col : col + 24] = kind
        depth[row : row + 24, col : col + 24] = z
        point = np.array([(col + 12 - 56) / 60 * z, (row + 12 - 56) / 60 * z, z, 1.0])
        centre = (POSE @ point)[:3]
        objects.append(
            {
                "id": f"{TYPES[kind]}_1",
                "type": TYPES[kind],
                "center_in_pelvis": [float(v) for v in centre],
                "pixels": int((segmentation == kind).sum()),
                "bbox": [col, row, col + 24, row + 24],
            }
        )
    return image, segmentation, depth, objects


def write_views(folder: Path, count: int = 40) -> Path:
    rng = np.random.default_rng(1)
    rows = []
    for seed in range(count):
        image, segmentation, depth, objects = scene(rng)
        rows.append(
            {
                "image": encode_png(image),
                "depth": depth.astype("<f2").tobytes(),
                "segmentation": segmentation.astype("<i2").tobytes(),
                "height": SIZE,
                "width": SIZE,
                "intrinsics": K.ravel(),
                "camera_in_pelvis": POSE.ravel(),
                "robot": "h1",
                "room": "kitchen_1",
                "seed": seed,
                "motion": motion_window(rng),
                "objects": json.dumps(objects),
            }
        )
    writer = ShardWriter(folder, "views", "test")
    writer.write(0, rows)
    writer.finish({"type_names": list(TYPES)})
    return folder


PLAN = ("GoTo(Mug_1)", "MoveDown(0.2)", "Pick(left, Mug_1)", "Done()")


def write_lessons(folder: Path, episodes: int = 40) -> Path:
    rng = np.random.default_rng(2)
    rows = []
    for episode in range(episodes):
        image, _, _, objects = scene(rng)
        ids = [str(obj["id"]) for obj in objects]
        target = ids[episode % len(ids)]
        history: list[dict[str, str]] = []
        for step, template in enumerate(PLAN):
            text = template.replace("Mug_1", target)
            motion = motion_window(rng)
            rows.append(
                {
                    "episode": f"e{episode}",
                    "task": f"pick_{target}",
                    "split": "train",
                    "category": "single",
                    "robot": "h1",
                    "room": "kitchen_1",
                    "step": step,
                    "time_limit": 8,
                    "instruction": f"Pick up the {target.split('_')[0].lower()}.",
                    "image": encode_png(image),
                    "intrinsics": K.ravel(),
                    "camera_in_pelvis": POSE.ravel(),
                    "height": SIZE,
                    "width": SIZE,
                    "motion": motion,
                    "key_bodies": motion[-1, :42],
                    "visible": ids,
                    "known": [*ids, "CoffeeTable_2"],
                    "history": list(history),
                    "target": text,
                    "privileged": "{}",
                }
            )
            history.append({"step": text, "feedback": f"{text} ok"})
    writer = ShardWriter(folder, "demos", "test")
    writer.write(0, rows)
    writer.finish({"physics": 2})
    return folder


def write_clips(folder: Path, count: int = 40) -> Path:
    rng = np.random.default_rng(3)
    rows = []
    for number in range(count):
        image, _, depth, _ = scene(rng)
        frames = int(rng.integers(60, 90))
        picked = [frames // 2, frames - 1]
        rows.append(
            {
                "name": f"clip_{number}",
                "robot": ("h1", "x1")[number % 2],
                "motion": motion_window(rng, frames),
                "captions": ["the robot waves its left arm", "a wave with the left hand"],
                "images": [encode_png(image)] * 2,
                "depths": [depth.astype("<f2").tobytes()] * 2,
                "height": SIZE,
                "width": SIZE,
                "image_frames": picked,
                "intrinsics": K.ravel(),
                "cameras_in_pelvis": [POSE.ravel()] * 2,
                "room": "kitchen_1",
                "seed": number,
                "split": "train",
            }
        )
    writer = ShardWriter(folder, "clips", "test")
    writer.write(0, rows)
    writer.finish({})
    return folder


@pytest.fixture(autouse=True)
def one_thread() -> None:
    torch.set_num_threads(1)


@pytest.fixture(scope="session")
def shards(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with `views`, `lessons` and `clips`."""
    root = tmp_path_factory.mktemp("shards")
    write_views(root / "views", 60)
    write_lessons(root / "lessons")
    write_clips(root / "clips")
    return root


@pytest.fixture
def cfg() -> ModelConfig:
    return ModelConfig(
        name="test",
        vocab_size=400,
        text=TinyTextConfig(hidden=64, layers=2, heads=2, kv_heads=1, intermediate=96),
        vision=TinyVisionConfig(hidden=32, depth=2, heads=2, intermediate=48),
        lora=LoraConfig(rank=4, alpha=8),
        point_map=PointMapConfig(encoder="sim", width=32, depth=1),
        motion=MotionTokenizerConfig(codes=16, code_dim=8, width=16, depth=1),
    )


STEPS = (
    ("GoTo(Mug_1)", "GoTo(Mug_1) ok", True),
    ("Pick(left, Mug_1)", "Pick(left, Mug_1) ok", True),
    ("Place(left, CoffeeTable_1)", "Place(left, CoffeeTable_1) ok", True),
)


def collect(request: RolloutRequest) -> None:
    """Scripted episodes in place of the simulator: two tasks, of which the second is not what the robot did."""
    rng = np.random.default_rng(request.seed)
    ids = ("Mug_1", "Plate_1", "CoffeeTable_1")
    rows = []
    for number, text in enumerate(("Put the mug on the coffee table.", "Put the plate on the coffee table.")):
        observations = []
        steps = STEPS if number == 0 else (("MoveAhead(0.5)", "MoveAhead(0.5) ok", True), *STEPS)
        for step in range(len(steps) + 1):
            motion = motion_window(rng)
            proprioception = Proprioception(motion, 20.0, np.zeros(3), motion[-1, :42].reshape(14, 3).astype(np.float64))
            camera = Camera(K, POSE, 112, 112)
            image = scene(rng)[0]
            observations.append(Observation(text, "h1", image, camera, ids[:2], ids, proprioception, (), step, 8))
        truth = {"on CoffeeTable_1": ["Mug_1"], "held": []}
        keys = (f"e{number}", "t", "single", "kitchen_1", 1, "natural")
        rows.append(rollout_row(*keys, observations, steps, number == 0, truth))
    writer = ShardWriter(request.folder, "rollouts", request.config_hash, overwrite=True)
    writer.write(0, rows)
    writer.finish({})


def correct(request: DaggerRequest, workers: int) -> None:
    """Scripted corrections in place of the simulator: a student that is right on every second of its steps."""
    assert workers > 0
    source = ShardReader(request.folder.parent / "lessons", "demos")
    rows = []
    for number in range(12):
        row = dict(source[number])
        executed = row["target"] if number % 2 else "MoveAhead(0.5)"
        note = {"executed": executed, "origin": "student" if number < 8 else "teacher", "taught": row["target"]}
        rows.append({**row, "episode": f"corrected{number // 4}", "privileged": json.dumps(note)})
    writer = ShardWriter(request.folder, "demos", request.config_hash, overwrite=True)
    writer.write(0, rows)
    writer.finish({})


def debug_config(root: Path, more: Sequence[str] = ()) -> TrainConfig:
    """A few steps of a small model, with outputs in a folder."""
    words = ["budget=debug", f"output={root}", "logger.wandb=disabled", "selu.truth=oracle", *more]
    cfg = build(TrainConfig, compose("train", words))
    return dataclasses.replace(cfg, model=small(cfg.model))


@pytest.fixture(scope="session")
def trained(tmp_path_factory: pytest.TempPathFactory, shards: Path) -> Pipeline:
    """Every stage, run once."""
    torch.set_num_threads(1)
    root = tmp_path_factory.mktemp("run")
    cfg = debug_config(root)
    (root / "tiny").mkdir()
    shutil.copytree(shards, root / "tiny" / "data")
    return all_stages(cfg)


def all_stages(cfg: TrainConfig) -> Pipeline:
    """Runs them."""
    pipeline = Pipeline(STAGES, cfg, collect, "python train.py stage=all", correct, Lessons())
    for stage in STAGES:
        assert pipeline.run(stage) is not None
    return pipeline


def small(model: ModelConfig) -> ModelConfig:
    return dataclasses.replace(
        model,
        vocab_size=450,
        text=dataclasses.replace(model.text, hidden=64, layers=2, heads=2, kv_heads=1, intermediate=96),
        vision=dataclasses.replace(model.vision, hidden=32, depth=2, heads=2, intermediate=48),
        point_map=dataclasses.replace(model.point_map, width=32, depth=1),
        motion=dataclasses.replace(model.motion, codes=32, code_dim=16, width=16, depth=1),
    )
