"""Worlds of a server: one process per world, asked through a pipe, closed when idle.

A process of its own isolates a world's physics, OpenGL context and crashes from all others. A world answers one request at a
time; requests to different worlds run at once.
"""

from __future__ import annotations

import logging
import multiprocessing
import secrets
import threading
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from typing import Any

from data.workers import start_worker

_LOG = logging.getLogger(__name__)

#: Arguments of `Controller` that a client may give.
CONTROLLER_ARGUMENTS = (
    "robot_type", "scene", "width", "height", "difficulty", "contingency", "seed", "third_party_cameras", "privileged",
)  # fmt: skip


class WorldRefusedError(ValueError):
    """What the Controller refused with ValueError."""


class WorldOverError(RuntimeError):
    """A call that came after the end of the episode; the world waits for a reset."""


class WorldBrokeError(RuntimeError):
    """An error of the simulator that is nobody's wrong argument; the world goes on."""


class WorldGoneError(LookupError):
    """There is no such world: never opened, closed, expired, or its process died."""


#: What a world's process answers in place of an event.
_ERRORS = {"refused": WorldRefusedError, "over": WorldOverError, "broke": WorldBrokeError}


def _serve_world(pipe: Connection, arguments: Mapping[str, Any], images: tuple[str, ...]) -> None:
    """Runs in the world's process until the pipe closes."""
    start_worker()
    from sim.interfaces.controller import Controller
    from sim.interfaces.remote.protocol import encode_event

    try:
        controller = Controller(**arguments)
    except (ValueError, TypeError) as error:
        pipe.send(("refused", str(error)))
        return
    pipe.send(("event", encode_event(controller.last_event, images)))
    while True:
        try:
            call, images = pipe.recv()
        except EOFError:
            return
        try:
            pipe.send(("event", encode_event(controller.step(call), images)))
        except ValueError as error:
            pipe.send(("refused", str(error)))
        except RuntimeError as error:
            pipe.send(("over", str(error)))
        except Exception as error:  # noqa: BLE001  # a world survives any call
            _LOG.exception("a call broke")
            pipe.send(("broke", f"{type(error).__name__}: {error}"))


@dataclass
class _World:
    process: BaseProcess
    pipe: Connection
    lock: threading.Lock = field(default_factory=threading.Lock)
    used_s: float = field(default_factory=time.monotonic)


class Worlds:
    """All worlds of a server.

    Args:
        limit: the most worlds at once.
        idle_s: seconds without a request after which a world is closed.
        step_s: seconds after which a world that does not answer is ended.
    """

    def __init__(self, limit: int, idle_s: float, step_s: float = 300.0) -> None:
        self.limit, self._idle_s, self._step_s = limit, idle_s, step_s
        self._worlds: dict[str, _World] = {}
        self._lock = threading.Lock()
        self._opening = 0
        self._stop = threading.Event()
        self._reaper = threading.Thread(target=self._reap, name="idle worlds", daemon=True)
        self._reaper.start()

    def __len__(self) -> int:
        return len(self._worlds)

    def open(self, arguments: Mapping[str, Any], images: tuple[str, ...]) -> tuple[str, dict[str, Any]]:
        """Starts a world; returns its secret id and the first event.

        Raises:
            WorldRefusedError: when the Controller refuses the arguments.
            OverflowError: when there are as many worlds as are allowed.
        """
        with self._lock:
            if len(self._worlds) + self._opening >= self.limit:
                raise OverflowError(f"all {self.limit} worlds are in use")
            self._opening += 1
        world: _World | None = None
        try:
            context = multiprocessing.get_context("spawn")
            here, there = context.Pipe()
            process = context.Process(target=_serve_world, args=(there, dict(arguments), images), daemon=True)
            process.start()
            there.close()
            world = _World(process, here)
            event = self._answer(world)
        except BaseException:
            if world is not None:
                _end(world)
            raise
        finally:
            with self._lock:
                self._opening -= 1
        name = secrets.token_urlsafe(12)
        world.used_s = time.monotonic()  # opening takes seconds, which are not idle ones
        with self._lock:
            self._worlds[name] = world
        _LOG.info("world opened: %s", {key: arguments[key] for key in sorted(arguments)})
        return name, event

    def step(self, name: str, call: Mapping[str, Any], images: tuple[str, ...]) -> dict[str, Any]:
        """One call of a world's Controller.

        Raises:
            WorldGoneError: when there is no such world, or it died meanwhile.
            WorldRefusedError: when the Controller refuses the call.
            WorldOverError: when the episode is over.
            WorldBrokeError: on any other error of the Controller.
        """
        world = self._worlds.get(name)
        if world is None:
            raise WorldGoneError("no such world; it may have been idle for too long")
        with world.lock:
            world.used_s = time.monotonic()
            try:
                world.pipe.send((dict(call), images))
                return self._answer(world)
            except (EOFError, OSError):
                self.close(name)
                raise WorldGoneError("the world's process has died") from None
            finally:
                world.used_s = time.monotonic()

    def close(self, name: str) -> None:
        """Ends a world.

        Raises:
            WorldGoneError: when there is no such world.
        """
        with self._lock:
            world = self._worlds.pop(name, None)
        if world is None:
            raise WorldGoneError("no such world")
        _end(world)

    def stop(self) -> None:
        """Ends all worlds; returns when those that were just found idle have ended too."""
        self._stop.set()
        for name in list(self._worlds):
            try:
                self.close(name)
            except WorldGoneError:
                continue
        self._reaper.join()

    def _answer(self, world: _World) -> dict[str, Any]:
        if not world.pipe.poll(self._step_s):
            world.process.kill()
            raise EOFError
        kind, value = world.pipe.recv()
        if kind in _ERRORS:
            raise _ERRORS[kind](value)
        return value

    def _reap(self) -> None:
        while not self._stop.wait(min(self._idle_s / 4.0, 10.0)):
            now = time.monotonic()
            for name, world in list(self._worlds.items()):
                if now - world.used_s < self._idle_s or not world.lock.acquire(blocking=False):
                    continue
                try:
                    self.close(name)
                    _LOG.info("a world was idle for %.0f s and is closed", now - world.used_s)
                except WorldGoneError:
                    continue
                finally:
                    world.lock.release()


def _end(world: _World) -> None:
    world.pipe.close()
    world.process.join(5.0)
    if world.process.is_alive():
        world.process.kill()
        world.process.join()
