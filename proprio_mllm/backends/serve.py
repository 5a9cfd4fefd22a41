"""Serves a checkpoint as an OpenAI-compatible model on this machine: `make serve`.

    python -m proprio_mllm serve [weights=weights/tiny/base] [port=8377] [batch=8] [device=auto] [constrained=false]

Prints one line when it is ready; Ctrl-C or SIGTERM ends it after the calls under way. Base URL: http://127.0.0.1:8377/v1.

`transformers serve` (5.23.0) is not used. It loads processors through `AutoProcessor`, which for Qwen2.5-VL and InternVL needs
torchvision; it ignores `response_format` and `n` without a word to the client; it answers missing messages and unreadable
pictures with 500, which clients take for an outage and ask again; it reads any picture that a request names by path or URL; and
it lists the models of the hub's cache instead of the one it serves. This server needs nothing beyond the project itself.

Paper: none (engineering).
"""

from __future__ import annotations

import contextlib
import signal
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from transformers.utils import logging as transformers_logging

from configs.arguments import command, read_arguments
from configs.schema.backend import BackendConfig
from proprio_mllm.backends.local import LocalChat
from proprio_mllm.backends.protocol import BackendSetupError
from proprio_mllm.backends.server import ChatServer


@dataclass(frozen=True)
class ServeConfig:
    """Arguments of the command.

    Attributes:
        weights: folder of the checkpoint; its last name is the model's.
        port: on 127.0.0.1; 0 takes a free one.
        batch: calls answered together.
        device: `auto`, `cpu` or `cuda`.
        dtype: of the model; `auto` takes the checkpoint's on a GPU and float32 elsewhere.
        constrained: whether a request may ask for a JSON schema (extra `constrained`).
    """

    weights: str = "weights/tiny/base"
    port: int = 8377
    batch: int = 8
    device: str = "auto"
    dtype: Literal["auto", "float32", "bfloat16", "float16"] = "auto"
    constrained: bool = False

    def __post_init__(self) -> None:
        if not 0 <= self.port <= 65535:
            raise ValueError(f"port {self.port} outside [0, 65535]")
        self.backend()

    def backend(self) -> BackendConfig:
        """The backend that answers."""
        return BackendConfig(
            kind="local",
            name="served",
            model=self.weights,
            batch=self.batch,
            device=self.device,
            dtype=self.dtype,
            constrained=self.constrained,
            cache=None,
        )


@command()
def main(arguments: Sequence[str]) -> int:
    """Command line; returns the exit code."""
    cfg = read_arguments(ServeConfig, arguments)
    transformers_logging.disable_progress_bar()
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # ends the block below, as Ctrl-C does
    with contextlib.suppress(KeyboardInterrupt), contextlib.ExitStack() as stack:
        try:
            backend = LocalChat(cfg.backend())
            stack.callback(backend.close)
            name = Path(cfg.weights).resolve().name
            server = ChatServer(backend, name, cfg.port, cfg.constrained, backend.revision)
        except BackendSetupError as error:
            sys.stderr.write(f"serve: {error}\n")
            return 1
        except OSError as error:
            sys.stderr.write(f"serve: port {cfg.port} cannot be had: {error.strerror}; port=0 takes a free one\n")
            return 1
        stack.callback(server.server_close)
        sys.stdout.write(f"{server.url} answers as {name}: {backend.model} on {backend.device}\n")
        sys.stdout.flush()
        server.serve_forever()
    return 0
