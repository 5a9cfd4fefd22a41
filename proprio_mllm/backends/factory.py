"""Makes a backend from its configuration.

A call passes the cache, the slots, the bookings, the model, in this order: a recorded reply takes no slot and no money, and
money is booked for calls that are made, not for those that wait. Paper: none (engineering).
"""

from __future__ import annotations

import contextlib
import logging
from pathlib import Path
from typing import Final

from configs.schema.backend import BackendConfig
from proprio_mllm.backends.cache import CachedBackend, ReplayBackend, recorded_revision
from proprio_mllm.backends.identity import identity_of
from proprio_mllm.backends.prices import price_of
from proprio_mllm.backends.protocol import Backend
from proprio_mllm.backends.scripted import ScriptedChat
from proprio_mllm.backends.slots import SlottedBackend
from proprio_mllm.backends.spending import Spending, SpendingBackend

#: In a run's folder.
SPENDING_FILE: Final = "spending.sqlite"

logger = logging.getLogger(__name__)


def make_backend(cfg: BackendConfig, run: Path | None, cap_usd: float | None = None) -> Backend:
    """A backend; whoever asks for it closes it.

    Args:
        cfg: which one.
        run: folder of the run whose threads and processes share slots and bookings; None shares with nobody and books nothing.
        cap_usd: most that the run may spend, over all of its backends.

    Raises:
        BackendSetupError: when it cannot be made: no key, no file, no weights.
        ValueError: when the cap cannot be held, or the price is not in the table.
    """
    if cfg.kind == "replay":
        assert cfg.cache is not None
        return ReplayBackend(identity_of(cfg), Path(cfg.cache))
    if cap_usd is not None and run is None:
        raise ValueError(f"cost_cap_usd {cap_usd} cannot be held without a run's folder")
    check_cap(cfg, cap_usd)
    price = None if cfg.price is None else price_of(cfg.price)
    if price is not None and cfg.model not in price.models:
        logger.warning("backend %s: model %s is priced as %s", cfg.name, cfg.model or "of no name", cfg.price)
    with contextlib.ExitStack() as made:
        backend = _model(cfg)
        made.callback(lambda: backend.close())  # whatever it is wrapped in by then
        if price is not None:
            spending = None if run is None else Spending(run / SPENDING_FILE, cap_usd)
            backend = SpendingBackend(backend, price, spending, cfg.name)
        backend = SlottedBackend(backend, cfg.concurrency, None if run is None else run / "slots" / cfg.name)
        if cfg.cache is not None:
            backend = CachedBackend(backend, Path(cfg.cache))
        made.pop_all()
        return backend


def told_revision(cfg: BackendConfig) -> str:
    """The revision that a server of this machine tells of its model; "" for what is not asked, or tells none.

    Of a server that is not there it is the revision whose replies were recorded last, so that a run can be repeated without it.

    Raises:
        BackendSetupError: when the backend cannot be made.
    """
    if cfg.kind != "openai" or not cfg.on_this_machine:
        return ""
    from proprio_mllm.backends.openai_chat import OpenAIChat

    with contextlib.closing(OpenAIChat(cfg)) as chat:
        told = chat.revision()
    if told is None:
        told = "" if cfg.cache is None else recorded_revision(cfg, Path(cfg.cache))
        recorded = f"; its recorded replies are of {told}" if told else ""
        logger.warning("backend %s: %s does not answer%s", cfg.name, cfg.base_url, recorded)
    return told


def check_cap(cfg: BackendConfig, cap_usd: float | None) -> None:
    """Whether a cap can be held.

    Raises:
        ValueError: when the price of what may cost money is not known.
    """
    if cap_usd is not None and cfg.price is None and cfg.kind == "openai" and not cfg.on_this_machine:
        raise ValueError(f"cost_cap_usd {cap_usd} cannot be held: backend.price of {cfg.name} is null")


def _model(cfg: BackendConfig) -> Backend:
    if cfg.kind == "openai":
        from proprio_mllm.backends.openai_chat import OpenAIChat  # the client takes half a second to import

        return OpenAIChat(cfg)
    if cfg.kind == "local":
        from proprio_mllm.backends.local import LocalChat  # imports torch

        return LocalChat(cfg)
    return ScriptedChat(cfg)
