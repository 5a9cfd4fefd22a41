"""An entry point as a Hydra application: `--help`, `--cfg job`, `--config-dir`, `--multirun`, launchers, tab completion.

Hydra composes; a frozen dataclass validates; the job is a plain function of that dataclass that returns an exit code. What
does not compose or validate ends within two seconds with exit code 2 and one line that names the value, lists what is allowed
and suggests the nearest. Nothing of Hydra's is written but `multirun.yaml` of a sweep (below `outputs/multirun`), and logging
and the working directory stay as they are.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Final, TypeVar

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf

from configs.arguments import announce, needed_extra
from configs.compose import COMPOSITION_ERRORS, CONFIG_DIR, explain, open_fields, register
from configs.help import asks_for_help, help_text
from configs.validate import ConfigError, build

T = TypeVar("T")

_FLAGS: Final = """
Hydra's flags: --cfg job prints the configuration, -m (--multirun) runs every combination of comma-separated values,
--config-dir DIR adds a folder of groups, -sc install=bash prints the tab completion; --hydra-help lists all.
"""


class JobFailed(Exception):  # noqa: N818  # Hydra's sweepers want an exception for a job that did not succeed
    """A job of a sweep that ended with an exit code other than 0.

    Attributes:
        code: the exit code.
    """

    def __init__(self, code: int, overrides: Sequence[str]) -> None:
        super().__init__(code, overrides)
        self.code = code

    def __str__(self) -> str:
        return f"exit code {self.args[0]} of the job {' '.join(self.args[1]) or 'without overrides'}"


def run_app(root: str, schema: type[T], job: Callable[[T], int], about: str, arguments: Sequence[str] | None = None) -> int:
    """Runs a command line.

    Args:
        root: name of the root file in `configs/`, which is also the name of the script.
        schema: the frozen dataclass that the composed configuration has to fit.
        job: what is done with it; called once per job of a sweep.
        about: the command's description, for `--help`.
        arguments: of the command line; those of the process by default.

    Returns:
        The job's exit code, of a sweep that of a failed job; 2 for what does not compose or validate.
    """
    given = list(sys.argv[1:] if arguments is None else arguments)
    if not any(word.startswith("-") for word in given):  # flags print at once
        announce(f"{root}.py", given)
    before = sys.argv, os.environ.get("HYDRA_FULL_ERROR")
    os.environ["HYDRA_FULL_ERROR"] = "1"  # Hydra then raises its errors, and they are explained here

    def task(config: DictConfig) -> int:
        return _run_job(root, schema, job, config)

    try:
        sys.argv = [f"{root}.py", *open_fields(given)]
        register(help_text(root, schema, about) + _FLAGS if asks_for_help(given) else "")
        hydra.main(version_base=None, config_path=str(CONFIG_DIR), config_name=root)(task)()
    except SystemExit as end:
        return end.code if isinstance(end.code, int) else int(end.code is not None)
    except JobFailed as failed:
        sys.stderr.write(f"{root}.py: {failed}\n")
        return failed.code
    except ConfigError as error:
        sys.stderr.write(f"{root}.py: {error}\n")
        return 2
    except COMPOSITION_ERRORS as error:
        overrides = [one for one in given if "=" in one and not one.startswith("--")] or given
        sys.stderr.write(f"{root}.py: {explain(error, root, overrides, _own_folder(given))}\n")
        return 2
    finally:
        sys.argv = before[0]
        if before[1] is None:
            os.environ.pop("HYDRA_FULL_ERROR", None)
        else:
            os.environ["HYDRA_FULL_ERROR"] = before[1]
    return 0


def _own_folder(given: Sequence[str]) -> Path | None:
    """The folder of `--config-dir`."""
    for number, word in enumerate(given):
        if word in ("--config-dir", "-cd"):
            return Path(given[number + 1]) if number + 1 < len(given) else None
        if word.startswith("--config-dir="):
            return Path(word.partition("=")[2])
    return None


def _run_job(root: str, schema: type[T], job: Callable[[T], int], config: DictConfig) -> int:
    """One job: validates its configuration and runs it; ends the program where it is the only one."""
    run = HydraConfig.get()
    sys.argv = [f"{root}.py", *(one.removeprefix("++") for one in run.overrides.task)]  # what the job stores as its command
    values: Any = OmegaConf.to_container(config, resolve=True, throw_on_missing=True)
    alone = run.mode is RunMode.RUN
    try:
        code = job(build(schema, values))
    except ConfigError as error:
        sys.stderr.write(f"{root}.py: {error}\n")
        code = 2
    except ModuleNotFoundError as error:
        sys.stderr.write(f"{root}.py: {needed_extra(error)}\n")
        code = 1
    if alone:
        raise SystemExit(code)
    if code:
        raise JobFailed(code, sys.argv[1:])
    return code
