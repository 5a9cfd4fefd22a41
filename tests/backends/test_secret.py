"""The key is sent, and shown nowhere: not in logs, errors, replies, representations or copies."""

from __future__ import annotations

import copy
import dataclasses
import json
import logging
import pickle
import traceback

import pytest

from configs.schema.backend import BackendConfig
from proprio_mllm.backends.connection import Secret, read_secret
from proprio_mllm.backends.openai_chat import OpenAIChat
from proprio_mllm.backends.protocol import BackendError, BackendSetupError
from tests.backends.loopback import KEY, Handler, LoopbackServer, ask, completion


def echoing(status: int):
    """A server that says the key in its reason, a header, and its body."""

    def answer(handler: Handler) -> None:
        said = f"{'x' * 390} you sent {handler.headers['Authorization']}"
        body = completion(said, model=f"model of {KEY}") if status == 200 else {"error": {"message": said, "code": KEY}}
        handler.send_response(status, f"Reason {KEY}")
        handler.send_header("X-Request-Id", KEY)
        handler.send_header("Set-Cookie", f"key={KEY}")
        data = json.dumps(body).encode()
        handler.send_header("Content-Type", "application/json")
        handler.send_header("Content-Length", str(len(data)))
        handler.end_headers()
        handler.wfile.write(data)

    return answer


@pytest.mark.parametrize("status", [200, 302, 400, 401, 404, 429, 500])
def test_a_server_that_echoes_the_key(cfg: BackendConfig, server: LoopbackServer, caplog, status: int) -> None:
    server.answer = echoing(status)
    backend = OpenAIChat(dataclasses.replace(cfg, retries=0))
    loggers = ("openai", "openai._base_client", "httpx2", "httpcore2", "httpcore2.http11", "httpcore2.connection")
    for name in loggers:
        caplog.set_level(logging.DEBUG, name)
    caplog.set_level(logging.DEBUG)
    seen = repr(backend) + str(backend) + repr(backend.__dict__) + backend.identity
    try:
        seen += repr(backend.complete(ask()))
    except BackendError as error:
        seen += "".join(traceback.format_exception(error)) + repr(error) + repr(error.args) + repr(vars(error))
        chain: BaseException | None = error
        while chain is not None:
            seen, chain = seen + repr(vars(chain)), chain.__context__ or chain.__cause__
    assert KEY not in caplog.text
    assert KEY[:12] not in seen  # nor a part of it, where a text was shortened
    assert "[key]" in caplog.text
    assert "receive_response_headers.complete" in caplog.text
    backend.close()


def test_without_the_guard_it_would_be_logged(cfg: BackendConfig, server: LoopbackServer, caplog, monkeypatch) -> None:
    monkeypatch.setenv("TEST_API_KEY", "sk-of-this-test-alone")
    server.answer = lambda handler: handler.send(200, completion(), X_Request_Id=handler.headers["Authorization"])
    backend = OpenAIChat(cfg)
    backend._secret.release()
    caplog.set_level(logging.DEBUG)
    backend.complete(ask())
    assert "sk-of-this-test-alone" in caplog.text
    backend.close()


def test_a_body_that_is_no_completion_and_holds_the_key(cfg: BackendConfig, server: LoopbackServer) -> None:
    server.answer = lambda handler: handler.send(200, f"{'x' * 300}{KEY} <b>{KEY}</b>".encode(), "text/html")
    with pytest.raises(BackendError, match=r"\[key\] <b>\[key\]</b>") as caught:
        OpenAIChat(cfg).complete(ask())
    assert KEY[:12] not in str(caught.value)


def test_a_secret_is_neither_shown_nor_stored() -> None:
    secret = Secret(KEY)
    assert KEY not in repr(secret) + str(secret) + f"{secret}"
    for store in (pickle.dumps, copy.deepcopy):
        with pytest.raises(TypeError, match="a key is neither stored nor sent"):
            store(secret)


def test_words_are_no_secrets() -> None:
    assert Secret("none").redact("there is none") == "there is none"
    assert Secret("password").redact("the password") == "the [key]"


@pytest.mark.parametrize("value", ["two words", "schlüssel", "line\nbreak"])
def test_keys_that_cannot_be_sent(monkeypatch, value: str) -> None:
    monkeypatch.setenv("TEST_API_KEY", value)
    with pytest.raises(BackendSetupError, match="the key in TEST_API_KEY holds a space or a character outside ASCII") as caught:
        read_secret("TEST_API_KEY", "tested", optional=True)
    assert value not in str(caught.value)


def test_spaces_around_a_key_are_not_sent(monkeypatch) -> None:
    monkeypatch.setenv("TEST_API_KEY", f" {KEY}\n")
    assert read_secret("TEST_API_KEY", "tested", optional=False).reveal() == KEY


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("you sent sk-proj-4f9Qm2xLr8Tz", "you sent [key]"),  # a reply that was cut in the midst of the key
        ("sk-proj-4f9Qm2xLr8TzBv61 and sk-proj-4f9Qm2xLr8TzBv61", "[key] and [key]"),
        ("ends in 2xLr8TzBv61.", "ends in [key]."),
        ("sk-proj", "sk-proj"),
        ("sk-proj-4f9Qm2xLr8TzBv61sk-proj-4f9Qm", "[key][key]"),
        ("nothing of it", "nothing of it"),
    ],
)
def test_parts_of_a_key_are_taken_out_too(text: str, shown: str) -> None:
    assert Secret("sk-proj-4f9Qm2xLr8TzBv61").redact(text) == shown


def test_a_short_key_is_no_secret() -> None:
    assert Secret("none").redact("none of them") == "none of them"
