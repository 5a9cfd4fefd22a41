"""Backends that answer from recorded replies: one that asks another when there is none, and one that asks nobody.

`python -m proprio_mllm report replies FILE` shows what was recorded. Errors and replies that were cut off
are never recorded. Paper: none (engineering).
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import logging
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Final

from configs.schema.backend import BackendConfig
from proprio_mllm.backends.identity import identity_in_words, identity_of
from proprio_mllm.backends.protocol import Backend, BackendError, BackendSetupError, ChatReply, ChatRequest
from proprio_mllm.backends.replies import ReplyStore, question_of

__all__ = ["CachedBackend", "ReplayBackend", "recorded_revision"]

_SHOWN_CHARACTERS: Final = 80
_SHOWN_OTHERS: Final = 5

logger = logging.getLogger(__name__)


class CachedBackend:
    """Answers what was answered before, and asks `inner` the rest.

    Threads that ask the same thing at once ask `inner` once; of several processes each may ask, and the first reply stands for
    all.

    Args:
        inner: what is asked; closed with this one.
        path: file of replies.

    Raises:
        BackendSetupError: when the file cannot be used.
    """

    def __init__(self, inner: Backend, path: Path) -> None:
        self.identity = inner.identity
        self._inner = inner
        self._store = ReplyStore(path)
        self._turns = _Turns()

    def complete(self, request: ChatRequest) -> ChatReply:
        """The recorded reply, or a new one.

        Raises:
            BackendError: as of `inner`, and when the file cannot be read.
        """
        key, question = question_of(self.identity, request)
        found = self._store.get(key)
        if found is not None:
            return found
        with self._turns.at(key):
            found = self._store.get(key)
            if found is not None:
                return found
            reply = self._inner.complete(request)
            return reply if reply.finish_reason == "length" else self._kept(key, question, request.purpose, reply)

    def close(self) -> None:
        """Closes the file and the backend that is asked."""
        self._store.close()
        self._inner.close()

    def _kept(self, key: str, question: str, purpose: str, reply: ChatReply) -> ChatReply:
        """The reply that is recorded now: this one, or another process's that came first, at this one's cost."""
        try:
            first = None if self._store.put(key, question, purpose, reply) else self._store.get(key)
        except BackendError as error:  # the reply is here and may be paid for
            logger.error("a reply is not recorded: %s", error)
            return reply
        if first is None:
            return reply
        return dataclasses.replace(reply, text=first.text, finish_reason=first.finish_reason, model=first.model)


def recorded_revision(cfg: BackendConfig, path: Path) -> str:
    """Revision of the newest recorded replies of a backend whose revision is not known; "" when there are none.

    Raises:
        BackendSetupError: when the file cannot be used.
    """
    if not path.is_file():
        return ""
    store = ReplyStore(path, read_only=True)
    try:
        held = store.identities()
    finally:
        store.close()
    for identity in held:
        with contextlib.suppress(ValueError, AttributeError):
            revision = str(json.loads(identity).get("revision", ""))
            if identity == identity_of(dataclasses.replace(cfg, revision=revision)):
                return revision
    return ""


class ReplayBackend:
    """Answers from recorded replies alone.

    Args:
        identity: of the backend whose replies they are.
        path: file of replies.

    Raises:
        BackendSetupError: when there is no such file, or it cannot be used.
    """

    def __init__(self, identity: str, path: Path) -> None:
        self.identity = identity
        self._store = ReplyStore(path, read_only=True)

    def complete(self, request: ChatRequest) -> ChatReply:
        """The recorded reply.

        Raises:
            BackendError: when there is none; the message names the request.
            BackendSetupError: when there is none to any request of this backend.
        """
        key, _ = question_of(self.identity, request)
        found = self._store.get(key)
        if found is None:
            asked = next((message.text for message in reversed(request.messages) if message.role == "user"), "")
            start = " ".join(asked.split())[:_SHOWN_CHARACTERS]
            others = self._store.count(self.identity)
            named = map(identity_in_words, self._store.identities()[:_SHOWN_OTHERS])
            held = "" if others else "; it holds replies of: " + (", ".join(named) or "none")
            raise (BackendError if others else BackendSetupError)(
                f"{self._store.path} holds no reply to the {request.purpose!r} request {key[:12]} that begins {start!r}"
                f" (of its backend, {identity_in_words(self.identity)}, it holds {others}{held})"
            )
        return found

    def close(self) -> None:
        """Closes the file."""
        self._store.close()


class _Turns:
    """One thread at a time per key."""

    def __init__(self) -> None:
        self._guard = threading.Lock()
        self._waiting: dict[str, tuple[threading.Lock, int]] = {}

    @contextlib.contextmanager
    def at(self, key: str) -> Iterator[None]:
        with self._guard:
            lock, waiting = self._waiting.get(key, (threading.Lock(), 0))
            self._waiting[key] = lock, waiting + 1
        try:
            with lock:
                yield
        finally:
            with self._guard:
                waiting = self._waiting[key][1] - 1
                if waiting:
                    self._waiting[key] = lock, waiting
                else:
                    del self._waiting[key]
