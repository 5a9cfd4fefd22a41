"""Backends that answer from recorded replies: one that asks another when there is none, and one that asks nobody.

    python -m proprio_mllm report replies FILE [show=KEY] [export=FILE.jsonl] [import=FILE.jsonl]

    FILE                what backend.cache names, such as outputs/replies.sqlite; alone: a line per call
    show=KEY            one call in full; the first digits of its key do
    export=FILE.jsonl   all calls as JSON lines: version, key, purpose, recorded_at, question, reply; pictures are digests
    import=FILE.jsonl   takes such lines in, all or none; calls that are there already stay as they are

Errors and replies that were cut off are never recorded. Paper: none (engineering).
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import logging
import os
import sys
import threading
import weakref
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Final

from rich.console import Console

from configs.help import shows_help
from configs.schema.backend import BackendConfig
from data.files import write_text
from proprio_mllm.backends.identity import identity_of
from proprio_mllm.backends.protocol import Backend, BackendError, BackendSetupError, ChatReply, ChatRequest
from proprio_mllm.backends.replies import RecordedCall, ReplyStore, question_of

_VERSION: Final = 1
_USAGE: Final = "expected FILE [show=KEY] [export=FILE.jsonl] [import=FILE.jsonl]"
_SHOWN_CHARACTERS: Final = 80

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
        self._guard = threading.Lock()
        #: One lock per question under way; it goes when nobody holds it or waits for it.
        self._asking: weakref.WeakValueDictionary[str, threading.Lock] = weakref.WeakValueDictionary()

    def complete(self, request: ChatRequest) -> ChatReply:
        """The recorded reply, or a new one.

        Raises:
            BackendError: as of `inner`, and when the file cannot be read.
        """
        key, question = question_of(self.identity, request)
        with self._guard:
            lock = self._asking.setdefault(key, threading.Lock())
        with lock:
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
            BackendSetupError: when there is none to any request of this backend; the message names those that there are.
        """
        key, _ = question_of(self.identity, request)
        found = self._store.get(key)
        if found is not None:
            return found
        asked = next((message.text for message in reversed(request.messages) if message.role == "user"), "")
        missing = f"the {request.purpose!r} request {key[:12]} that begins {_start(asked)!r}"
        held = self._store.identities()
        if self.identity in held:
            raise BackendError(
                f"{self._store.path} holds no reply to {missing} (of {self.identity}, it holds {held[self.identity]})"
            )
        raise BackendSetupError(
            f"{self._store.path} holds no reply to {missing}, nor any of {self.identity};"
            f" it holds replies of: {', '.join(held) or 'none'}"
        )

    def close(self) -> None:
        """Closes the file."""
        self._store.close()


def recorded_revision(cfg: BackendConfig, path: Path) -> str:
    """Revision of the newest recorded replies of a backend whose revision is not known; "" when there are none.

    Raises:
        BackendSetupError: when the file cannot be used.
    """
    if not path.is_file():
        return ""
    with contextlib.closing(ReplyStore(path, read_only=True)) as store:
        held = store.identities()
    for identity in held:
        with contextlib.suppress(ValueError, AttributeError):  # of a backend that is known by something else than JSON
            revision = str(json.loads(identity).get("revision", ""))
            if identity == identity_of(dataclasses.replace(cfg, revision=revision)):
                return revision
    return ""


def main(arguments: Sequence[str]) -> int:
    """Command line; 0 on success, 2 on wrong arguments or files."""
    given = list(arguments)
    try:
        if not shows_help(given, __doc__):
            options = dict(argument.split("=", 1) for argument in given[1:] if "=" in argument)
            if not given or len(options) != len(given) - 1 or not options.keys() <= {"show", "export", "import"}:
                raise ValueError(f"{_USAGE}, got {' '.join(given) or 'nothing'}")
            with contextlib.closing(ReplyStore(Path(given[0]), read_only="import" not in options)) as store:
                for line in _told(store, options):
                    sys.stdout.write(f"{line}\n")
        sys.stdout.flush()  # what cannot be written is noticed here, not at the program's end
    except BrokenPipeError:  # the reader, such as `head`, has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except (BackendError, ValueError, OSError) as error:
        Console(stderr=True, highlight=False).print(f"cache: {error}", style="red", markup=False, soft_wrap=True)
        return 2
    return 0


def _told(store: ReplyStore, options: dict[str, str]) -> Iterator[str]:
    """Does what the options ask, and says it; without options a line per call."""
    if "import" in options:
        calls = _imported(Path(options["import"]))
        yield f"{store.add(calls)} of {len(calls)} calls of {options['import']} are new"
    if "show" in options:
        found = [call for call in store.calls() if call.key.startswith(options["show"])]
        if len(found) != 1:
            raise ValueError(f"{len(found)} keys of {store.path} begin with {options['show']!r}, expected 1")
        yield from _shown(found[0])
    if "export" in options:
        path = Path(options["export"])
        if path.is_dir() or (path.exists() and path.samefile(store.path)):
            raise ValueError(f"{path} is a folder, or the recorded replies themselves; it is not replaced")
        lines = [
            json.dumps({"version": _VERSION, **call.model_dump()}, ensure_ascii=False, sort_keys=True) for call in store.calls()
        ]
        write_text(path, "".join(f"{line}\n" for line in lines))
        yield f"{len(lines)} calls in {path}"
    for call in () if options else store.calls():
        reply = call.reply
        end = "" if reply.finish_reason == "stop" else f" [{reply.finish_reason}]"
        tokens = f"{reply.prompt_tokens}+{reply.completion_tokens}"
        head = f"{call.key[:12]}  {call.recorded_at}  {call.purpose:<10}  {reply.model}  {tokens:>10}{end}"
        yield f"{head}  {_start(reply.text)}"


def _shown(call: RecordedCall) -> Iterator[str]:
    """A call in full."""
    yield f"{call.key}  {call.recorded_at}  {call.purpose}"
    yield json.dumps(call.question | {"messages": len(call.question["messages"])}, ensure_ascii=False, sort_keys=True)
    for message in call.question["messages"]:
        yield f"\n--- {message['role']}"
        for part in message["content"]:
            yield part if isinstance(part, str) else f"[{part['media_type']} {part['image']}]"
    yield f"\n--- reply ({json.dumps(call.reply.model_dump(exclude={'text'}))})"
    yield call.reply.text


def _imported(path: Path) -> list[RecordedCall]:
    """The calls of a file of JSON lines, each checked; the error of a line that is none names its number."""
    calls: list[RecordedCall] = []
    with path.open("rb") as file:
        for number, line in enumerate(file, start=1):
            try:
                raw: Any = json.loads(line)
                if not isinstance(raw, dict):
                    raise ValueError(f"expected an object, got {type(raw).__name__}")
                if (version := raw.pop("version", None)) != _VERSION:
                    raise ValueError(f"version {version!r} is unknown; known: {_VERSION}")
                calls.append(RecordedCall.model_validate(raw))
            except ValueError as error:
                raise ValueError(f"{path}, line {number}: {' '.join(str(error).split())[:300]}") from error
    return calls


def _start(text: str) -> str:
    return " ".join(text.split())[:_SHOWN_CHARACTERS]
