"""DualTHOR re-founded on MuJoCo: rooms, skills, tasks, and the privileged expert."""

import robots as _robots  # noqa: F401  # chooses the OpenGL backend
