"""The room to play in: what its page is told, what it refuses, and its controls in a browser."""

from __future__ import annotations

import socket
import subprocess
import sys
import threading
import time
import urllib.request
from collections.abc import Iterator

import numpy as np
import pytest
import uvicorn
from starlette.testclient import TestClient

from sim.play.game import Game, PlayConfig
from sim.play.server import application, main
from sim.play.viewer import HOST
from tests.browser import Browser

PATIENCE_S = 60.0


@pytest.fixture(scope="module")
def game() -> Iterator[Game]:
    one = Game(PlayConfig(speed=100.0))
    yield one
    one.close()


@pytest.fixture
def client(game: Game) -> TestClient:
    return TestClient(application(game), base_url=f"http://{HOST}")


def waited(game: Game) -> dict:
    deadline = time.monotonic() + PATIENCE_S
    while game.status["doing"]:
        assert time.monotonic() < deadline
        time.sleep(0.02)
    return game.status


def begun(game: Game, **chosen: object) -> dict:
    game.begin(**({"robot": "h1", "room": "kitchen_1", "task": None, "difficulty": "easy", "seed": 0} | chosen))
    return waited(game)


def act(game: Game, text: str) -> dict:
    game.act(text)
    return waited(game)


def test_a_mug_is_picked_and_picked_again(game: Game) -> None:
    start = begun(game)
    can = {one["id"]: one["can"] for one in start["objects"]}
    assert {"GoTo(Mug_1)", "Pick(left, Mug_1)", "Pick(right, Mug_1)"} <= set(can["Mug_1"])
    assert not any(text.startswith(("Open", "Place", "ToggleOn")) for text in can["Mug_1"])
    act(game, "GoTo(Mug_1)")
    held = act(game, "Pick(left, Mug_1)")
    assert held["hands"]["left"] == "Mug_1", held["history"]
    assert "Place(left, CounterTop_1)" in next(one["can"] for one in held["objects"] if one["id"] == "CounterTop_1")
    game.undo()
    assert waited(game)["hands"]["left"] is None and game.status["redo"] == 1
    game.redo()
    again = waited(game)
    assert again["hands"]["left"] == "Mug_1" and [one["step"] for one in again["history"]] == [
        "GoTo(Mug_1)",
        "Pick(left, Mug_1)",
    ]


def test_what_was_taken_back_is_forgotten_by_another_step(game: Game) -> None:
    begun(game)
    act(game, "RotateLeft()")
    game.undo()
    assert (waited(game)["undo"], game.status["redo"]) == (0, 1)
    assert (act(game, "RotateRight()")["undo"], game.status["redo"]) == (1, 0)
    game.redo()
    assert [one["step"] for one in waited(game)["history"]] == ["RotateRight()"]


def test_the_view_follows_to_another_world_of_the_same_looks(game: Game) -> None:
    begun(game)
    assert game._view is not None and game._session is not None
    before = game._session.world
    begun(game)
    assert game._session.world is not before and game._view._world is game._session.world
    act(game, "MoveAhead()")
    assert np.array_equal(game._view._state[1 : 1 + len(before.data.qpos)], game._session.world.data.qpos)


def test_goals_of_a_task_light_up(game: Game) -> None:
    status = begun(game, task="benchmark_pick_and_toggle_on_21024", room="kitchen_1")
    assert status["room"] == "bedroom_2" and [goal["met"] for goal in status["goals"]] == [False, False]
    act(game, "GoTo(TissueBox_1)")
    arm = next(text for one in game.status["objects"] if one["id"] == "TissueBox_1" for text in one["can"] if "Pick" in text)
    status = act(game, arm)
    assert {"text": "held(TissueBox_1)", "met": True} in status["goals"], status["history"]


def test_what_is_wrong_is_said_and_changes_nothing(game: Game, client: TestClient) -> None:
    begun(game)
    before = game.status
    for path, body, code, said in (
        ("/step", {"text": "Fly(Mug_1)"}, 400, "unknown action 'Fly'"),
        ("/step", {"text": "Pick(left, Mug_7)"}, 400, "no Mug_7 in this room"),
        ("/step", {"words": "MoveAhead()"}, 400, "text None"),
        (
            "/begin",
            {"robot": "h2", "room": "kitchen_1", "task": None, "difficulty": "easy", "seed": 0},
            400,
            "unknown robot 'h2'",
        ),
        ("/begin", {"robot": "h1", "room": "kitchen_1", "task": None, "difficulty": "easy", "seed": True}, 400, "seed True"),
        ("/step", {"text": "x" * 5000}, 413, "at most"),
    ):
        reply = client.post(path, json=body)
        assert reply.status_code == code and said in reply.json()["error"], reply.text
    assert client.post("/step", content='{"text": "MoveAhead()"}', headers={"content-type": "text/plain"}).status_code == 415
    assert client.get("/status", headers={"host": "elsewhere.example"}).status_code == 400
    assert client.get("/nothing").status_code == 404
    assert game.status == before


def test_one_step_at_a_time(game: Game, client: TestClient) -> None:
    begun(game)
    replies = [client.post("/step", json={"text": "MoveAhead()"}).status_code for _ in range(2)]
    assert replies == [200, 409] and len(waited(game)["history"]) == 1
    assert client.get("/head.png").content.startswith(b"\x89PNG")
    assert "Mug_1" in client.get("/status").text and "Fridge" not in client.get("/choices").json()["moves"]


def test_the_viewer_gets_what_the_world_looks_like(game: Game) -> None:
    begun(game)
    view, session = game._view, game._session
    assert view is not None and session is not None

    def served() -> bytes:
        with urllib.request.urlopen(f"{view.url}model") as reply:
            return reply.read()

    before, model = served(), session.world.model
    model.geom_rgba[int(np.flatnonzero(model.geom_rgba[:, 3] > 0)[0]), 0] = 0.123
    view.show()
    deadline = time.monotonic() + PATIENCE_S
    while served() == before:
        assert time.monotonic() < deadline
        time.sleep(0.1)
    assert len(served()) == len(before)


def test_the_viewer_ends_with_its_parent() -> None:
    code = """
import sys, time
from sim.play.live import LiveView
from sim.session.session import FreePlay, Session
if __name__ == "__main__":
    session = Session("h1", image_size=0)
    session.reset(FreePlay("bathroom_1"), 0)
    print(LiveView(session).url, flush=True)
    time.sleep(60)
"""
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True) as parent:
        assert parent.stdout is not None
        port = int(parent.stdout.readline().strip().rsplit(":", 1)[1].strip("/"))
        with socket.create_connection((HOST, port)):
            pass
        parent.kill()
    deadline = time.monotonic() + PATIENCE_S
    while True:
        try:
            socket.create_connection((HOST, port)).close()
        except OSError:
            break
        assert time.monotonic() < deadline, "the viewer has outlived its parent"
        time.sleep(0.1)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [(["robot=h2"], "h2"), (["task=pick_0"], "unknown task 'pick_0'"), (["speed=0"], "speed"), (["room=attic"], "attic")],
)
def test_wrong_arguments(arguments: list[str], said: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([*arguments, "port=0", "browser=false"]) == 2
    assert said in capsys.readouterr().err


@pytest.mark.chromium
def test_every_control_of_the_page(game: Game, browser: Browser) -> None:
    begun(game)
    server = uvicorn.Server(uvicorn.Config(application(game), host=HOST, port=0, lifespan="off", log_level="error"))
    thread = threading.Thread(target=server.run, daemon=True)
    thread.start()
    while not server.started:
        time.sleep(0.02)
    browser.open(f"http://{HOST}:{server.servers[0].sockets[0].getsockname()[1]}/")

    def until(condition: str) -> None:
        deadline = time.monotonic() + PATIENCE_S
        while not browser.eval(condition):
            assert time.monotonic() < deadline, f"{condition}: {browser.eval('document.body.innerText')}"
            time.sleep(0.05)

    def press(where: str, text: str) -> None:
        until(f"[...document.querySelectorAll('{where}')].some((b) => b.textContent === '{text}' && !b.disabled)")
        browser.eval(f"[...document.querySelectorAll('{where}')].find((b) => b.textContent === '{text}').click()")

    def typed(text: str) -> None:
        browser.eval(f"$('text').value = '{text}'; $('text').dispatchEvent(new Event('input'))")

    log = "$('log').innerText"
    press("#objects button", "Mug_1")
    press("#can button", "GoTo")
    until(f"{log}.includes('GoTo(Mug_1)')")
    press("#can button", "Pick left")
    until("$('hands').innerText.includes('Mug_1')")
    press("#bar button", "Undo")
    until("!$('hands').innerText.includes('Mug_1')")
    press("#bar button", "Redo")
    until("$('hands').innerText.includes('Mug_1')")
    typed("RotateL")
    assert browser.eval("$('hints').innerText").startswith("RotateLeft()")
    browser.press("Tab") if browser.eval("$('text').focus(); true") else None
    assert browser.eval("$('text').value") == "RotateLeft()"
    typed("Place(left, Counter")
    assert browser.eval("[...$('hints').children].map((row) => row.firstChild.textContent)") == [
        "CounterTop_1)",
        "CounterTop_2)",
    ]
    typed("Fly()")
    press("#bar button", "Act")
    until("$('message').textContent.includes('unknown action')")
    press("#moves button", "MoveBack")
    until(f"{log}.includes('MoveBack()')")
    browser.eval("$('filter').value = 'fridge'; $('filter').oninput()")
    assert browser.eval("[...$('objects').children].map((b) => b.textContent)") == ["Fridge_1"]
    browser.eval("$('room').value = 'bathroom_1'; $('room').onchange()")
    press("#begin", "Start")
    until("status.room === 'bathroom_1' && status.history.length === 0")
    assert browser.eval("$('head').src").endswith(str(game.status["version"]))
    assert browser.eval("document.querySelector('iframe').src") == game.status["view"]
    server.should_exit = True
    thread.join(10.0)
