"""The Controller over HTTP: the same events, isolated worlds, limits, and who may ask."""

from __future__ import annotations

import contextlib
import http.server
import json
import socket
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from typing import ClassVar

import numpy as np
import pytest

from configs.schema.checks import is_loopback
from sim.interfaces.controller import Controller
from sim.interfaces.remote.client import RemoteController, RemoteError
from sim.interfaces.remote.protocol import ProtocolError, loads
from sim.interfaces.remote.serve import main
from sim.interfaces.remote.server import RemoteServer, ServerConfig

TOKEN = "a token for the tests"
SMALL = {"robot_type": "x1", "scene": "bathroom_1", "width": 32, "height": 32}


def _serving(server: RemoteServer) -> threading.Thread:
    thread = threading.Thread(target=server.serve, daemon=True)
    thread.start()
    return thread


@pytest.fixture(scope="module")
def server() -> Iterator[RemoteServer]:
    made = RemoteServer(ServerConfig(port=0, worlds=2, idle_s=600.0), TOKEN)
    thread = _serving(made)
    yield made
    made.stop()
    thread.join(10.0)


def _status(server: RemoteServer, method: str, path: str, body: bytes | None = None, **headers: str) -> tuple[int, str]:
    request = urllib.request.Request(server.url + path, body, {"Authorization": f"Bearer {TOKEN}", **headers}, method=method)
    try:
        with urllib.request.urlopen(request, timeout=60) as reply:
            return reply.status, reply.read().decode()
    except urllib.error.HTTPError as error:
        return error.code, json.loads(error.read())["error"]


def test_events_are_those_of_a_controller_here(server: RemoteServer) -> None:
    far = RemoteController(server.url, TOKEN, **SMALL)
    near = Controller(**SMALL)
    try:
        for call in ({"action": "MoveAhead", "amount": 0.2}, {"action": "PutObject", "objectId": "CounterTop_1"}):
            there, here = far.step(call), near.step(call)
            assert there.metadata == json.loads(json.dumps(here.metadata))
            assert np.array_equal(there.frame, here.frame) and np.array_equal(there.depth_frame, here.depth_frame)
            assert set(there.instance_masks) == set(here.instance_masks)
        with pytest.raises(ValueError, match="unknown action 'Fly'"):
            far.step("Fly")
        with pytest.raises(ValueError, match="cannot be sent as JSON"):
            far.step("MoveAhead", amount=float("nan"))
        assert far.reset(seed=3).metadata["lastAction"] == "Reset"
    finally:
        far.stop()
        near.stop()


def test_worlds_are_isolated_and_limited(server: RemoteServer) -> None:
    first, second = (RemoteController(server.url, TOKEN, images=[], **SMALL) for _ in range(2))
    try:
        start = second.last_event.metadata["agent"]["position"]
        moved = first.step("MoveAhead", amount=0.2).metadata["agent"]["position"]
        assert moved != start and second.step("Pass").metadata["agent"]["position"] == start
        assert first.last_event.frame.size == 0
        with pytest.raises(RemoteError, match="503: all 2 worlds are in use"):
            RemoteController(server.url, TOKEN, **SMALL)
        # a world that dies is gone, the other one stays
        world = server.worlds._worlds[first._world or ""]
        world.process.kill()
        world.process.join()
        with pytest.raises(RemoteError, match="404: the world's process has died"):
            first.step("Pass")
        assert second.step("Pass").metadata["lastActionSuccess"]
    finally:
        first.stop()
        second.stop()
    assert len(server.worlds) == 0


def test_who_may_ask(server: RemoteServer) -> None:
    with pytest.raises(RemoteError, match="401"):
        RemoteController(server.url, None, **SMALL)
    assert _status(server, "GET", "/health", Authorization="Bearer wrong")[0] == 401
    assert _status(server, "GET", "/health", Host="evil.example")[0] == 403
    status, text = _status(server, "GET", "/health")
    assert status == 200 and json.loads(text)["limit"] == 2
    with pytest.raises(ValueError, match=r"'0\.0\.0\.0' can be reached from elsewhere: a token"):
        RemoteServer(ServerConfig(host="0.0.0.0", port=0))
    assert is_loopback("127.0.0.1") and is_loopback("[::1]") and not is_loopback("192.168.0.1") and not is_loopback("x")


@pytest.mark.parametrize(
    ("method", "path", "body", "headers", "status", "message"),
    [
        ("POST", "/worlds", b"{}", {"Content-Type": "text/plain"}, 415, "must be application/json"),
        ("POST", "/worlds", b"{", {}, 400, "the body is no JSON"),
        ("POST", "/worlds", b"[1]", {}, 400, "must be a JSON object"),
        ("POST", "/worlds", b'{"seed": NaN}', {}, 400, "NaN is no JSON number"),
        ("POST", "/worlds", b'{"colour": 1}', {}, 400, "unknown argument 'colour'"),
        ("POST", "/worlds", b'{"images": ["xray"]}', {}, 400, "unknown image 'xray'"),
        ("POST", "/worlds", b'{"scene": "attic"}', {}, 400, "unknown room 'attic'"),
        ("POST", "/worlds", b'{"seed": ' + b"9" * 5000 + b"}", {}, 400, "the body is no JSON"),
        ("POST", "/worlds", b'{"robot_type": "/etc/robot.yaml"}', {}, 400, "allowed: h1, x1"),
        ("POST", "/worlds", b'{"robot_type": ["h1"]}', {}, 400, "allowed: h1, x1"),
        ("POST", "/worlds", b'{"third_party_cameras": [null]}', {}, 400, "unknown camera None"),
        ("POST", "/worlds/nobody/step", b"{}", {}, 404, "no such world"),
        ("POST", "/nothing", b"{}", {}, 404, "allowed: /worlds"),
        ("GET", "/worlds", None, {}, 404, "allowed: /health"),
        ("DELETE", "/worlds/nobody", None, {}, 404, "no such world"),
        ("POST", "/worlds", b" " * (1 << 20) + b"{}", {}, 413, "at most 1048576"),
    ],
)
def test_bad_requests(
    server: RemoteServer, method: str, path: str, body: bytes | None, headers: dict[str, str], status: int, message: str
) -> None:
    found, text = _status(server, method, path, body, **({"Content-Type": "application/json"} | headers))
    assert found == status and message in text


def test_a_world_survives_any_call(server: RemoteServer, monkeypatch: pytest.MonkeyPatch) -> None:
    far, near = RemoteController(server.url, TOKEN, images=[], **SMALL), Controller(**SMALL)
    try:
        for one in (far, near):
            assert one.step("MoveAhead", amount=0.1).metadata["lastActionSuccess"]
            one.step("Done")
            for _ in range(2):
                with pytest.raises(RuntimeError, match="the episode is over: reset first"):
                    one.step("MoveAhead")
            assert one.step("Undo").metadata["actionReturn"] is True, "the refused calls are no steps to go back"
            assert one.step("MoveAhead", amount=0.1).metadata["lastActionSuccess"]
        for call, said in (
            ({"action": 7}, "unknown action '7'"),
            ({"action": "PickupObject", "objectId": {"a": 1}}, "object id"),
            ({"action": "LoadState", "name": "x"}, "no saved state 'x'"),
        ):
            with pytest.raises(ValueError, match=said):
                far.step(call)
        for number in range(100):
            far.step("SaveState", name=f"s{number}")
        with pytest.raises(ValueError, match="100 states are saved"):
            far.step("SaveState", name="one more")
        assert far.step("SaveState", name="s0").metadata["actionReturn"] == "s0"
    finally:
        far.stop()
        near.stop()


def test_a_client_that_leaves_while_its_world_opens_frees_the_place(server: RemoteServer) -> None:
    body = json.dumps(SMALL).encode()
    head = (
        f"POST /worlds HTTP/1.1\r\nHost: 127.0.0.1\r\nAuthorization: Bearer {TOKEN}\r\n"
        f"Content-Type: application/json\r\nContent-Length: {len(body)}\r\n\r\n"
    )
    host, port = server.url.removeprefix("http://").split(":")
    with socket.create_connection((host, int(port))) as client:
        client.sendall(head.encode() + body)
        time.sleep(0.3)
    deadline = time.monotonic() + 60.0
    while (server.worlds._opening or len(server.worlds)) and time.monotonic() < deadline:
        time.sleep(0.1)
    assert len(server.worlds) == server.worlds._opening == 0


class _Liar(http.server.BaseHTTPRequestHandler):
    """Answers whatever the test wants."""

    answer = b""
    shown: ClassVar[list[str | None]] = []

    def do_POST(self) -> None:
        self.shown.append(self.headers.get("Authorization"))
        self.rfile.read(int(self.headers["Content-Length"]))
        self.wfile.write(self.answer)

    def log_message(self, format: str, *args: object) -> None:
        """Says nothing."""


@pytest.mark.parametrize(
    ("answer", "said"),
    [
        (b"HTTP/1.1 200 OK\r\nContent-Length: 2\r\n\r\n[]", "no JSON object"),
        (b"HTTP/1.1 200 OK\r\nContent-Length: 2\r\n\r\n{}", "holds no event"),
        (b"HTTP/1.1 200 OK\r\nContent-Length: 99\r\n\r\n{}", "makes no sense"),
        (b'HTTP/1.1 200 OK\r\nContent-Length: 25\r\n\r\n{"world": 1, "event": {}} ', "holds no event"),
        (b"nonsense", "makes no sense"),
        (b"", "makes no sense"),
    ],
)
def test_answers_that_make_no_sense_are_one_error(answer: bytes, said: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(_Liar, "answer", answer)
    with _listening(_Liar) as port, pytest.raises(RemoteError, match=said):
        RemoteController(f"http://127.0.0.1:{port}", **SMALL)


def test_the_token_goes_to_its_own_server_only(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(_Liar, "shown", [])
    with _listening(_Liar) as other, _listening(_Liar) as port:
        moved = f"HTTP/1.1 302 Found\r\nLocation: http://127.0.0.1:{other}/worlds\r\nContent-Length: 0\r\n\r\n"
        monkeypatch.setattr(_Liar, "answer", moved.encode())
        monkeypatch.setenv("http_proxy", f"http://127.0.0.1:{other}")
        with pytest.raises(RemoteError, match="302"):
            RemoteController(f"http://127.0.0.1:{port}", "a secret of the user", **SMALL)
    assert _Liar.shown == ["Bearer a secret of the user"]


def test_a_server_that_is_just_starting_is_waited_for() -> None:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    made: list[RemoteServer] = []

    def start() -> None:
        made.append(RemoteServer(ServerConfig(port=port, worlds=1)))
        made[0].serve()

    timer = threading.Timer(0.3, start)
    timer.start()
    client = RemoteController(f"http://127.0.0.1:{port}", images=[], **SMALL)
    client.stop()
    made[0].stop()
    timer.join(10.0)
    with pytest.raises(RemoteError, match="cannot be reached"):
        RemoteController(f"http://127.0.0.1:{port}", **SMALL)


@contextlib.contextmanager
def _listening(handler: type[http.server.BaseHTTPRequestHandler]) -> Iterator[int]:
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    yield server.server_address[1]
    server.shutdown()
    server.server_close()


def test_idle_worlds_are_closed() -> None:
    server = RemoteServer(ServerConfig(port=0, worlds=1, idle_s=2.0))
    thread = _serving(server)
    client = RemoteController(server.url, images=[], **SMALL)
    process = next(iter(server.worlds._worlds.values())).process
    deadline = time.monotonic() + 20.0
    while len(server.worlds) and time.monotonic() < deadline:
        time.sleep(0.05)
    with pytest.raises(RemoteError, match="no such world"):
        client.step("Pass")
    server.stop()
    thread.join(10.0)
    assert not process.is_alive()


def test_command_line_refuses(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("DUALTHOR_TOKEN", raising=False)
    for arguments, message in (
        (["port=99999"], "port 99999 outside"),
        (["speed=1"], "speed: unknown key"),
        (["worlds=0"], "worlds must be at least 1"),
        (["host=0.0.0.0", "port=0"], "set DUALTHOR_TOKEN"),
    ):
        assert main(arguments) == 2
        assert message in capsys.readouterr().err
    with pytest.raises(ProtocolError, match="Infinity"):
        loads(b'{"a": Infinity}')
