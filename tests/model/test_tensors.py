"""Files of weights and checkpoints: whole or not there, and damage is named."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
import torch

import train
from configs.schema.train import LoggerConfig
from data.files import DamagedFileError, read_json, write_text
from proprio_mllm.model.building import load_model
from proprio_mllm.model.motion_tokenizer import MotionTokenizer
from proprio_mllm.model.tensors import check_files, file_hashes, read_tensors, write_tensors
from proprio_mllm.training.checkpoint import load_checkpoint, save_checkpoint
from proprio_mllm.training.metrics import MetricWriter
from proprio_mllm.training.paths import finish, finished_key

WEIGHTS = Path(__file__).parents[2] / "weights/tiny"


def flipped(path: Path) -> None:
    """Changes the last byte of a file: its format still holds."""
    data = bytearray(path.read_bytes())
    data[-1] ^= 1
    path.write_bytes(bytes(data))


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


@pytest.mark.parametrize("damage", [flipped, cut, Path.unlink])
@pytest.mark.parametrize("name", ["vlm/model.safetensors", "heads.safetensors"])
def test_damaged_weights_are_named(damage, name: str, tmp_path: Path) -> None:
    folder = shutil.copytree(WEIGHTS / "base", tmp_path / "base")
    damage(folder / name)
    with pytest.raises(DamagedFileError, match=f"base/{name}: (damaged|missing)"):
        load_model(folder)


def test_damaged_adapters_motion_and_configurations_are_named(tmp_path: Path) -> None:
    shutil.copytree(WEIGHTS / "base", tmp_path / "base")
    folder = shutil.copytree(WEIGHTS / "full", tmp_path / "full")
    flipped(folder / "adapters/default/adapter_model.safetensors")
    with pytest.raises(DamagedFileError, match=r"adapter_model\.safetensors: damaged"):
        load_model(folder)
    cut(folder / "motion/config.json")
    with pytest.raises(DamagedFileError, match=r"motion/config\.json: damaged: no JSON"):
        MotionTokenizer.load(folder / "motion")
    (folder / "config.json").write_text("[]")
    with pytest.raises(DamagedFileError, match=r"config\.json: damaged: list in place of an object"):
        load_model(folder)


@pytest.mark.parametrize("name", ["model.safetensors", "optimizer.safetensors", "state.json"])
def test_a_damaged_checkpoint_is_no_start(name: str, tmp_path: Path) -> None:
    module = torch.nn.Linear(3, 2)
    optimizer = torch.optim.AdamW(module.parameters())
    module(torch.ones(1, 3)).sum().backward()
    optimizer.step()
    save_checkpoint(tmp_path / "checkpoint", 7, module, optimizer, "k")
    assert load_checkpoint(tmp_path / "checkpoint", module, optimizer, "k")[0] == 7
    (cut if name == "state.json" else flipped)(tmp_path / "checkpoint" / name)
    with pytest.raises(DamagedFileError, match=f"{name}: damaged"):
        load_checkpoint(tmp_path / "checkpoint", module, optimizer, "k")


def test_a_cut_note_of_a_stage_is_damaged(tmp_path: Path) -> None:
    finish(tmp_path, "k", {})
    assert finished_key(tmp_path) == "k"
    cut(tmp_path / "done.json")
    with pytest.raises(DamagedFileError, match=r"done\.json: damaged: no JSON"):
        finished_key(tmp_path)


@pytest.mark.parametrize("error", [DamagedFileError("x.json: damaged"), OSError(28, "No space left on device", "y.arrow")])
def test_training_ends_with_one_line(
    error: Exception, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fails(cfg: object) -> None:
        raise error

    monkeypatch.setattr(train, "run", fails)
    assert train.main(["stage=words"]) == 1
    assert capsys.readouterr().err.splitlines()[-1] == f"train.py: {error}"


def test_what_cannot_be_written_is_one_error_and_leaves_nothing(tmp_path: Path) -> None:
    with pytest.raises(OSError, match=r"nowhere/x\.safetensors: cannot be written"):
        write_tensors({"a": torch.zeros(3)}, tmp_path / "nowhere" / "x.safetensors")
    (tmp_path / "taken").mkdir()
    with pytest.raises(OSError, match="taken"):
        write_text(tmp_path / "taken", "text")
    assert [path.name for path in tmp_path.iterdir()] == ["taken"]


def test_metrics_are_there_whole_at_any_moment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    writer = MetricWriter(tmp_path, "run", LoggerConfig(wandb="disabled"))
    writer.write(1, {"loss": 2.0})
    before = (tmp_path / "metrics.csv").read_text()

    def killed(*args: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("data.files.os.replace", killed)
    with pytest.raises(KeyboardInterrupt):
        writer.write(2, {"loss": 1.0})
    assert (tmp_path / "metrics.csv").read_text() == before == "step,loss\n1,2\n"


def test_tensors_come_back_with_their_checksum(tmp_path: Path) -> None:
    path = tmp_path / "sub" / "a.safetensors"
    path.parent.mkdir()
    write_tensors({"a": torch.arange(3.0)}, path)
    hashes = file_hashes(tmp_path)
    assert list(hashes) == ["sub/a.safetensors"]
    check_files(tmp_path, hashes)
    assert torch.equal(read_tensors(path)["a"], torch.arange(3.0))
    with pytest.raises(DamagedFileError, match="checksum"):
        check_files(tmp_path, {"sub/a.safetensors": "0" * 64})
    (tmp_path / "b.json").write_text(json.dumps({"a": 1}))
    assert read_json(tmp_path / "b.json") == {"a": 1}
