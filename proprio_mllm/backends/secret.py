"""An API key: sent, and never shown.

It is read from the environment and lives in memory alone. Servers echo keys in error messages and headers, and the HTTP
libraries write headers to their debug logs; `redact` takes the key out of a text, `guard` out of those logs. Paper: none
(engineering).
"""

from __future__ import annotations

import logging
import os
import re
from typing import Final, NoReturn

from proprio_mllm.backends.protocol import BackendSetupError

__all__ = ["Secret", "read_secret"]

_SHOWN: Final = "[key]"
#: A shorter one is a word such as `EMPTY` or `none`, which local servers are given and replies may hold.
_SHORTEST: Final = 8
_KEY: Final = re.compile(r"[!-~]+")
#: Loggers that may see what a server sends; a filter holds for its own logger alone, not for those below it.
_LOGGERS: Final = (
    "httpcore2.connection",
    "httpcore2.http11",
    "httpcore2.http2",
    "httpcore2.proxy",
    "httpcore2.socks",
    "httpx2",
    "openai",
    "openai._base_client",
    "openai._legacy_response",
    "openai._response",
)


class Secret:
    """A key.

    Args:
        value: of the key.
    """

    __slots__ = ("_filter", "_value")

    def __init__(self, value: str) -> None:
        self._value = value
        self._filter = _Redacting(self)

    def reveal(self) -> str:
        """The key itself."""
        return self._value

    def redact(self, text: str) -> str:
        """A text without the key; a key of fewer than 8 characters is no secret and stays."""
        return text.replace(self._value, _SHOWN) if len(self._value) >= _SHORTEST else text

    def guard(self) -> None:
        """Keeps the key out of the HTTP libraries' logs."""
        for name in _LOGGERS:
            logging.getLogger(name).addFilter(self._filter)

    def release(self) -> None:
        """Ends `guard`."""
        for name in _LOGGERS:
            logging.getLogger(name).removeFilter(self._filter)

    def __repr__(self) -> str:
        """Nothing of the key."""
        return "Secret()"

    def __reduce__(self) -> NoReturn:
        """Refuses to be stored or sent.

        Raises:
            TypeError: always.
        """
        raise TypeError("a key is neither stored nor sent; read it from the environment")


class _Redacting(logging.Filter):
    """Takes a key out of log records."""

    def __init__(self, secret: Secret) -> None:
        super().__init__()
        self._secret = secret

    def filter(self, record: logging.LogRecord) -> bool:
        """Lets every record pass, without the key."""
        text = record.getMessage()
        redacted = self._secret.redact(text)
        if redacted != text:
            record.msg, record.args = redacted, ()
        return True


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
    if value and not _KEY.fullmatch(value):
        raise BackendSetupError(f"backend {backend}: the key in {variable} holds a space or a character outside ASCII")
    return Secret(value or "none")
