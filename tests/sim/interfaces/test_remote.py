"""The Controller over HTTP: the same events, isolated worlds, limits, and who may ask."""

from __future__ import annotations

import json
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Iterator

import numpy as np
import pytest

from sim.interfaces.controller import Controller
from sim.interfaces.remote.client import RemoteController, RemoteError
from sim.interfaces.remote.protocol import ProtocolError, loads
from sim.interfaces.remote.serve import main
from sim.interfaces.remote.server import RemoteServer, ServerConfig, is_loopback

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
