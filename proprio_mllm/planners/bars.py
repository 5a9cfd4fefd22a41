"""Loads models without the bars that transformers draws: small ones load in no time, and those of several processes would run
across the run's own. Paper: none (engineering).
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator


@contextlib.contextmanager
def without_bar() -> Iterator[None]:
    """Keeps transformers from drawing bars in the block."""
    from transformers.utils import logging

    shown = logging.is_progress_bar_enabled()
    logging.disable_progress_bar()
    try:
        yield
    finally:
        if shown:
            logging.enable_progress_bar()
