"""MuJoCo's web viewer in a process of its own, reachable from this machine alone.

A process because the viewer keeps its state in globals: a second one in the same process, even after the first, crashes. What
is pushed or reset in the browser stays here; nothing is sent back. Source: `mujoco.studio`, MuJoCo 4.
"""

from __future__ import annotations

import contextlib
import io
import logging
import signal
import socket
import threading
import time
from multiprocessing.connection import Connection
from typing import Any, Final

import mujoco
from mujoco.studio import launch_thread, messages, viewer_protocol, web_viewer

HOST: Final = "127.0.0.1"
#: What of MuJoCo's data is sent.
STATE: Final = int(mujoco.mjtState.mjSTATE_INTEGRATION)
#: Where the camera starts: distance in sizes of the room, degrees.
_DISTANCE, _AZIMUTH, _ELEVATION = 2.3, 125.0, -42.0


class _Viewer(web_viewer.WebViewer):
    """The viewer on the loopback interface, without its banner."""

    @property
    def _host(self) -> str:
        return HOST

    @_host.setter
    def _host(self, value: str) -> None:
        """The base class binds to every interface."""

    @property
    def port(self) -> int:
        """Where it listens."""
        return int(self._http_port)


def serve(pipe: Connection, model: mujoco.MjModel, port: int) -> None:
    """Serves until the other end of the pipe is closed.

    Args:
        pipe: first sends the port; then takes models and states.
        model: what is shown first.
        port: TCP port, 0 for a free one.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the process that started this one
    endpoint, sender = launch_thread.make_thread_endpoints()
    with contextlib.redirect_stdout(io.StringIO()):
        viewer = _Viewer(viewer_protocol.ViewerConfig(gfx="web", http_port=port), endpoint, model=model)
        logging.getLogger("WebServer").setLevel(logging.WARNING)  # it tells of every browser
        viewer.camera.lookat[:] = model.stat.center
        viewer.camera.distance = _DISTANCE * model.stat.extent
        viewer.camera.azimuth, viewer.camera.elevation = _AZIMUTH, _ELEVATION
        while True:  # its server listens a moment after it has started
            with contextlib.suppress(ConnectionRefusedError), socket.create_connection((HOST, viewer.port)):
                break
            time.sleep(0.02)
        pipe.send(viewer.port)

        def pass_on() -> None:
            with contextlib.suppress(EOFError, OSError):
                while True:
                    told: Any = pipe.recv()
                    is_model = isinstance(told, mujoco.MjModel)
                    sender.send_to_viewer(messages.ModelEvent(told) if is_model else messages.StateSnapshot(told, STATE))
                    sender.get_viewer_events()  # of its buttons; nobody wants them
                    sender.get_viewer_snapshots()
            sender.send_to_viewer(messages.ExitEvent())

        threading.Thread(target=pass_on, daemon=True).start()
        viewer_protocol.run_viewer_loop(viewer)
