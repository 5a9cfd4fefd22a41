"""Evaluates a planner, or assembles one of the paper's tables: `python eval.py planner=proprio robot=h1`.

`python eval.py sanity=true` says in half a minute whether this machine does what it should.
"""

from __future__ import annotations

import contextlib
import dataclasses
import logging
import os
import sys
from collections.abc import Sequence
from pathlib import Path

os.environ.setdefault("MUJOCO_GL", "egl")
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("HF_HUB_OFFLINE", "1")

from rich.console import Console
from tqdm.contrib.logging import logging_redirect_tqdm

from configs.app import run_app
from configs.schema.eval import EvalConfig

__all__ = ["main"]


def run(cfg: EvalConfig) -> int:
    """Runs one configuration.

    Returns:
        0; 1 when episodes stay without a score, weights, a package or a backend are absent, a file cannot be written, or a
        table cannot be assembled; 2 on a value or a ledger that is not allowed.
    """
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    for name in ("httpx2", "OpenGL"):  # a line per call would drown the progress bar; that acceleration is absent is no news
        logging.getLogger(name).setLevel(logging.WARNING)
    console = Console(stderr=True, highlight=False)
    from proprio_mllm.backends.protocol import BackendError
    from proprio_mllm.evaluation.run import evaluate  # loads the simulator; a typo stops before that
    from proprio_mllm.planners.chat.embedding import EmbeddingError
    from proprio_mllm.planners.protocol import WeightsError
    from proprio_mllm.report.experiments import assemble
    from proprio_mllm.report.runs import write_report
    from proprio_mllm.report.stored import load_run

    if cfg.sanity:
        from proprio_mllm.evaluation.sanity import sanity

        good = True
        try:
            for verdict in sanity():
                console.print(verdict.to_text(), markup=False, soft_wrap=True)
                good = good and verdict.good
        except (WeightsError, OSError) as error:
            console.print(f"eval.py: {error}", style="red", markup=False, soft_wrap=True)
            return 1
        return 0 if good else 1
    if cfg.experiment is not None:
        try:
            table, files = assemble(cfg.experiment, Path(cfg.output))
        except (ValueError, OSError) as error:
            console.print(f"eval.py: {error}", style="red", markup=False, soft_wrap=True)
            return 1
        console.print("\n".join(f"written: {path}" for path in files), markup=False, soft_wrap=True)
        if table is not None:
            table.show()
        return 0
    try:
        with logging_redirect_tqdm(), contextlib.ExitStack() as closing:  # warnings above the progress bar, not across it
            opener = None
            if cfg.watch:
                from proprio_mllm.evaluation.watching import Watching

                cfg = dataclasses.replace(cfg, workers=0, batch=1, threads=1, scheduler="local", ray_address=None)
                opener = closing.enter_context(contextlib.closing(Watching()))
            done = evaluate(cfg, opener)
        folder = done.folder
        run = load_run(folder)
        table = write_report(run)
    except (WeightsError, BackendError, EmbeddingError, OSError, ValueError) as error:
        console.print(f"eval.py: {error}", style="red", markup=False, soft_wrap=True)
        return 2 if isinstance(error, ValueError) else 1
    if done.stopped:
        console.print(f"eval.py: the run has stopped: {done.stopped}", style="red", markup=False, soft_wrap=True)
    console.print(f"ledger, summary.json and tables: {folder}", markup=False, soft_wrap=True)
    if run.records or not done.stopped:
        table.show()
    return 0 if run.complete else 1


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line of Hydra; returns the exit code, see `run`, or 2 on a wrong key or value."""
    return run_app("eval", EvalConfig, run, __doc__ or "", arguments)


if __name__ == "__main__":
    sys.exit(main())
