"""The whole way of an API planner: eval, the OpenAI client, and the local server with the released tiny model."""

from __future__ import annotations

import dataclasses
import json
import shutil
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
from transformers import AutoTokenizer

from configs.compose import compose
from configs.schema.backend import BackendConfig
from configs.schema.eval import EvalConfig
from configs.validate import build
from proprio_mllm.backends.local import LocalChat
from proprio_mllm.backends.server import ChatServer
from proprio_mllm.evaluation.run import evaluate
from proprio_mllm.planners.memory_build import MemoryConfig, build_memory
from tests.planners.demonstrations import write_demos

TINY = Path(__file__).resolve().parents[2] / "weights/tiny/base"


@pytest.fixture(scope="module")
def url(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """The tiny model, held to replies of one word: it was shown no such prompt, and would go on for ever."""
    folder = shutil.copytree(TINY, tmp_path_factory.mktemp("served") / "base")
    ends = list(range(len(AutoTokenizer.from_pretrained(folder / "processor"))))
    (folder / "vlm" / "generation_config.json").write_text(json.dumps({"eos_token_id": ends}), encoding="utf-8")
    chat = LocalChat(BackendConfig("local", "served", model=str(folder), device="cpu", batch=4, cache=None))
    server = ChatServer(chat, "base", 0, False, chat.revision)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    yield server.url
    server.shutdown()
    server.server_close()
    chat.close()


@pytest.fixture(scope="module")
def memory(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("served")
    build_memory(MemoryConfig(str(write_demos(folder / "demos")), str(folder / "memory")), "a test")
    return folder / "memory"


@pytest.mark.slow
@pytest.mark.parametrize("planner", ["gpt4o", "llm_planner", "rap", "dag_plan"])
def test_a_planner_asks_the_served_model_and_repeats_the_run_without_it(
    planner: str, url: str, memory: Path, tmp_path: Path
) -> None:
    cache = tmp_path / "replies.sqlite"
    values = [
        f"planner={planner}",
        "backend=serve",
        f"backend.base_url={url}",
        f"backend.cache={cache}",
        "robot=x1",
        "limit=1",
        "steps=task",
    ]
    values += [f"planner.memory={memory}"] if planner in ("llm_planner", "rap") else []
    cfg = build(EvalConfig, compose("eval", [*values, "workers=0", "threads=3", f"output={tmp_path / 'a'}"]))
    first = evaluate(cfg)
    assert not first.broken
    assert len(first.records) == 3
    assert all(record.planner_calls > 0 and record.planner_tokens > 1000 for record in first.records)
    assert {model.partition("@")[0].split()[0] for record in first.records for model in record.models} == {"base"}
    assert cfg.backend is not None
    revision = first.metadata["backend"]["revision"]
    assert all(model.endswith(f"@{revision}") for record in first.records for model in record.models)
    nowhere = dataclasses.replace(cfg.backend, kind="replay", base_url="http://127.0.0.1:9/v1", revision=revision)
    again = evaluate(dataclasses.replace(cfg, backend=nowhere, output=str(tmp_path / "b"), threads=1))
    gone = dataclasses.replace(cfg.backend, base_url="http://127.0.0.1:9/v1")  # nobody listens; its replies are known
    repeated = evaluate(dataclasses.replace(cfg, backend=gone, output=str(tmp_path / "c"), threads=1))
    assert repeated.folder.name == first.folder.name
    assert all(record.cached_calls == record.planner_calls for record in repeated.records)
    for record, replayed in zip(first.records, again.records, strict=True):
        assert replayed.cached_calls == replayed.planner_calls
        assert replayed.trace == record.trace
        assert (replayed.outcome, replayed.planner_tokens, replayed.models) == (
            record.outcome, record.planner_tokens, record.models
        )  # fmt: skip
