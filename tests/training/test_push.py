"""Released weights for the hub: what would be sent, and what is not sent."""

from __future__ import annotations

import shutil
import types
from pathlib import Path
from typing import Any

import pytest
from huggingface_hub import ModelCard

from proprio_mllm.training import push
from proprio_mllm.training.card import model_card

WEIGHTS = Path(__file__).parents[2] / "weights" / "tiny"


class Hub:
    """Takes what is sent."""

    def __init__(self) -> None:
        self.repos: list[tuple[str, bool]] = []
        self.files: dict[str, bytes] = {}

    def create_repo(self, repo: str, private: bool, exist_ok: bool) -> None:
        self.repos.append((repo, private))

    def create_commit(self, repo: str, operations: list[Any], commit_message: str) -> Any:
        for one in operations:
            with one.as_file() as file:
                self.files[one.path_in_repo] = file.read()
        return types.SimpleNamespace(commit_url="https://hub/commit")


@pytest.fixture
def hub(monkeypatch: pytest.MonkeyPatch) -> Hub:
    made = Hub()
    monkeypatch.setattr(push, "HfApi", lambda: made)
    return made


def test_models_that_share_a_backbone_are_sent_together(hub: Hub, capsys: pytest.CaptureFixture[str]) -> None:
    assert push.main([str(WEIGHTS), "repo=somebody/proprio-mllm-tiny"]) == 0
    told = capsys.readouterr().out
    assert "full/heads.safetensors" in told and "nothing was sent" in told and not hub.repos
    assert push.main([str(WEIGHTS), "repo=somebody/proprio-mllm-tiny", "send=true", "private=false"]) == 0
    assert hub.repos == [("somebody/proprio-mllm-tiny", False)]
    kept = {path.relative_to(WEIGHTS).as_posix(): path.read_bytes() for path in WEIGHTS.rglob("*") if path.is_file()}
    card = hub.files.pop("README.md").decode()
    assert hub.files == kept
    assert ModelCard(card).data.to_dict()["library_name"] == "proprio-mllm"
    assert all(f"| [`{name}`]({name}/README.md) |" in card for name in ("base", "full", "words"))


def test_one_model_is_sent_with_its_own_card(hub: Hub) -> None:
    assert push.main([str(WEIGHTS / "words"), "repo=somebody/words", "send=true"]) == 0
    assert hub.repos == [("somebody/words", True)]
    assert hub.files["README.md"] == (WEIGHTS / "words" / "README.md").read_bytes() and "vlm/model.safetensors" in hub.files


def test_what_cannot_be_sent_is_said(hub: Hub, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def refused(folder: Path, repo: str = "somebody/x") -> str:
        assert push.main([str(folder), f"repo={repo}", "send=true"]) == 2
        return capsys.readouterr().err

    assert f"push {WEIGHTS}" in refused(WEIGHTS / "full")
    assert "holds no released weights" in refused(tmp_path)
    assert "somebody//x" in refused(WEIGHTS / "words", "somebody//x")
    shutil.copytree(WEIGHTS / "words", tmp_path / "words")
    (tmp_path / "words" / "heads.safetensors").write_bytes(b"cut")
    assert "heads.safetensors: damaged" in refused(tmp_path / "words")
    assert not hub.repos


def test_cards_of_released_backbones_name_them() -> None:
    about = {"stage": "selu", "variant": "full", "seed": 0, "stages": {}, "shards": {}, "stored_as": "float16"}
    weights = "Qwen/Qwen2.5-VL-7B-Instruct"
    card = ModelCard(model_card(about | {"config": {"model": {"name": "qwen2_5_vl_7b", "weights": weights}}}))
    assert card.data.to_dict()["base_model"] == weights and "laptop" not in card.text
