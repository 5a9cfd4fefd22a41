"""DualTHOR re-founded on MuJoCo: robots, rooms, skills, tasks, and the privileged expert."""

from sim.gl import select_backend as _select_backend

_select_backend()
