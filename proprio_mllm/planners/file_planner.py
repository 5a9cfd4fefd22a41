"""A user's own planner: a class in a Python file, named `FILE.py:CLASS`.

The class is a `Planner`: `privileged = False`, `image_size`, `reset`, `step`. It is made without arguments or, in a run with a
backend, as the planners of `chat` are: with that backend, whose replies are cached, priced and counted, and with `ChatOptions`.
It sees what every planner sees, observations and feedback. The file runs with the rights of the user, as any script.
Paper: none (engineering).
"""

from __future__ import annotations

from data.code_files import CodeFileError, load_named
from proprio_mllm.planners.protocol import Planner


def load_planner(source: str, *given: object) -> Planner:
    """A new planner of a file's class. The file's folder can be imported from, as when Python runs a script.

    Args:
        source: `FILE.py:CLASS`.
        given: what the class is made with.

    Raises:
        CodeFileError: when the file cannot be run, or has no such class, or the class is no planner.
    """
    path, _, name = source.rpartition(":")
    found = load_named(source, "planner.source", "class")
    try:
        planner = found(*given)
    except Exception as error:
        call, hint = f"{name}({'backend, options' if given else ''})", ""
        if not given and isinstance(error, TypeError):
            hint = "; a class that takes (backend, options) needs backend=NAME"
        raise CodeFileError(f"{path}: {call} failed: {type(error).__name__}: {error}{hint}") from error
    wanted = {"privileged": bool, "image_size": int}
    missing = [f"{key} ({kind.__name__})" for key, kind in wanted.items() if not isinstance(getattr(planner, key, None), kind)]
    missing += [f"{key}()" for key in ("reset", "step") if not callable(getattr(planner, key, None))]
    if missing or not isinstance(planner, Planner):
        raise CodeFileError(f"{path}: {name} is no planner; it lacks {', '.join(missing)}")
    if planner.privileged:
        raise CodeFileError(f"{path}: {name}.privileged must be False: a planner from a file sees observations only")
    return planner
