"""Processes that hold the model, one for every GPU or one in all, for all worker processes of this machine.

Workers connect through a Unix socket with a random key, each to the process that has fewest callers; each connection is a
caller of that process's `ModelDesk`, which answers up to `batch` of them at once. When a process dies, the calls under way
become infrastructure errors, it is started anew, and its workers connect again at their next episode.

Paper: none (engineering).
"""

from __future__ import annotations

import contextlib
import logging
import os
import shutil
import signal
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from multiprocessing import get_context
from multiprocessing.connection import Client, Connection, Listener
from pathlib import Path
from typing import Any, Final

import numpy as np

from configs.schema.planner import PlannerConfig
from data.workers import start_worker
from interface.observation import Observation
from proprio_mllm.evaluation.asking import AskingPlanner, ModelDesk, batch_planner
from proprio_mllm.planners.protocol import Planner, PlannerReply, TaskInfo

logger = logging.getLogger(__name__)

#: A model has to be read and its process started within this time.
_STARTS_WITHIN_S: Final = 600.0
_ENDS_WITHIN_S: Final = 10.0
_POLL_S: Final = 0.05


class _Connected:
    """A connection that is made when it is needed, and again after it broke."""

    def __init__(self, server: SocketServer) -> None:
        self._server = server
        self._connection: Connection[Any, Any] | None = None

    def ask(self, method: str, *arguments: Any) -> Any:
        """Calls a method of the desk.

        Raises:
            RuntimeError: with the error's text, when the call failed there.
            EOFError: when the process went away meanwhile.
        """
        if self._connection is None:
            self._connection = _connected(self._server)
        try:
            self._connection.send((method, arguments))
            fine, value = self._connection.recv()
        except (OSError, EOFError):
            self._connection.close()
            self._connection = None
            raise
        if not fine:
            raise RuntimeError(f"the model's process could not answer: {value}")
        return value

    def close(self) -> None:
        """Goes away."""
        if self._connection is not None:
            self._connection.close()
            self._connection = None


@dataclass(frozen=True, slots=True)
class SocketServer:
    """Where the model's process listens; can be sent to workers.

    Attributes:
        path: of the socket.
        key: what a caller has to know.
    """

    path: str
    key: bytes


@dataclass(frozen=True, slots=True)
class SocketServers:
    """Several of them."""

    servers: tuple[SocketServer, ...]

    def connect(self) -> Planner:
        """A planner that asks the process with fewest callers; waits until all listen."""
        connected = [_Connected(server) for server in self.servers]
        taken = connected.pop(int(np.argmin([one.ask("callers") for one in connected])))
        for other in connected:
            other.close()
        return AskingPlanner(taken.ask("image_size"), taken.ask)


def _connected(server: SocketServer) -> Connection[Any, Any]:
    deadline = time.monotonic() + _STARTS_WITHIN_S
    while True:
        try:
            return Client(server.path, "AF_UNIX", server.key)
        except (FileNotFoundError, ConnectionRefusedError):
            if time.monotonic() > deadline:
                raise
            time.sleep(_POLL_S)


def _serve(planner: PlannerConfig, batch: int, server: SocketServer, gpu: str | None) -> None:
    start_worker()
    if gpu is not None:
        os.environ["CUDA_VISIBLE_DEVICES"] = gpu  # before anything of CUDA starts here
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))  # ends tidily, so that nothing of it is left to clean up
    desk = ModelDesk(batch_planner(planner), batch)
    with contextlib.suppress(FileNotFoundError):
        os.unlink(server.path)  # of a process that died
    with Listener(server.path, "AF_UNIX", backlog=4096, authkey=server.key) as listener:
        number, callers = 0, set[str]()
        while True:
            with contextlib.suppress(OSError, EOFError):  # a caller that went away while it connected
                connection = listener.accept()
                number += 1
                threading.Thread(target=_answer, args=(desk, connection, str(number), callers), daemon=True).start()


def _answer(desk: ModelDesk, connection: Connection[Any, Any], caller: str, callers: set[str]) -> None:
    """Answers one caller until it goes away; those who only ask how many callers there are count as none."""

    def begin(task: TaskInfo, rng: np.random.Generator) -> None:
        desk.begin(caller, task, rng)

    def step(observation: Observation) -> PlannerReply:
        return desk.step(caller, observation)

    def image_size() -> int:
        callers.add(caller)
        return desk.image_size

    methods = {"begin": begin, "step": step, "image_size": image_size, "callers": lambda: len(callers)}
    with connection, contextlib.suppress(OSError, EOFError):
        try:
            while True:
                method, arguments = connection.recv()
                try:
                    answer = True, methods[method](*arguments)
                except Exception as error:  # noqa: BLE001  # sent to the episode that it belongs to, which records it
                    answer = False, f"{type(error).__name__}: {error}"
                connection.send(answer)
        finally:
            callers.discard(caller)


class ModelProcess:
    """Starts the model's process, and starts it again when it has died.

    Args:
        planner: who answers.
        batch: most calls answered together.
        folder: for the socket.
        gpu: the only one it sees, as `CUDA_VISIBLE_DEVICES` names it; None leaves that as it is.
    """

    def __init__(self, planner: PlannerConfig, batch: int, folder: Path, gpu: str | None = None) -> None:
        self.server = SocketServer(str(folder / f"model_{gpu}"), os.urandom(32))
        self._arguments = (planner, batch, self.server, gpu)
        self._context = get_context("spawn")
        self.process = self._started()

    def _started(self) -> Any:
        process = self._context.Process(target=_serve, args=self._arguments, daemon=True)
        process.start()
        return process

    def ensure(self) -> None:
        """Starts a new process when the last one is gone."""
        if not self.process.is_alive():
            logger.warning("the model's process died (exit code %s); starting a new one", self.process.exitcode)
            self.process = self._started()

    def stop(self) -> None:
        """Ends the process."""
        self.process.terminate()
        self.process.join(_ENDS_WITHIN_S)
        self.process.kill()
        self.process.join()


class ModelProcesses:
    """One for every GPU, or one in all.

    Args:
        planner: who answers.
        batch: most calls answered together by each.
        folder: for the sockets.
        gpus: names of the GPUs; none starts one process, where it likes.
    """

    def __init__(self, planner: PlannerConfig, batch: int, folder: Path, gpus: Sequence[str]) -> None:
        self.processes = tuple(ModelProcess(planner, batch, folder, gpu) for gpu in gpus or (None,))
        self.server = SocketServers(tuple(one.server for one in self.processes))

    def ensure(self) -> None:
        """Starts those anew that are gone."""
        for one in self.processes:
            one.ensure()


def visible_gpus() -> tuple[str, ...]:
    """GPUs of this machine that this process may use, as `CUDA_VISIBLE_DEVICES` names them."""
    import torch

    listed = os.environ.get("CUDA_VISIBLE_DEVICES", "")
    count = torch.cuda.device_count()
    return tuple(listed.split(",")[:count]) if listed else tuple(map(str, range(count)))


@contextlib.contextmanager
def model_processes(planner: PlannerConfig, batch: int, gpus: Sequence[str] | None = None) -> Iterator[ModelProcesses]:
    """The model's processes for the time of the block; `gpus` are those that are visible unless told."""
    folder = Path(tempfile.mkdtemp(prefix="proprio-"))
    try:
        model = ModelProcesses(planner, batch, folder, visible_gpus() if gpus is None else gpus)
        try:
            yield model
        finally:
            for one in model.processes:
                one.stop()
    finally:
        shutil.rmtree(folder, ignore_errors=True)
