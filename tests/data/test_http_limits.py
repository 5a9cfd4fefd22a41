"""Limits of the project's HTTP servers: connections, slow requests, lengths, clients that leave."""

from __future__ import annotations

import socket
import threading
import time
import urllib.request
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor

import pytest

from data.http_limits import LimitedHandler, LimitedServer, body_length, has_left

pytestmark = pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")


class _Handler(LimitedHandler):
    protocol_version = "HTTP/1.1"
    arrival_s = 0.5
    gate = threading.Event()

    def do_GET(self) -> None:
        if self.path == "/wait":
            self.gate.wait(10.0)
        self._say(b"ok")

    def do_POST(self) -> None:
        data = self.rfile.read(body_length(self.headers["Content-Length"]) or 0)
        self.arrived()
        time.sleep(0.8)  # the answer may take longer than the request
        self._say(data)

    def _say(self, data: bytes) -> None:
        self.send_response(200)
        self.send_header("Content-Length", str(len(data)))
        self.end_headers()
        self.wfile.write(data)

    def log_message(self, format: str, *args: object) -> None:
        """Says nothing."""


@pytest.fixture
def server() -> Iterator[LimitedServer]:
    made = LimitedServer(("127.0.0.1", 0), _Handler)
    made.daemon_threads = True
    _Handler.gate.clear()
    threading.Thread(target=made.serve_forever, daemon=True).start()
    yield made
    _Handler.gate.set()
    made.shutdown()
    made.server_close()


def ask(server: LimitedServer, path: str = "/", data: bytes | None = None) -> bytes:
    with urllib.request.urlopen(f"http://127.0.0.1:{server.server_address[1]}{path}", data, timeout=20) as reply:
        return reply.read()


def connect(server: LimitedServer) -> socket.socket:
    return socket.create_connection(("127.0.0.1", server.server_address[1]), timeout=20)


def test_fifty_at_once_are_answered(server: LimitedServer, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(_Handler, "arrival_s", LimitedHandler.arrival_s)  # no client is late on a busy machine
    with ThreadPoolExecutor(50) as pool:
        assert [one.result() for one in [pool.submit(ask, server) for _ in range(200)]] == [b"ok"] * 200


def test_who_comes_when_all_are_taken_is_told_so_and_places_come_back(
    server: LimitedServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(server, "connections", 2)
    with ThreadPoolExecutor(2) as pool:
        waiting = [pool.submit(ask, server, "/wait") for _ in range(2)]
        time.sleep(0.2)
        with connect(server) as third:
            assert third.recv(100).startswith(b"HTTP/1.1 503 ")
        _Handler.gate.set()
        assert [one.result() for one in waiting] == [b"ok"] * 2
    deadline = time.monotonic() + 5.0
    while server._served and time.monotonic() < deadline:
        time.sleep(0.05)
    assert ask(server) == b"ok"


def test_an_interrupt_while_a_connection_is_handed_over_ends_the_server(monkeypatch: pytest.MonkeyPatch) -> None:
    class Interrupted(threading.Thread):
        def start(self) -> None:
            super().start()
            self.join(20.0)  # the connection is served before the signal's exception is raised
            raise KeyboardInterrupt

    with LimitedServer(("127.0.0.1", 0), _Handler) as server:
        server.timeout = 20.0
        with connect(server) as client:
            client.sendall(b"GET / HTTP/1.1\r\nConnection: close\r\n\r\n")
            monkeypatch.setattr(threading, "Thread", Interrupted)
            with pytest.raises(KeyboardInterrupt):
                server.handle_request()
        assert not server._served


@pytest.mark.parametrize("start", [b"", b"GET / HTTP/1.1\r\n", b"POST / HTTP/1.1\r\nContent-Length: 1000\r\n\r\n"])
def test_a_request_that_drips_in_is_ended(server: LimitedServer, start: bytes) -> None:
    began = time.monotonic()
    with connect(server) as client:
        client.sendall(start)
        while time.monotonic() - began < 5.0:
            try:
                client.sendall(b"x")
            except OSError:
                break
            time.sleep(0.05)
    assert time.monotonic() - began < 3.0


def test_an_answer_may_take_longer_than_its_request(server: LimitedServer) -> None:
    assert ask(server, data=b"hello") == b"hello"


@pytest.mark.parametrize(
    ("text", "length"), [("0", 0), ("17", 17), ("", None), ("-1", None), ("9" * 5000, None), ("\u0663", None), ("1e3", None)]
)
def test_lengths(text: str, length: int | None) -> None:
    assert body_length(text) == length


def test_who_has_left_is_seen() -> None:
    near, far = socket.socketpair()
    near.settimeout(20.0)
    assert not has_left(near)
    far.sendall(b"more")
    assert not has_left(near)
    near.recv(4)
    far.close()
    assert has_left(near)
    near.close()
    assert has_left(near)
