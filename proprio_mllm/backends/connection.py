"""The way to a server: its URL, the API key that is sent and never shown, and an HTTP client that bounds what comes back.

The key is read from the environment and lives in memory alone. Servers echo keys in error messages and headers, and the HTTP
libraries write headers to their debug logs; `redact` takes the key out of a text, `guard` out of those logs.

The OpenAI client's own time limit is one of silence: a server that drips a byte at a time holds a call for ever, and a body of
any size is read into memory. Here a body ends after its time or size. Compressed bodies are not taken, since a small one can
grow without bound; redirects are not followed, since a key is meant for one server. Paper: none (engineering).
"""

from __future__ import annotations

import logging
import os
import re
import time
from collections.abc import Iterator
from typing import Final, NoReturn
from urllib.parse import urlsplit

import httpx2
import openai

from proprio_mllm.backends.protocol import BackendSetupError

#: Longest body that is read, bytes; a chat completion of 2,048 tokens has about 10 kB.
MAX_REPLY_BYTES: Final = 16 * 2**20
_CONNECT_S: Final = 15.0
#: A shorter key is a word such as `EMPTY` or `none`, which local servers are given and replies may hold.
_SHORTEST_KEY: Final = 8
#: Loggers that may see what a server sends; a filter holds for its own logger alone, not for those below it.
_LOGGERS: Final = (
    *(f"httpcore2.{name}" for name in ("connection", "http11", "http2", "proxy", "socks")),
    *(f"openai.{name}" for name in ("_base_client", "_legacy_response", "_response")),
    "httpx2",
    "openai",
)


def checked_url(url: str, backend: str) -> str:
    """The URL of a backend's server itself.

    Raises:
        BackendSetupError: when it cannot be asked, or holds a user, a password or a query, where keys are put.
    """
    if "@" in url or "?" in url:
        raise BackendSetupError(f"backend {backend}: base_url holds a user or a query; a key belongs in the environment")
    try:
        parts = urlsplit(url)
        usable = parts.scheme in ("http", "https") and bool(parts.hostname) and parts.port != 0
    except ValueError:
        usable = False
    if not usable or not url.isascii() or any(character.isspace() for character in url):
        raise BackendSetupError(f"backend {backend}: base_url {url!r} is not allowed; allowed: http(s)://HOST[:PORT]/PATH")
    return url


class Secret(logging.Filter):
    """An API key, and the filter that takes it out of log records."""

    def __init__(self, value: str) -> None:
        super().__init__()
        self._value = value
        parts = dict.fromkeys(value[start : start + _SHORTEST_KEY] for start in range(len(value) - _SHORTEST_KEY + 1))
        self._parts = re.compile("|".join(map(re.escape, parts))) if parts else None

    def reveal(self) -> str:
        """The key itself."""
        return self._value

    def redact(self, text: str) -> str:
        """A text without the key, or a part of it of 8 characters or more, as where a reply was cut in its midst.

        A key of fewer characters is no secret and stays.
        """
        if self._parts is None:
            return text
        kept, last = list[str](), 0
        for match in self._parts.finditer(text):
            start, end = match.span()
            if start < last:
                continue
            shift = self._value.find(match[0]) - start
            while end < len(text) and text[end] == self._value[end + shift : end + shift + 1]:
                end += 1
            kept += [text[last:start], "[key]"]
            last = end
        return "".join(kept) + text[last:]

    def filter(self, record: logging.LogRecord) -> bool:
        """Lets every record pass, without the key."""
        text = record.getMessage()
        if (redacted := self.redact(text)) != text:
            record.msg, record.args = redacted, ()
        return True

    def guard(self) -> None:
        """Keeps the key out of the HTTP libraries' logs."""
        for name in _LOGGERS:
            logging.getLogger(name).addFilter(self)

    def release(self) -> None:
        """Ends `guard`."""
        for name in _LOGGERS:
            logging.getLogger(name).removeFilter(self)

    def __repr__(self) -> str:
        """Nothing of the key."""
        return "Secret()"

    def __reduce__(self) -> NoReturn:
        """Refuses to be stored or sent.

        Raises:
            TypeError: always.
        """
        raise TypeError("a key is neither stored nor sent; read it from the environment")


def read_secret(variable: str, backend: str, optional: bool) -> Secret:
    """The key in an environment variable.

    Args:
        variable: its name.
        backend: who needs it, for messages.
        optional: whether a server does without; it is then sent `none`.

    Raises:
        BackendSetupError: when there is none, or it holds what cannot be sent.
    """
    value = os.environ.get(variable, "").strip()
    if not value and not optional:
        raise BackendSetupError(f"backend {backend}: no key; set the environment variable {variable}")
    if value and not re.fullmatch("[!-~]+", value):
        raise BackendSetupError(f"backend {backend}: the key in {variable} holds a space or a character outside ASCII")
    return Secret(value or "none")


class ReplyTooLongError(openai.OpenAIError):
    """A body that is longer than allowed or packed; an error of the OpenAI client's, which it does not try again."""


class _Bounded(httpx2.SyncByteStream):
    """The body of a response, which ends with an error at a size, or after the time that the request allows for silence."""

    def __init__(self, response: httpx2.Response, limit_bytes: int) -> None:
        assert isinstance(response.stream, httpx2.SyncByteStream)
        self._body, self._request, self._limit_bytes = response.stream, response.request, limit_bytes
        self._deadline = time.monotonic() + response.request.extensions["timeout"]["read"]

    def __iter__(self) -> Iterator[bytes]:
        size = 0
        for piece in self._body:
            size += len(piece)
            if size > self._limit_bytes:
                raise ReplyTooLongError(f"the reply has more than {self._limit_bytes} bytes")
            if time.monotonic() > self._deadline:
                raise httpx2.ReadTimeout("the reply came too slowly", request=self._request)
            yield piece

    def close(self) -> None:
        self._body.close()


def bounded_client(timeout_s: float, own_machine: bool, limit_bytes: int = MAX_REPLY_BYTES) -> httpx2.Client:
    """A client for `openai.OpenAI(http_client=...)`, for any number of threads.

    Args:
        timeout_s: longest silence, and longest time for a body, so that an attempt ends before twice as long.
        own_machine: whether the server is on this machine: a proxy of the environment is then passed by.
        limit_bytes: longest body that is read.
    """

    def bound(response: httpx2.Response) -> None:
        packed = response.headers.get("content-encoding", "identity")
        if packed != "identity":
            raise ReplyTooLongError(f"the reply is packed ({packed}), which was not asked for")
        response.stream = _Bounded(response, limit_bytes)

    return openai.DefaultHttpxClient(
        timeout=httpx2.Timeout(timeout_s, connect=min(timeout_s, _CONNECT_S)),
        headers={"Accept-Encoding": "identity"},
        event_hooks={"response": [bound]},
        follow_redirects=False,
        trust_env=not own_machine,
    )
