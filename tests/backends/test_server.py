"""The server over a scripted backend: answers, errors as OpenAI's error object, and calls at once."""

from __future__ import annotations

import json
import socket
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import openai
import pytest
from openai.types.chat import ChatCompletion

from proprio_mllm.backends import server as server_module
from proprio_mllm.backends.protocol import BackendError, ChatReply, ChatRequest, RequestError
from proprio_mllm.backends.server import ChatServer


class Echo:
    """Says what it was asked last; fails when told to."""

    identity = "echo"

    def __init__(self) -> None:
        self.together = threading.Barrier(4, timeout=30)

    def complete(self, request: ChatRequest) -> ChatReply:
        text = request.messages[-1].text
        if text == "too long":
            raise RequestError("prompt of 9 tokens")
        if text == "busy":
            raise BackendError("out of memory")
        if text.startswith("together"):
            self.together.wait()
        return ChatReply(text, 3, 2, finish_reason="stop", model="echo@1")

    def close(self) -> None:
        pass


@pytest.fixture
def served() -> Iterator[ChatServer]:
    with ChatServer(Echo(), "echo", port=0) as server:
        thread = threading.Thread(target=server.serve_forever, args=(0.02,))
        thread.start()
        yield server
        server.shutdown()
        thread.join(30)


@pytest.fixture
def client(served: ChatServer) -> Iterator[openai.OpenAI]:
    with openai.OpenAI(base_url=served.url, api_key="none", max_retries=0, timeout=30) as client:
        yield client


def ask(client: openai.OpenAI, text: str, **fields: Any) -> ChatCompletion:
    values: dict[str, Any] = {"model": "echo", "messages": [{"role": "user", "content": text}]} | fields
    return client.chat.completions.create(**values)


def raw(server: ChatServer, head: str, body: bytes = b"") -> tuple[int, dict[str, Any]]:
    """Status and JSON of an answer to bytes that no client would send."""
    with socket.create_connection(("127.0.0.1", server.server_address[1]), timeout=30) as connection:
        connection.sendall(head.replace("\n", "\r\n").encode() + b"\r\n\r\n" + body)
        answer = b"".join(iter(lambda: connection.recv(2**16), b""))
    first, _, rest = answer.partition(b"\r\n")
    return int(first.split()[1]), json.loads(rest.partition(b"\r\n\r\n")[2])


def test_chats_and_models_through_the_sdk(client: openai.OpenAI) -> None:
    reply = ask(client, "look", temperature=0)
    assert reply.choices[0].message.content == "look"
    assert reply.choices[0].finish_reason == "stop"
    assert reply.usage is not None
    assert reply.usage.total_tokens == 5
    assert [model.id for model in client.models.list()] == ["echo"]


def test_calls_are_answered_at_once(client: openai.OpenAI) -> None:
    with ThreadPoolExecutor(4) as pool:
        replies = list(pool.map(lambda n: ask(client, f"together {n}"), range(4)))
    assert [reply.choices[0].message.content for reply in replies] == [f"together {n}" for n in range(4)]


def test_errors_are_openais(client: openai.OpenAI) -> None:
    with pytest.raises(openai.BadRequestError, match="temperature: Input should be less than or equal to 2") as caught:
        ask(client, "look", temperature=9)
    assert caught.value.type == "invalid_request_error"
    with pytest.raises(openai.BadRequestError, match="prompt of 9 tokens"):
        ask(client, "too long")
    with pytest.raises(openai.NotFoundError, match="model 'gpt' is not served; allowed: echo") as missing:
        ask(client, "look", model="gpt")
    assert missing.value.code == "model_not_found"
    with pytest.raises(openai.InternalServerError, match="out of memory") as busy:
        ask(client, "busy")
    assert (busy.value.status_code, busy.value.type) == (503, "server_error")


def test_calls_that_are_no_chats_are_refused(served: ChatServer, monkeypatch: pytest.MonkeyPatch) -> None:
    chat = "POST /v1/chat/completions HTTP/1.1\nHost: localhost\nContent-Type: application/json"
    assert raw(served, "GET /v1/other HTTP/1.1") == (
        404,
        error("no such path: /v1/other; allowed: /v1/chat/completions, /v1/models"),
    )
    assert raw(served, "GET /v1/chat/completions HTTP/1.1") == (405, error("/v1/chat/completions takes POST, not GET"))
    assert raw(served, "POST /v1/models HTTP/1.1") == (405, error("/v1/models takes GET, not POST"))
    plain = chat.replace("application/json", "text/plain")
    assert raw(served, plain) == (415, error("Content-Type 'text/plain'; expected application/json"))
    assert raw(served, chat) == (411, error("Content-Length ''; expected a number"))
    assert raw(served, f"{chat}\nContent-Length: -1") == (411, error("Content-Length '-1'; expected a number"))
    monkeypatch.setattr(server_module, "_BODY_BYTES", 2000)
    status, content = raw(served, f"{chat}\nContent-Length: 2001", b"x" * 2001)
    assert (status, content) == (413, error("request of 2001 bytes; allowed: 2000"))
    assert raw(served, f"{chat}\nContent-Length: 2", b"{}")[0] == 400


def test_a_client_that_stops_sending_is_not_waited_for(served: ChatServer, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(server_module._Handler, "timeout", 0.2)
    head = "POST /v1/chat/completions HTTP/1.1\nContent-Type: application/json\nContent-Length: 9"
    assert raw(served, head, b"{") == (408, error("the request did not arrive within 0.2 s"))


def test_only_this_machine_is_listened_to(served: ChatServer) -> None:
    assert served.server_address[0] == "127.0.0.1"
    with pytest.raises(OSError, match="in use"):
        ChatServer(Echo(), "echo", served.server_address[1])


def error(message: str) -> dict[str, Any]:
    return {"error": {"message": message, "type": "invalid_request_error", "param": None, "code": None}}


@pytest.mark.parametrize(
    ("host", "status"),
    [
        ("127.0.0.1", 200), ("localhost:{port}", 200), ("[::1]:{port}", 200), ("[::1]", 200),
        ("evil.example:{port}", 403), ("evil.example", 403), ("", 403), ("127.0.0.1.evil.example", 403),
    ],
)  # fmt: skip
def test_a_page_under_another_name_is_not_answered(served: ChatServer, host: str, status: int) -> None:
    port = served.server_address[1]
    with socket.create_connection(("127.0.0.1", port), timeout=20) as client:
        client.sendall(f"GET /v1/models HTTP/1.1\r\nHost: {host.format(port=port)}\r\n\r\n".encode())
        assert client.recv(100).startswith(f"HTTP/1.1 {status} ".encode())
