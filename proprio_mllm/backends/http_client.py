"""The HTTP client below the OpenAI client: it bounds how long and how much a server may answer.

The OpenAI client's own time limit is one of silence: a server that drips a byte at a time holds a call for ever, and a body of
any size is read into memory. Here an attempt ends after its time and a body after its size. Compressed bodies are not asked for
and not taken, since a small one can grow without bound; redirects are not followed, since a key is meant for one server.

Paper: none (engineering).
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from typing import Final

import httpx2
import openai

__all__ = ["MAX_REPLY_BYTES", "ReplyTooLongError", "bounded_client"]

#: Longest body that is read, bytes; a chat completion of 2,048 tokens has about 10 kB.
MAX_REPLY_BYTES: Final = 16 * 2**20
_CONNECT_S: Final = 15.0
_DEADLINE: Final = "proprio_mllm.deadline"


class ReplyTooLongError(openai.OpenAIError):
    """A body that is longer than allowed or packed; an error of the OpenAI client's, which it does not try again."""


class _Bounded(httpx2.SyncByteStream):
    """A body that ends with an error at a size or a time.

    Args:
        body: as it comes.
        request: that it answers.
        limit_bytes: its size.
    """

    def __init__(self, body: httpx2.SyncByteStream, request: httpx2.Request, limit_bytes: int) -> None:
        self._body = body
        self._request = request
        self._limit_bytes = limit_bytes

    def __iter__(self) -> Iterator[bytes]:
        """Pieces of the body."""
        size = 0
        for piece in self._body:
            size += len(piece)
            if size > self._limit_bytes:
                raise ReplyTooLongError(f"the reply has more than {self._limit_bytes} bytes")
            if time.monotonic() > self._request.extensions[_DEADLINE]:
                raise httpx2.ReadTimeout("the reply came too slowly", request=self._request)
            yield piece

    def close(self) -> None:
        """Closes the connection if the body was not read to its end."""
        self._body.close()


def bounded_client(timeout_s: float, own_machine: bool, limit_bytes: int = MAX_REPLY_BYTES) -> httpx2.Client:
    """A client for `openai.OpenAI(http_client=...)`, for any number of threads.

    Args:
        timeout_s: for one attempt, from its start to the last piece of its reply, unless a request has a time of its own;
            looked at when a piece arrives and after as long a silence, so that an attempt ends before twice as long.
        own_machine: whether the server is on this machine: a proxy of the environment is then passed by.
        limit_bytes: longest body that is read.
    """

    def start(request: httpx2.Request) -> None:
        own_s = request.extensions.get("timeout", {}).get("read")
        request.extensions[_DEADLINE] = time.monotonic() + (timeout_s if own_s is None else own_s)

    def bound(response: httpx2.Response) -> None:
        packed = response.headers.get("content-encoding", "identity")
        if packed != "identity":
            raise ReplyTooLongError(f"the reply is packed ({packed}), which was not asked for")
        assert isinstance(response.stream, httpx2.SyncByteStream)
        response.stream = _Bounded(response.stream, response.request, limit_bytes)

    return openai.DefaultHttpxClient(
        timeout=httpx2.Timeout(timeout_s, connect=min(timeout_s, _CONNECT_S)),
        headers={"Accept-Encoding": "identity"},
        event_hooks={"request": [start], "response": [bound]},
        follow_redirects=False,
        trust_env=not own_machine,
    )
