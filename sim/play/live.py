"""A live 3-D view of sessions in the browser, which draws: it gets the model once and the state after every control tick."""

from __future__ import annotations

import copy
import multiprocessing
import time
from typing import Final

import mujoco
import numpy as np
from numpy.typing import NDArray

from sim.play.viewer import HOST, STATE, serve
from sim.session.session import Session
from sim.skills.runner import CONTROL_DT_S
from sim.world.rendering import greys, surfaces
from sim.world.world import World

_START_S: Final = 60.0
#: What of a model changes while a world runs: lamps, liquids, dirt, halves.
_LOOKS: Final = ("geom_rgba", "geom_size", "geom_pos", "mat_emission")


class LiveView:
    """Shows a session's world; skills are slowed down to a pace that one can follow.

    Args:
        session: a session with a running episode.
        port: TCP port on the loopback interface, 0 for a free one.
        speed: simulated seconds per second while skills run.

    Attributes:
        url: of the page.

    Raises:
        RuntimeError: when the viewer does not start, as where the port is taken.
    """

    def __init__(self, session: Session, port: int = 0, speed: float = 1.0) -> None:
        self._session, self._speed, self._due = session, speed, 0.0
        spawn = multiprocessing.get_context("spawn")
        self._pipe, other = spawn.Pipe()
        self._process = spawn.Process(target=serve, args=(other, self._adopted(session.world), port), daemon=True)
        self._process.start()
        other.close()
        try:
            found = self._pipe.recv() if self._pipe.poll(_START_S) else 0
        except EOFError:
            found = 0
        if not found:
            self._process.kill()
            raise RuntimeError(f"the viewer did not start on port {port}; is it taken?")
        self.url = f"http://{HOST}:{found}/"
        session.watchers.append(self._tick)
        self._send_state()

    def follow(self, session: Session) -> None:
        """Shows another session from now on."""
        self._session.watchers.remove(self._tick)
        self._session = session
        session.watchers.append(self._tick)
        self.show()

    def show(self) -> None:
        """Shows the world as it is now, after a reset another one."""
        world = self._session.world
        looks = self._looks(world.model)
        if world is not self._world or any(not np.array_equal(a, b) for a, b in zip(looks, self._shown, strict=True)):
            self._pipe.send(self._adopted(world))
        self._send_state()

    def close(self) -> None:
        """Stops watching and serving."""
        self._session.watchers.remove(self._tick)
        self._pipe.close()
        self._process.join(5.0)
        self._process.kill()

    def _adopted(self, world: World) -> mujoco.MjModel:
        """The model of the world that is shown from now on, in colours for people."""
        self._world, self._shown = world, self._looks(world.model)
        self._state = np.empty(mujoco.mj_stateSize(world.model, STATE))
        model = copy.copy(world.model)
        for geom, material in surfaces(model).items():
            model.geom_matid[geom] = material
        for geom, grey in greys(world.scene).items():
            model.geom_matid[geom] = -1
            model.geom_rgba[geom] = (grey, grey, grey, 1.0)
        return model

    @staticmethod
    def _looks(model: mujoco.MjModel) -> list[NDArray[np.float64]]:
        return [np.array(getattr(model, name)) for name in _LOOKS]

    def _send_state(self) -> None:
        mujoco.mj_getState(self._world.model, self._world.data, self._state, STATE)
        self._pipe.send(self._state)

    def _tick(self, world: World, text: str) -> None:
        del text
        if world is self._world:
            self._send_state()
        else:
            self.show()
        now = time.monotonic()
        self._due = max(self._due, now - 1.0) + CONTROL_DT_S / self._speed
        time.sleep(max(0.0, self._due - now))
