"""A server on this machine that answers as it is told, and a backend that asks it."""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator

import pytest

from configs.schema.backend import BackendConfig
from tests.backends.checkpoints import ask, folder, internvl_folder, one_thread, open_chat, qwen_folder, view
from tests.backends.loopback import KEY, LoopbackServer

__all__ = ["ask", "folder", "internvl_folder", "one_thread", "open_chat", "qwen_folder", "view"]  # fixtures of all modules here


@pytest.fixture
def server() -> Iterator[LoopbackServer]:
    with LoopbackServer() as server:
        threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01}, daemon=True).start()
        yield server
        server.shutdown()


@pytest.fixture(autouse=True)
def _key(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in list(os.environ):
        if name.endswith("_API_KEY"):
            monkeypatch.delenv(name)
    monkeypatch.setenv("TEST_API_KEY", KEY)


@pytest.fixture
def cfg(server: LoopbackServer) -> BackendConfig:
    """Asks the server, once, with a key."""
    return BackendConfig(
        "openai",
        "tested",
        model="some-model",
        base_url=server.url,
        key_env="TEST_API_KEY",
        timeout_s=5.0,
        retries=0,
        cache=None,
    )
