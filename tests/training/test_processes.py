"""Several processes train like one: equal weights, one that writes, and a run that survives the death of any of them."""

from __future__ import annotations

import dataclasses
import json
import os
import shutil
import socket
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file

from proprio_mllm.training.loop import run_loop
from proprio_mllm.training.paths import StagePaths
from tests.training import together
from tests.training.conftest import debug_config
from tests.training.together import Mixed

ROOT = Path(__file__).parents[2]


def launched(count: int, folder: Path, micro_batches: int, *more: str, module: str = "tests.training.together") -> list[int]:
    """Exit codes of processes started as `torchrun` starts them: when one dies, it ends the others."""
    folder.mkdir(exist_ok=True)
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    shared = {"WORLD_SIZE": str(count), "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(port), "PYTHONPATH": str(ROOT)}
    shared["CUDA_VISIBLE_DEVICES"] = ""  # more processes than there may be GPUs
    command = [sys.executable, "-m", module, str(folder), str(micro_batches), *more]
    running = [
        subprocess.Popen(
            command, cwd=ROOT, env=os.environ | shared | {"RANK": str(rank), "LOCAL_RANK": str(rank)}, stderr=subprocess.DEVNULL
        )
        for rank in range(count)
    ]
    try:
        return [one.wait(500) for one in running]
    finally:
        for one in running:
            one.kill()


def alike(first: Path, second: Path) -> None:
    torch.testing.assert_close(load_file(first), load_file(second), atol=2e-5, rtol=2e-4)


@pytest.fixture(scope="module")
def alone(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of one process with four micro-batches."""
    folder = tmp_path_factory.mktemp("alone")
    assert launched(1, folder, 4) == [0]
    return folder


@pytest.mark.parametrize("count", [2, 4])
def test_processes_share_the_work_of_one(count: int, alone: Path, tmp_path: Path) -> None:
    assert launched(count, tmp_path, 4) == [0] * count
    for rank in range(count):
        alike(alone / "weights_0.safetensors", tmp_path / f"weights_{rank}.safetensors")
    rows = [(folder / "metrics.csv").read_text().splitlines() for folder in (alone, tmp_path)]
    losses = [[float(line.split(",")[lines[0].split(",").index("loss")]) for line in lines[1:]] for lines in rows]
    assert losses[0] == pytest.approx(losses[1], rel=1e-4) and len(losses[0]) == 4
    start = together.Senses()  # which never hears, and a parameter without a gradient is left as it was
    assert torch.equal(load_file(tmp_path / "weights_1.safetensors")["hears.weight"], start.hears.weight)


def test_a_killed_process_ends_the_run_and_fewer_finish_it(alone: Path, tmp_path: Path) -> None:
    first, last = launched(2, tmp_path, 4, "50")  # in the middle of a step between two checkpoints
    assert first != 0 and last == -9
    assert not (tmp_path / "weights_0.safetensors").exists() and (tmp_path / "checkpoint").is_dir()
    assert launched(1, tmp_path, 4) == [0]
    alike(alone / "weights_0.safetensors", tmp_path / "weights_0.safetensors")


def test_micro_batches_weigh_what_they_teach(tmp_path: Path) -> None:
    first, second = Mixed(), Mixed()
    second.module.load_state_dict(first.module.state_dict())
    result = run_loop(first, dataclasses.replace(together.CFG, steps=1), tmp_path, 0, None, micro_batches=4)
    streams = [np.random.default_rng([0, 0, number]) for number in range(4)]
    kind = second.kind(streams[0])
    batches = [second.batch(stream, 4, kind) for stream in streams]
    weights = [second.weight(batch) for batch in batches]
    assert len(set(weights)) > 1
    losses = [sum(second.loss(second.module, part, torch.Generator())[0].item() for part in batch) for batch in batches]
    assert result.last["loss"] == pytest.approx(np.average(losses, weights=weights))


def test_micro_batches_that_do_not_fit_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="batch of 16 in micro_batches=3 cannot be shared by 1 processes"):
        run_loop(Mixed(), together.CFG, tmp_path, 0, None, micro_batches=3)


@pytest.mark.slow
def test_every_stage_runs_in_two_processes(shards: Path, tmp_path: Path) -> None:
    folders = [tmp_path / "one", tmp_path / "two"]
    for count, folder in enumerate(folders, 1):
        shutil.copytree(shards, folder / "tiny" / "data")
        assert launched(count, folder, 2, module="tests.training.all_stages") == [0] * count
    for stage in ("words", "practice", "base", "pointmap", "tokenizer", "alignment", "selu"):
        one, two = (StagePaths(debug_config(folder)).stage(stage) for folder in folders)
        names = [sorted(str(path.relative_to(root)) for path in root.rglob("*") if path.is_file()) for root in (one, two)]
        assert names[0] == names[1], stage
        metrics = [json.loads((root / "done.json").read_text())["metrics"] for root in (one, two)]
        assert set(metrics[0]) == set(metrics[1])
    one, two = (StagePaths(debug_config(folder)).model("words") / "vlm" / "model.safetensors" for folder in folders)
    weights, others = load_file(one), load_file(two)
    for name, tensor in weights.items():  # Muon makes all directions long, those of rounding too
        gap = (tensor - others[name]).float().abs()
        assert float(gap.max()) < 1e-2 and float(gap.mean()) < 6e-4, (name, float(gap.max()), float(gap.mean()))
