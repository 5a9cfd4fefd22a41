"""A room to play in: `python -m sim play [robot=h1 room=kitchen_1 task=ID]` opens it in the browser.

The page has MuJoCo's viewer, what the robot's head sees, what each hand holds, and buttons for every action that the thing you
choose allows. A benchmark task can be loaded; its goals light up when they hold. Only this machine can reach it.
"""

from __future__ import annotations

import contextlib
import logging
import socket
import sys
import threading
import webbrowser
from collections.abc import Callable, Sequence
from importlib.resources import files
from typing import Any, Final

import uvicorn
from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.middleware import Middleware
from starlette.middleware.trustedhost import TrustedHostMiddleware
from starlette.requests import Request
from starlette.responses import HTMLResponse, JSONResponse, Response
from starlette.routing import Route

from configs.arguments import command, read_arguments
from sim.play.game import BusyError, Game, PlayConfig
from sim.play.viewer import HOST

_MAX_BODY: Final = 4096
_FIELDS: Final = {"robot": str, "room": str, "task": (str, type(None)), "difficulty": str, "seed": int}


def application(game: Game) -> Starlette:
    """The page and what it asks for.

    `GET /`, `/choices`, `/status`, `/head.png`; `POST /step` with a text, `/undo`, `/redo`, `/begin` with what to start. Bodies
    are JSON, so that no page of another origin can send them; answers are 400 on a wrong value and 409 while the robot acts.
    """
    page = files("sim.play").joinpath("page.html").read_text(encoding="utf-8")

    def told(work: Callable[[Any], None]) -> Callable[[Request], Any]:
        async def answer(request: Request) -> Response:
            if request.headers.get("content-type", "").split(";")[0] != "application/json":
                return JSONResponse({"error": "content-type must be application/json"}, 415)
            length = request.headers.get("content-length", "")
            if not length.isdigit() or int(length) > _MAX_BODY:
                return JSONResponse({"error": f"a body has at most {_MAX_BODY} bytes, and says how many"}, 413)
            try:
                await run_in_threadpool(work, await request.json())
            except BusyError as error:
                return JSONResponse({"error": str(error)}, 409)
            except ValueError as error:
                return JSONResponse({"error": str(error)}, 400)
            return JSONResponse(game.status)

        return answer

    def got(make: Callable[[], Response]) -> Callable[[Request], Any]:
        async def answer(request: Request) -> Response:
            del request
            return make()

        return answer

    def begin(body: Any) -> None:
        game.begin(**{name: _checked(body, name, kind) for name, kind in _FIELDS.items()})

    routes = [
        Route("/", got(lambda: HTMLResponse(page))),
        Route("/choices", got(lambda: JSONResponse(game.choices))),
        Route("/status", got(lambda: JSONResponse(game.status))),
        Route("/head.png", got(lambda: Response(game.head, media_type="image/png"))),
        Route("/step", told(lambda body: game.act(_checked(body, "text", str))), methods=["POST"]),
        Route("/undo", told(lambda _: game.undo()), methods=["POST"]),
        Route("/redo", told(lambda _: game.redo()), methods=["POST"]),
        Route("/begin", told(begin), methods=["POST"]),
    ]
    return Starlette(routes=routes, middleware=[Middleware(TrustedHostMiddleware, allowed_hosts=[HOST, "localhost"])])


def _checked(body: Any, name: str, kind: Any) -> Any:
    value = body.get(name) if isinstance(body, dict) else None
    if not isinstance(value, kind) or isinstance(value, bool):
        raise ValueError(f"{name} {value!r} is not what is expected here: {kind}")
    return value


@command(ValueError, OSError)
def main(arguments: Sequence[str]) -> int:
    """Command line; serves until interrupted and returns the exit code."""
    config = read_arguments(PlayConfig, arguments)
    logging.basicConfig(level=logging.WARNING, format="%(message)s")
    with socket.create_server((HOST, config.port)) as listening:
        game = Game(config)
        url = f"http://{HOST}:{listening.getsockname()[1]}/"
        sys.stdout.write(f"{url}  (stop with Ctrl-C)\n")
        sys.stdout.flush()
        if config.browser:
            threading.Thread(target=webbrowser.open, args=(url,), daemon=True).start()
        settings = uvicorn.Config(application(game), log_level="error", lifespan="off", timeout_graceful_shutdown=1)
        try:
            with contextlib.suppress(KeyboardInterrupt):
                uvicorn.Server(settings).run([listening])
        finally:
            game.close()
    return 0
