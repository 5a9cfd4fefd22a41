"""A function of a Python file in a language model's place, named `FILE.py:FUNCTION`: for tests and one's own models.

The function takes a `ChatRequest` and returns a text or a `ChatReply`; it may be called by several threads at once. The file
runs with the rights of the user, as any script. Paper: none (engineering).
"""

from __future__ import annotations

import dataclasses
import time
import traceback
from pathlib import Path

from configs.schema.backend import BackendConfig
from data.code_files import CodeFileError, load_named
from proprio_mllm.backends.identity import identity_of
from proprio_mllm.backends.protocol import BackendError, BackendSetupError, ChatReply, ChatRequest


class ScriptedChat:
    """Calls the function.

    Args:
        cfg: of kind `scripted`.

    Raises:
        BackendSetupError: when the file cannot be run or has no such function.
    """

    def __init__(self, cfg: BackendConfig) -> None:
        if cfg.source is None:
            raise BackendSetupError(f"backend {cfg.name}: backend.source is null; allowed: FILE.py:FUNCTION")
        self._source = cfg.source
        try:
            self._answer = load_named(cfg.source, "backend.source", "function")
        except CodeFileError as error:
            raise BackendSetupError(f"backend {cfg.name}: {error}") from error
        self.identity = identity_of(cfg)

    def complete(self, request: ChatRequest) -> ChatReply:
        """What the function returns, with the time it took.

        Raises:
            BackendSetupError: when it returns something else than a text or a reply.
            BackendError: when it fails.
        """
        start = time.perf_counter()
        try:
            answer = self._answer(request)
        except BackendError:
            raise
        except Exception as error:
            raise BackendError(f"{self._source} failed{_line(error)}: {type(error).__name__}: {error}") from error
        latency_s = time.perf_counter() - start
        if isinstance(answer, str):
            return ChatReply(answer, latency_s=latency_s, model="script")
        if not isinstance(answer, ChatReply):
            raise BackendSetupError(f"{self._source} returned {type(answer).__name__}; allowed: str, ChatReply")
        return answer if answer.latency_s else dataclasses.replace(answer, latency_s=latency_s)

    def close(self) -> None:
        """Holds nothing."""


def _line(error: Exception) -> str:
    """Where an error came up."""
    frames = traceback.extract_tb(error.__traceback__)
    return f" at {Path(frames[-1].filename).name}:{frames[-1].lineno}" if frames else ""
