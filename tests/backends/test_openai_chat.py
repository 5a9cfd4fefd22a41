"""The client of OpenAI-compatible servers against one that misbehaves in every way."""

from __future__ import annotations

import base64
import dataclasses
import logging
import pickle
import threading
import time
from concurrent.futures import ThreadPoolExecutor

import pytest
from pydantic import BaseModel

from configs.schema.backend import BackendConfig
from proprio_mllm.backends.openai_chat import OpenAIChat
from proprio_mllm.backends.protocol import (
    Backend,
    BackendError,
    BackendSetupError,
    ChatReply,
    ChatRequest,
    LostReplyError,
    UnreachableError,
)
from tests.backends.loopback import IMAGE, KEY, Handler, LoopbackServer, ask, completion


class Steps(BaseModel):
    steps: list[str]


def reply_of(cfg: BackendConfig, request: ChatRequest | None = None, **changes: object) -> ChatReply:
    backend = OpenAIChat(dataclasses.replace(cfg, **changes))
    try:
        return backend.complete(request or ask())
    finally:
        backend.close()


def error_of(cfg: BackendConfig, **changes: object) -> BackendError:
    with pytest.raises(BackendError) as caught:
        reply_of(cfg, **changes)
    assert str(caught.value).startswith("backend tested: ")
    assert caught.value.__cause__ is None and caught.value.__context__ is None
    return caught.value


def test_a_reply(cfg: BackendConfig, server: LoopbackServer) -> None:
    server.answer = lambda handler: handler.send(200, completion("Wait()", system_fingerprint="fp_1"))
    reply = reply_of(cfg)
    assert reply == ChatReply("Wait()", 100, 10, reply.latency_s, "stop", "served-model fp_1")
    assert 0.0 < reply.latency_s < 5.0
    assert isinstance(OpenAIChat(cfg), Backend)


def test_other_weights_in_the_midst_of_a_run(cfg: BackendConfig, server: LoopbackServer) -> None:
    known = dataclasses.replace(cfg, model="served-model", revision="abc")
    server.answer = lambda handler: handler.send(200, completion("Wait()", system_fingerprint="served-model@abc"))
    assert reply_of(known).model == "served-model@abc"
    server.answer = lambda handler: handler.send(200, completion("Wait()", system_fingerprint="served-model@def"))
    assert reply_of(cfg).model == "served-model@def"
    error = error_of(known)
    assert isinstance(error, BackendSetupError)
    assert "answers as served-model@def, and this run is of revision abc" in str(error)


def test_what_is_sent(cfg: BackendConfig, server: LoopbackServer) -> None:
    request = ask(schema=Steps, max_tokens=77, temperature=0.5)
    reply_of(cfg, request)
    reply_of(cfg, request, structured="json_object", token_limit_field="max_completion_tokens")
    reply_of(cfg, request, structured="off")
    reply_of(cfg)
    first, second, third, fourth = (asked.body for asked in server.asked)
    assert server.asked[0].path == "/v1/chat/completions"
    assert server.asked[0].headers["Authorization"] == f"Bearer {KEY}"
    url = "data:image/png;base64," + base64.b64encode(IMAGE.data).decode()
    assert first["messages"] == [
        {"role": "system", "content": "you plan"},
        {"role": "user", "content": [{"type": "text", "text": "what now?"}, {"type": "image_url", "image_url": {"url": url}}]},
    ]
    assert (first["model"], first["temperature"], first["max_tokens"]) == ("some-model", 0.5, 77)
    assert "max_completion_tokens" not in first
    assert first["response_format"]["type"] == "json_schema"
    assert first["response_format"]["json_schema"] == {
        "name": "Steps",
        "strict": True,
        "schema": {
            "type": "object",
            "properties": {"steps": {"type": "array", "items": {"type": "string"}}},
            "required": ["steps"],
            "additionalProperties": False,
        },
    }
    assert second["response_format"] == {"type": "json_object"}
    assert (second["max_completion_tokens"], "max_tokens" in second) == (77, False)
    assert "response_format" not in third and "response_format" not in fourth
    assert fourth["temperature"] == 0.0


@pytest.mark.parametrize(
    ("body", "text", "reason"),
    [
        (completion("cut", finish_reason="length"), "cut", "length"),
        (completion(None, finish_reason="length"), "", "length"),
        (completion(""), "", "stop"),
        (completion(None), "", "stop"),
        (completion("half", finish_reason="content_filter"), "half", "refusal"),
        (completion(message={"role": "assistant", "content": None, "refusal": "I cannot"}), "I cannot", "refusal"),
        (completion("fine", finish_reason=None), "fine", "stop"),
        (completion("fine", finish_reason="eos_token"), "fine", "stop"),
        ({"choices": [{"message": {"content": "least"}}]}, "least", "stop"),
        (completion(message={"content": [{"type": "text", "text": "in "}, {"text": "parts"}]}), "in parts", "stop"),
        (completion(message={"content": [{"type": "image", "text": None}, {"type": "text", "text": "one"}]}), "one", "stop"),
        (completion("half \ud83d"), "half ?", "stop"),
    ],
)
def test_ends_of_replies(cfg: BackendConfig, server: LoopbackServer, body: object, text: str, reason: str) -> None:
    server.answer = lambda handler: handler.send(200, body)
    reply = reply_of(cfg)
    assert (reply.text, reply.finish_reason) == (text, reason)


@pytest.mark.parametrize(
    ("usage", "tokens"),
    [
        (None, (0, 0)),
        ("many", (0, 0)),
        ({}, (0, 0)),
        ({"prompt_tokens": "100", "completion_tokens": 1, "total_tokens": 101}, (0, 0)),
        ({"prompt_tokens": -1, "completion_tokens": 1, "total_tokens": 0}, (0, 0)),
        ({"prompt_tokens": 5, "completion_tokens": None, "total_tokens": 9}, (0, 0)),
        ({"prompt_tokens": 10**400, "completion_tokens": 1, "total_tokens": 1}, (0, 0)),
        ({"prompt_tokens": 5, "completion_tokens": 2}, (5, 2)),
        ({"prompt_tokens": 5, "completion_tokens": 2, "total_tokens": 17}, (5, 12)),  # thoughts are in the total alone
    ],
)
def test_usage(cfg: BackendConfig, server: LoopbackServer, usage: object, tokens: tuple[int, int]) -> None:
    server.answer = lambda handler: handler.send(200, completion(usage=usage))
    reply = reply_of(cfg)
    assert (reply.prompt_tokens, reply.completion_tokens) == tokens
    assert reply.text == "Pick(left, Mug_1)"


@pytest.mark.parametrize(
    ("body", "content_type", "message"),
    [
        (b"<html>Sign in</html>", "text/html; charset=utf-8", "the reply is 'text/html', not JSON: <html>Sign in</html>"),
        (completion(), "text/event-stream", "the reply is 'text/event-stream', not JSON"),
        (b"{not json", "application/json", r"no chat completion: Invalid JSON.*\{not json"),
        (b"", "application/json", "no chat completion: Invalid JSON"),
        ([1, 2], "application/json", "no chat completion: "),
        ({"object": "list"}, "application/json", "no chat completion: choices: Field required"),
        (completion(choices=[]), "application/json", "no chat completion: choices: List should have at least 1 item"),
        (
            completion(message={"content": 5}),
            "application/json",
            r"choices\.0\.message\.content.str: Input should be a valid string",
        ),
        (b'{"choices": [{"message": {"content": "\xff"}}]}', "application/json", "no chat completion: Invalid JSON"),
        (completion("half", finish_reason="error"), "application/json", "broke off with finish_reason 'error'"),
    ],
)
def test_what_is_no_completion(cfg, server: LoopbackServer, body: object, content_type: str, message: str) -> None:
    server.answer = lambda handler: handler.send(200, body, content_type)
    with pytest.raises(LostReplyError, match=message):
        reply_of(cfg)


@pytest.mark.parametrize(
    ("status", "error", "kind", "message"),
    [
        (
            401,
            {"message": "Incorrect API key", "code": "invalid_api_key"},
            BackendSetupError,
            "HTTP 401: invalid_api_key: Incorrect",
        ),
        (403, {"message": "Country not supported"}, BackendSetupError, "HTTP 403"),
        (404, {"message": "no model x", "code": "model_not_found"}, BackendSetupError, "HTTP 404: model_not_found: no model x"),
        (402, {"message": "Insufficient balance"}, BackendSetupError, "HTTP 402"),
        (429, {"message": "You exceeded your quota", "code": "insufficient_quota"}, BackendSetupError, "HTTP 429"),
        (400, {"message": "API key not valid. Please pass a valid API key."}, BackendSetupError, "HTTP 400: API key not valid"),
        (400, {"message": "The model `x` does not exist"}, BackendSetupError, "does not exist"),
        (
            400,
            {"message": "Unsupported parameter: 'max_tokens'", "code": "unsupported_parameter"},
            BackendSetupError,
            "max_tokens",
        ),
        (400, {"message": "Invalid schema for response_format 'Steps'"}, BackendSetupError, "Invalid schema"),
        (400, {"message": "This model's maximum context length is 4096 tokens", "param": "model"}, BackendError, "4096"),
        (400, {"message": "The image could not be decoded"}, BackendError, "could not be decoded"),
        (422, {"message": "bad value"}, BackendError, "HTTP 422: bad value"),
        (413, {"message": "Request too large"}, BackendError, "HTTP 413"),
        (429, {"message": "Slow down"}, BackendError, r"HTTP 429: Slow down \(after 1 attempt\)"),
        (500, {"message": "oops"}, BackendError, r"HTTP 500: oops"),
        (503, {"message": "overloaded"}, BackendError, r"HTTP 503"),
        (504, {"message": "upstream"}, LostReplyError, r"HTTP 504"),
    ],
)
def test_statuses(cfg, server: LoopbackServer, status: int, error: dict, kind: type, message: str) -> None:
    server.answer = lambda handler: handler.send(status, {"error": error})
    with pytest.raises(BackendError, match=message) as caught:
        reply_of(cfg)
    assert type(caught.value) is kind
    assert str(caught.value).startswith("backend tested: ")


@pytest.mark.parametrize(
    "body", [[{"error": {"message": "API key not valid"}}], {"message": "API key not valid"}, b"API key bad"]
)
def test_errors_of_other_forms(cfg: BackendConfig, server: LoopbackServer, body: object) -> None:
    server.answer = lambda handler: handler.send(400, body)
    assert isinstance(error_of(cfg), BackendSetupError)


@pytest.mark.parametrize(
    "error",
    [
        {"message": "The response was filtered", "code": "content_filter"},
        {"message": "Your request was rejected as a result of our safety system."},
        {"message": "flagged", "code": "content_policy_violation"},
    ],
)
def test_a_content_policy_is_a_refusal(cfg: BackendConfig, server: LoopbackServer, error: dict) -> None:
    server.answer = lambda handler: handler.send(400, {"error": error})
    assert dataclasses.replace(reply_of(cfg), latency_s=0.0) == ChatReply("", finish_reason="refusal", model="some-model")


def test_a_model_name_is_one_short_line(cfg: BackendConfig, server: LoopbackServer) -> None:
    server.answer = lambda handler: handler.send(200, completion(model="gpt\n\x1b[31m4" + "o" * 10**6))
    name = reply_of(cfg).model
    assert (name[:12], len(name)) == ("gpt [31m4ooo", 200)


def test_429_then_a_reply(cfg: BackendConfig, server: LoopbackServer) -> None:
    server.answer = lambda h: h.fail(429, "Slow down") if len(server.asked) < 3 else h.send(200, completion("at last"))
    assert reply_of(cfg, retries=2).text == "at last"
    assert len(server.asked) == 3


def test_429_for_ever(cfg: BackendConfig, server: LoopbackServer) -> None:
    server.answer = lambda handler: handler.fail(429, "Slow down")
    assert "HTTP 429: Slow down (after 3 attempts)" in str(error_of(cfg, retries=2))
    assert len(server.asked) == 3


def test_what_no_repetition_mends_is_not_repeated(cfg: BackendConfig, server: LoopbackServer) -> None:
    server.answer = lambda handler: handler.fail(401, "no")
    error_of(cfg, retries=3)
    assert len(server.asked) == 1


def test_a_silent_server(cfg: BackendConfig, server: LoopbackServer) -> None:
    done = threading.Event()
    server.answer = lambda handler: (done.wait(5.0), None)[1]
    start = time.perf_counter()
    error = error_of(cfg, timeout_s=0.2)
    done.set()
    assert isinstance(error, LostReplyError) and "no reply within 0.2 s, after 1 attempt" in str(error)
    assert time.perf_counter() - start < 2.0


def drip(handler: Handler) -> None:
    """A body that comes a blank at a time."""
    handler.send_response(200)
    handler.send_header("Content-Type", "application/json")
    handler.send_header("Content-Length", "1000")
    handler.end_headers()
    for _ in range(100):
        handler.wfile.write(b" ")
        time.sleep(0.05)


def test_a_server_that_drips(cfg: BackendConfig, server: LoopbackServer) -> None:
    server.answer = drip
    start = time.perf_counter()
    error = error_of(cfg, timeout_s=0.4)
    assert isinstance(error, LostReplyError) and "no reply within 0.4 s" in str(error)
    assert time.perf_counter() - start < 2.0


def test_a_connection_cut_in_a_reply(cfg: BackendConfig, server: LoopbackServer) -> None:
    def cut(handler: Handler) -> None:
        handler.send_response(200)
        handler.send_header("Content-Type", "application/json")
        handler.send_header("Content-Length", "1000")
        handler.end_headers()
        handler.wfile.write(b'{"choices": [')
        handler.close_connection = True

    server.answer = cut
    error = error_of(cfg)
    assert isinstance(error, LostReplyError) and "the connection broke" in str(error)


def test_nobody_listens(cfg: BackendConfig) -> None:
    error = error_of(cfg, base_url="http://127.0.0.1:1/v1")
    assert type(error) is UnreachableError
    assert "http://127.0.0.1:1/v1/: no connection after 1 attempt: ConnectError" in str(error)
    assert str(error).endswith("; is a server running there? `make serve` starts this project's")


@pytest.mark.parametrize(
    ("status", "body", "revision"),
    [
        (200, {"object": "list", "data": [{"id": "other", "revision": "b"}, {"id": "served-model", "revision": "a1"}]}, "a1"),
        (200, {"object": "list", "data": [{"id": "other", "revision": "b"}]}, ""),
        (200, {"object": "list", "data": [{"id": "served-model"}]}, ""),
        (200, {"object": "list", "data": [{"id": "served-model", "revision": 3}]}, ""),
        (200, {"object": "list", "data": []}, ""),
        (200, {"data": None}, ""),
        (200, ["what"], ""),
        (200, "no JSON", ""),
        (200, b"", ""),
        (200, b"<html>", ""),
        (200, b"\xff", ""),
        pytest.param(200, b"[" * 100_000, "", id="deep"),
        (200, {"data": [{"id": "served-model", "revision": " a\n\x1b[31m\ud800b "}]}, "a [31mb"),
        (200, {"data": [{"id": "served-model", "revision": f"{KEY} {'x' * 1000}"}]}, f"[key] {'x' * 194}"),
        (404, {"error": "no such path"}, ""),
    ],
)
def test_the_revision_that_a_server_tells(
    cfg: BackendConfig, server: LoopbackServer, status: int, body: object, revision: str
) -> None:
    server.answer = lambda handler: handler.send(status, body)
    backend = OpenAIChat(dataclasses.replace(cfg, model="served-model"))
    assert backend.revision() == revision
    backend.close()


def test_a_list_of_models_that_drips_is_not_waited_for(
    cfg: BackendConfig, server: LoopbackServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("proprio_mllm.backends.openai_chat._LIST_TIMEOUT_S", 0.3)

    server.answer = drip
    backend = OpenAIChat(cfg)
    start = time.perf_counter()
    assert backend.revision() == ""
    assert time.perf_counter() - start < 2.0
    backend.close()


def test_nobody_tells_a_revision(cfg: BackendConfig) -> None:
    backend = OpenAIChat(dataclasses.replace(cfg, base_url="http://127.0.0.1:1/v1"))
    assert backend.revision() is None
    backend.close()


@pytest.mark.parametrize("status", [200, 500])
def test_a_huge_body(cfg: BackendConfig, server: LoopbackServer, status: int) -> None:
    sent = 0

    def pour(handler: Handler) -> None:
        nonlocal sent
        handler.send_response(status)
        handler.send_header("Content-Type", "application/json")
        handler.send_header("Transfer-Encoding", "chunked")
        handler.end_headers()
        for _ in range(1000):
            handler.wfile.write(b"10000\r\n" + b" " * 65536 + b"\r\n")
            sent += 65536

    server.answer = pour
    backend = OpenAIChat(dataclasses.replace(cfg, retries=2), limit_bytes=100_000)
    with pytest.raises(LostReplyError, match="the reply has more than 100000 bytes"):
        backend.complete(ask())
    backend.close()
    assert len(server.asked) == 1
    assert sent < 20_000_000  # what the system's buffers hold, not what the server has


def test_packed_bodies_and_redirects_are_not_taken(cfg: BackendConfig, server: LoopbackServer) -> None:
    server.answer = lambda handler: handler.send(200, b"\x1f\x8b", Content_Encoding="gzip")
    assert r"the reply is packed (gzip)" in str(error_of(cfg))
    assert server.asked[0].headers["Accept-Encoding"] == "identity"
    server.answer = lambda handler: handler.send(307, b"", Location="http://127.0.0.1:2/v1")
    error = error_of(cfg)
    assert isinstance(error, BackendSetupError) and "sends elsewhere, to http://127.0.0.1:2/v1" in str(error)
    assert len(server.asked) == 2


def test_many_threads(cfg: BackendConfig, server: LoopbackServer) -> None:
    def echo(handler: Handler) -> None:
        with server.lock:
            texts = [asked.body["messages"][1]["content"][0]["text"] for asked in server.asked]
        handler.send(200, completion("|".join(texts)))

    server.answer = echo
    backend = OpenAIChat(cfg)
    with ThreadPoolExecutor(16) as pool:
        replies = list(pool.map(lambda number: backend.complete(ask(f"question {number}!")), range(48)))
    backend.close()
    assert all(f"question {number}!" in reply.text for number, reply in enumerate(replies))
    assert len(server.asked) == 48


def test_a_closed_backend_answers_nothing(cfg: BackendConfig) -> None:
    backend = OpenAIChat(cfg)
    backend.close()
    with pytest.raises(BackendError, match="backend tested: closed"):
        backend.complete(ask())


def test_a_copy_elsewhere_reads_its_own_key(cfg: BackendConfig, server: LoopbackServer, monkeypatch) -> None:
    packed = pickle.dumps(OpenAIChat(cfg))
    assert KEY.encode() not in packed
    monkeypatch.setenv("TEST_API_KEY", "another-key-123")
    pickle.loads(packed).complete(ask())
    assert server.asked[0].headers["Authorization"] == "Bearer another-key-123"


def test_a_proxy_of_the_environment_is_passed_by_on_this_machine(cfg: BackendConfig, monkeypatch) -> None:
    monkeypatch.setenv("HTTP_PROXY", "http://127.0.0.1:1")
    monkeypatch.setenv("OPENAI_BASE_URL", "http://127.0.0.1:1/v1")
    assert reply_of(cfg).text == "Pick(left, Mug_1)"


@pytest.mark.parametrize(("variable", "value"), [("ALL_PROXY", "socks4://127.0.0.1:9"), ("SSL_CERT_FILE", "/nowhere.pem")])
def test_an_environment_that_cannot_be_used(cfg: BackendConfig, monkeypatch, variable: str, value: str) -> None:
    monkeypatch.setenv(variable, value)
    with pytest.raises(BackendSetupError, match=r"backend tested: HTTP cannot be used as the environment asks .*: \w+Error: "):
        OpenAIChat(dataclasses.replace(cfg, base_url="https://example.com/v1"))


def test_missing_keys(cfg: BackendConfig, server: LoopbackServer, monkeypatch, caplog) -> None:
    monkeypatch.delenv("TEST_API_KEY")
    assert reply_of(cfg).text == "Pick(left, Mug_1)"
    assert server.asked[0].headers["Authorization"] == "Bearer none"
    for url in (None, "https://example.com/v1"):
        with pytest.raises(BackendSetupError, match="backend tested: no key; set the environment variable TEST_API_KEY"):
            OpenAIChat(dataclasses.replace(cfg, base_url=url))
    monkeypatch.setenv("TEST_API_KEY", KEY)
    with caplog.at_level(logging.WARNING):
        OpenAIChat(dataclasses.replace(cfg, base_url="http://example.com/v1")).close()
    assert "the key in TEST_API_KEY is sent unencrypted" in caplog.text


@pytest.mark.parametrize(
    "url", ["localhost:8000/v1", "ftp://127.0.0.1/", "http://", "http://[::1", "http://a:b/", "http://a b/"]
)
def test_urls_that_cannot_be_asked(cfg: BackendConfig, url: str) -> None:
    with pytest.raises(BackendSetupError, match=r"base_url '.*' is not allowed; allowed: http\(s\)://HOST"):
        OpenAIChat(dataclasses.replace(cfg, base_url=url))


@pytest.mark.parametrize("url", ["http://user:pass@127.0.0.1/v1", "http://127.0.0.1/v1?key=secret"])
def test_keys_do_not_belong_in_urls(cfg: BackendConfig, url: str) -> None:
    with pytest.raises(BackendSetupError, match="base_url holds a user or a query; a key belongs in the environment"):
        OpenAIChat(dataclasses.replace(cfg, base_url=url))
