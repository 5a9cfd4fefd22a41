"""Small memories, made once, as the command makes them."""

from __future__ import annotations

from pathlib import Path

import pytest

from proprio_mllm.planners.chat.embedding import SentenceEmbedder, sentence_embedder
from proprio_mllm.planners.memory_build import MemoryConfig, build_memory
from tests.planners.demonstrations import write_demos


@pytest.fixture(scope="session")
def demos_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_demos(tmp_path_factory.mktemp("demos") / "demos")


@pytest.fixture(scope="session")
def memory_folder(demos_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four tasks with pictures."""
    out = tmp_path_factory.mktemp("memory") / "memory"
    build_memory(MemoryConfig(str(demos_folder), str(out)), "a test")
    return out


@pytest.fixture(scope="session")
def blind_memory_folder(demos_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same without pictures."""
    out = tmp_path_factory.mktemp("blind") / "memory"
    build_memory(MemoryConfig(str(demos_folder), str(out), vision=None), "a test")
    return out


@pytest.fixture(scope="session")
def embedder() -> SentenceEmbedder:
    return sentence_embedder()
