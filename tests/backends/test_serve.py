"""The command: it starts with the released tiny model, answers the OpenAI client, and ends when told to."""

from __future__ import annotations

import base64
import contextlib
import functools
import os
import signal
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import openai
import pytest

from proprio_mllm.backends.protocol import ChatImage
from proprio_mllm.backends.serve import main

ROOT = Path(__file__).parents[2]


@contextlib.contextmanager
def command() -> Iterator[subprocess.Popen[str]]:
    """The command, on a free port."""
    call = [sys.executable, "-m", "proprio_mllm", "serve", "port=0", "device=cpu"]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background jobs, and so theirs, ignore it
    with subprocess.Popen(
        call, cwd=ROOT, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        signal.signal(signal.SIGINT, before)
        try:
            yield process
        finally:
            process.kill()


def ready(process: subprocess.Popen[str]) -> tuple[str, str]:
    """Base URL of a server and what else its line says."""
    assert process.stdout is not None
    line = process.stdout.readline()
    url, _, said = line.partition(" ")
    assert url.startswith("http://127.0.0.1:"), line
    assert said.startswith("answers as base: base@"), line
    return url, said


def stop(process: subprocess.Popen[str], ending: signal.Signals) -> None:
    process.send_signal(ending)
    out, err = process.communicate(timeout=60)
    assert (process.returncode, out, err) == (0, "", "")


@pytest.mark.slow
def test_the_tiny_model_is_served(view: Callable[..., ChatImage]) -> None:
    with command() as process, command() as other:
        url, said = ready(process)
        picture = f"data:image/png;base64,{base64.b64encode(view(1).data).decode()}"
        parts: Any = [{"type": "image_url", "image_url": {"url": picture}}, {"type": "text", "text": "left?"}]
        with openai.OpenAI(base_url=url, api_key="none", max_retries=0, timeout=60) as client:
            chat = functools.partial(client.chat.completions.create, model="base", temperature=0)
            (card,) = client.models.list()
            assert (card.id, f"base@{(card.model_extra or {})['revision']}") == ("base", said.split()[3])
            seen = chat(messages=[{"role": "system", "content": "look"}, {"role": "user", "content": parts}], max_tokens=20)
            listing: Any = [parts[0], {"type": "text", "text": "see?"}]
            text = chat(messages=[{"role": "system", "content": "look"}, {"role": "user", "content": listing}], max_tokens=1)
            with pytest.raises(openai.BadRequestError, match="the model's context of 4096"):
                chat(messages=[{"role": "user", "content": "left? " * 4000}])
            with pytest.raises(openai.BadRequestError, match="messages: Input should be a valid array"):
                chat(messages="left?")  # type: ignore[arg-type]  # what is refused
        assert seen.choices[0].message.content
        assert seen.choices[0].finish_reason == "stop"
        assert seen.system_fingerprint == said.split()[3]
        assert seen.usage is not None
        assert text.usage is not None
        assert seen.usage.prompt_tokens > 16, "the picture's tokens are counted"
        assert (text.choices[0].finish_reason, text.usage.completion_tokens) == ("length", 1)
        stop(process, signal.SIGTERM)
        ready(other)
        stop(other, signal.SIGINT)


@pytest.mark.parametrize(
    ("argument", "code", "message"),
    [
        ("port=70000", 2, "ServeConfig: port 70000 outside [0, 65535]"),
        ("batch=0", 2, "batch 0 outside [1, 1024]"),
        ("model=x", 2, "model: unknown key; allowed: batch, constrained, device, dtype, port, weights"),
        ("weights=nowhere", 1, "serve: nowhere: not a checkpoint"),
    ],
)
def test_a_wrong_command_is_explained(argument: str, code: int, message: str, capsys: pytest.CaptureFixture[str]) -> None:
    before = signal.getsignal(signal.SIGTERM)
    try:
        assert main([argument]) == code
    finally:
        signal.signal(signal.SIGTERM, before)
    captured = capsys.readouterr()
    assert message in captured.err
    assert captured.out == ""


def test_a_port_that_is_taken_is_named(capsys: pytest.CaptureFixture[str]) -> None:
    before = signal.getsignal(signal.SIGTERM)
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        try:
            assert main([f"port={port}", "device=cpu"]) == 1
        finally:
            signal.signal(signal.SIGTERM, before)
    assert f"serve: port {port} cannot be had: Address already in use; port=0 takes a free one" in capsys.readouterr().err
