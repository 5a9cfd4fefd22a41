"""What a server's failure means: whose matter it is, and whether a repetition could mend it.

By status and cause:

- no key, a wrong one, an unknown model or path, a redirect, no money left: `BackendSetupError`;
- 400 and 422 are read: about the key, the model or a parameter that every call sends, `BackendSetupError`; a content policy is
  a refusal, which is a reply; the rest (a prompt too long, a picture that cannot be read) is this request's, `BackendError`;
- 408, 409, 413, 429, 5xx: `BackendError`; no connection: `UnreachableError`;
- time-outs, connections that break, gateways that got no answer, bodies too long: `LostReplyError`, since it may be charged.

Servers differ in the form of their errors: an object `error`, the same in a list (Gemini), `message` or `detail` alone (vLLM),
or a page. Paper: none (engineering).
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Final

import httpx2
import openai

from proprio_mllm.backends.http_client import ReplyTooLongError
from proprio_mllm.backends.protocol import BackendError, BackendSetupError, LostReplyError, UnreachableError

__all__ = ["failure_of", "is_refusal"]

_OF_EVERY_CALL: Final = frozenset({401, 402, 403, 404, 405, 410, 415, 501})
_OF_A_REQUEST: Final = frozenset({400, 422})
_OF_A_GATEWAY: Final = frozenset({502, 504})
_POLICY: Final = re.compile(
    r"content_filter|content_policy|content policy|content management policy|safety system|invalid_prompt"
)
_TOO_LONG: Final = re.compile(
    r"context.?length|context window|too long|too large|token count|token limit|exceeds? the max|reduce the length"
)
_SETUP: Final = re.compile(
    r"api.?key|model_not_found|invalid_model|unknown model|model\b.{0,120}\b(not found|not exist|not supported|unknown)"
    r"|unsupported_|unsupported (parameter|value)|unknown_parameter|unrecognized request argument"
    r"|response_format|invalid schema|location is not supported|billing"
)
_NO_MONEY: Final = re.compile(r"insufficient_quota|billing")
#: Errors in which nothing was sent.
_UNSENT: Final = (httpx2.ConnectError, httpx2.ConnectTimeout, httpx2.PoolTimeout, httpx2.ProxyError)


def is_refusal(error: openai.OpenAIError) -> bool:
    """Whether a server did not let a request through to the model for what it says."""
    if not isinstance(error, openai.APIStatusError) or error.status_code not in _OF_A_REQUEST:
        return False
    return _POLICY.search(" ".join(_said(error.body)).lower()) is not None


def failure_of(error: openai.OpenAIError, timeout_s: float, retries: int) -> BackendError:
    """The error that a call ends with; its text holds all that the server said, a key that it echoes included.

    Args:
        error: of the OpenAI client.
        timeout_s: of one attempt.
        retries: that the client makes.
    """
    if isinstance(error, openai.APIStatusError):
        return _status_failure(error, retries)
    if isinstance(error, ReplyTooLongError):
        return LostReplyError(str(error))
    cause = error.__cause__
    why = f"{type(cause).__name__}: {cause}" if cause is not None else f"{type(error).__name__}: {error}"
    if isinstance(cause, (httpx2.UnsupportedProtocol, httpx2.LocalProtocolError)):
        return BackendSetupError(f"cannot ask: {why}")
    if isinstance(cause, _UNSENT):
        return UnreachableError(f"no connection after {_times(retries)}: {why}")
    if isinstance(error, openai.APITimeoutError):
        return LostReplyError(f"no reply within {timeout_s:g} s, after {_times(retries)}")
    return LostReplyError(f"the connection broke, after {_times(retries)}: {why}")


def _status_failure(error: openai.APIStatusError, retries: int) -> BackendError:
    status = error.status_code
    code, message = _said(error.body)
    told = ": ".join(part for part in (f"HTTP {status}", code, message) if part)
    words = f"{code} {message}".lower()
    if 300 <= status < 400:
        return BackendSetupError(f"HTTP {status}: the server sends elsewhere, to {error.response.headers.get('location')}")
    if status in _OF_EVERY_CALL or (status == 429 and _NO_MONEY.search(words)):
        return BackendSetupError(told)
    if status in _OF_A_REQUEST:
        of_every_call = _SETUP.search(words) is not None and _TOO_LONG.search(words) is None
        return BackendSetupError(told) if of_every_call else BackendError(told)
    if status in _OF_A_GATEWAY:
        return LostReplyError(f"{told} (after {_times(retries)})")
    return BackendError(f"{told} (after {_times(retries)})" if status in (408, 409, 429) or status >= 500 else told)


def _said(body: object) -> tuple[str, str]:
    """Code and message of an error's body, each perhaps empty, in one line."""
    if isinstance(body, list) and body:
        body = body[0]
    if isinstance(body, Mapping) and isinstance(body.get("error"), Mapping | str):
        body = body["error"]
    if not isinstance(body, Mapping):
        return "", _line(body)
    names = [str(body[name]) for name in ("code", "type", "status", "param") if isinstance(body.get(name), str)]
    return _line(" ".join(names)), _line(body.get("message") or body.get("detail"))


def _line(text: object) -> str:
    return "" if text is None else " ".join(str(text).split())


def _times(retries: int) -> str:
    return f"{retries + 1} attempt{'s' if retries else ''}"
