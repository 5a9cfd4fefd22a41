"""A server on this machine that answers as it is told, a backend that answers at once, requests, processes."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from email.message import Message
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

from proprio_mllm.backends.protocol import ChatImage, ChatMessage, ChatReply, ChatRequest

ROOT = Path(__file__).parents[2]
KEY = "sk-test-4f9a0c77d1e2b3"
#: A 1 x 1 PNG is not needed: nobody here decodes pictures.
IMAGE = ChatImage(b"\x89PNG\r\n\x1a\n not a picture, but bytes")


def completion(content: str | None = "Pick(left, Mug_1)", **changes: Any) -> dict[str, Any]:
    """A chat completion as servers send it; `changes` replace fields, of the choice where it has them."""
    choice = {"index": 0, "message": {"role": "assistant", "content": content}, "finish_reason": "stop"}
    usage = {"prompt_tokens": 100, "completion_tokens": 10, "total_tokens": 110}
    body = {"id": "1", "object": "chat.completion", "created": 1, "model": "served-model", "choices": [choice], "usage": usage}
    for name, value in changes.items():
        (choice if name in choice else body)[name] = value
    return body


class Handler(BaseHTTPRequestHandler):
    """Reads a request, keeps it, and lets the server's `answer` reply."""

    protocol_version = "HTTP/1.1"
    disable_nagle_algorithm = True  # or every answer waits 40 ms for an acknowledgement
    server: LoopbackServer

    def do_GET(self) -> None:
        self.server.answer(self)

    def do_POST(self) -> None:
        body = self.rfile.read(int(self.headers["Content-Length"]))
        with self.server.lock:
            self.server.asked.append(Asked(self.path, self.headers, json.loads(body)))
        try:
            self.server.answer(self)
        except (BrokenPipeError, ConnectionResetError):
            self.close_connection = True

    def send(self, status: int, body: object, content_type: str = "application/json", **headers: str) -> None:
        """A whole answer."""
        data = body if isinstance(body, bytes) else json.dumps(body).encode()
        self.send_response(status)
        for name, value in {"Content-Type": content_type, "Content-Length": str(len(data)), **headers}.items():
            self.send_header(name.replace("_", "-"), value)
        self.end_headers()
        self.wfile.write(data)

    def fail(self, status: int, message: str, **fields: object) -> None:
        """An error in OpenAI's form, to be tried again at once where that is allowed."""
        self.send(status, {"error": {"message": message, **fields}}, Retry_After="0", Retry_After_Ms="1")

    def log_message(self, *_: object) -> None: ...


@dataclass
class Asked:
    """One request that came in."""

    path: str
    headers: Message
    body: dict[str, Any]


class LoopbackServer(ThreadingHTTPServer):
    """The server; tests set `answer`."""

    daemon_threads = True

    def __init__(self) -> None:
        super().__init__(("127.0.0.1", 0), Handler)
        self.lock = threading.Lock()
        self.asked: list[Asked] = []
        self.answer: Callable[[Handler], None] = lambda handler: handler.send(200, completion())

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.server_address[1]}/v1"

    def handle_error(self, *_: object) -> None: ...


def ask(text: str = "what now?", **changes: Any) -> ChatRequest:
    """A request with a picture."""
    return ChatRequest((ChatMessage("system", ("you plan",)), ChatMessage("user", (text, IMAGE))), **changes)


@dataclass
class Answering:
    """A backend that answers at once, from the request alone, and counts."""

    identity: str = "answering"
    reply: Callable[[ChatRequest], ChatReply] = lambda request: ChatReply(f"reply to {request.messages[-1].text}")
    asked: list[ChatRequest] = field(default_factory=list)
    closed: bool = False

    def complete(self, request: ChatRequest) -> ChatReply:
        self.asked.append(request)
        return self.reply(request)

    def close(self) -> None:
        self.closed = True


def started(code: str, *arguments: object) -> subprocess.Popen[str]:
    """A Python process that can import the project."""
    return subprocess.Popen(
        [sys.executable, "-c", code, *map(str, arguments)],
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )


def finished(*processes: subprocess.Popen[str]) -> list[str]:
    """What each wrote; all must have ended well."""
    written = [process.communicate(timeout=60)[0] for process in processes]
    assert [process.returncode for process in processes] == [0] * len(processes)
    return written
