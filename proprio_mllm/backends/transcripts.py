"""Recorded replies for people: a list, one call in full, JSON lines out and in. Command line of `backends.cache`.

A line is `{"version": 1, "key", "purpose", "recorded_at", "question", "reply"}`; pictures are digests of their bytes. Lines are
checked before any is taken in. Paper: none (engineering).
"""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Final

from rich.console import Console

from configs.help import asks_for_help
from proprio_mllm.backends.protocol import BackendError
from proprio_mllm.backends.replies import RecordedCall, ReplyStore

__all__ = ["TRANSCRIPT_VERSION", "export_lines", "import_lines", "listing", "main", "shown"]

TRANSCRIPT_VERSION: Final = 1
_USAGE: Final = "expected FILE [show=KEY] [export=FILE.jsonl] [import=FILE.jsonl]"
_ABOUT: Final = """  FILE                what backend.cache names, such as outputs/replies.sqlite; alone: a line per call
  show=KEY            one call in full; the first digits of its key do
  export=FILE.jsonl   all calls as JSON lines
  import=FILE.jsonl   takes such lines in; calls that are there already stay as they are
"""
_SHOWN_CHARACTERS: Final = 60


def listing(store: ReplyStore) -> Iterator[str]:
    """One line per call: start of the key, time, purpose, model, tokens, start of the reply."""
    for call in store.calls():
        reply = call.reply
        text = " ".join(reply.text.split())[:_SHOWN_CHARACTERS]
        tokens = f"{reply.prompt_tokens}+{reply.completion_tokens}"
        end = "" if reply.finish_reason == "stop" else f" [{reply.finish_reason}]"
        yield f"{call.key[:12]}  {call.recorded_at}  {call.purpose:<10}  {reply.model}  {tokens:>10}{end}  {text}"


def shown(store: ReplyStore, start: str) -> str:
    """A call in full.

    Raises:
        ValueError: when not exactly one key begins so.
    """
    found = [call for call in store.calls() if call.key.startswith(start)]
    if len(found) != 1:
        raise ValueError(f"{len(found)} keys of {store.path} begin with {start!r}, expected 1")
    call = found[0]
    settings = {name: value for name, value in call.question.items() if name != "messages"}
    lines = [f"{call.key}  {call.recorded_at}  {call.purpose}", json.dumps(settings, ensure_ascii=False, sort_keys=True)]
    for message in call.question["messages"]:
        lines += ["", f"--- {message['role']}", *map(_part, message["content"])]
    lines += ["", f"--- reply ({json.dumps(call.reply.model_dump(exclude={'text'}))})", call.reply.text]
    return "\n".join(lines)


def export_lines(store: ReplyStore, path: Path) -> int:
    """Writes every call as one JSON line; how many.

    Raises:
        ValueError: when something other than a plain file is there, or the recorded replies themselves.
    """
    if path.exists() and (not path.is_file() or path.samefile(store.path)):
        raise ValueError(f"{path} is no plain file, or the recorded replies themselves; it is not replaced")
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    count = 0
    with temporary.open("w", encoding="utf-8") as file:
        for call in store.calls():
            line = {"version": TRANSCRIPT_VERSION, **call.model_dump()}
            file.write(json.dumps(line, ensure_ascii=False, sort_keys=True) + "\n")
            count += 1
    os.replace(temporary, path)
    return count


def import_lines(store: ReplyStore, path: Path) -> tuple[int, int]:
    """Takes in the calls of a file of JSON lines, all or none; calls that are there already stay as they are.

    Returns:
        How many lines there were, and how many calls were new.

    Raises:
        ValueError: on a line that is no call; the message names its number.
    """
    calls: list[RecordedCall] = []
    with path.open("rb") as file:
        for number, line in enumerate(file, start=1):
            try:
                calls.append(_read_line(line))
            except ValueError as error:
                raise ValueError(f"{path}, line {number}: {' '.join(str(error).split())[:300]}") from error
    return len(calls), store.add(calls)


def main(arguments: Sequence[str]) -> int:
    """Command line; 0 on success, 2 on wrong arguments or files."""
    given = list(arguments)
    try:
        if asks_for_help(given):
            sys.stdout.write(f"Recorded replies: {_USAGE}\n\n{_ABOUT}")
        else:
            path, options = _split(given)
            store = ReplyStore(path, read_only="import" not in options)
            try:
                _run(store, options)
            finally:
                store.close()
        sys.stdout.flush()  # what cannot be written is noticed here, not at the program's end
    except BrokenPipeError:  # the reader, such as `head`, has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except (BackendError, ValueError, OSError) as error:
        Console(stderr=True, highlight=False).print(f"cache: {error}", style="red", markup=False, soft_wrap=True)
        return 2
    return 0


def _split(given: Sequence[str]) -> tuple[Path, dict[str, str]]:
    options = dict(argument.split("=", 1) for argument in given[1:] if "=" in argument)
    known = {"show", "export", "import"}
    if not given or len(options) != len(given) - 1 or not set(options) <= known or not all(options.values()):
        raise ValueError(f"{_USAGE}, got {' '.join(given) or 'nothing'}")
    return Path(given[0]), options


def _run(store: ReplyStore, options: dict[str, str]) -> None:
    if "import" in options:
        lines, new = import_lines(store, Path(options["import"]))
        sys.stdout.write(f"{new} of {lines} calls of {options['import']} are new\n")
    if "show" in options:
        sys.stdout.write(shown(store, options["show"]) + "\n")
    if "export" in options:
        sys.stdout.write(f"{export_lines(store, Path(options['export']))} calls in {options['export']}\n")
    if not options:
        for line in listing(store):
            sys.stdout.write(line + "\n")


def _read_line(line: bytes) -> RecordedCall:
    raw: Any = json.loads(line)
    if not isinstance(raw, dict):
        raise ValueError(f"expected an object, got {type(raw).__name__}")
    version = raw.pop("version", None)
    if version != TRANSCRIPT_VERSION:
        raise ValueError(f"version {version!r} is unknown; known: {TRANSCRIPT_VERSION}")
    return RecordedCall.model_validate(raw)


def _part(part: Any) -> str:
    return part if isinstance(part, str) else f"[{part['media_type']} {part['image']}]"
