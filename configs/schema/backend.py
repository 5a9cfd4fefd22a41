"""Frozen configuration of backends: which language model answers a planner's chats, where, and at what price."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final, Literal
from urllib.parse import urlsplit

from configs.schema.checks import is_loopback, require, require_used

BackendKind = Literal["openai", "local", "replay", "scripted"]
#: Fields that not every kind uses; elsewhere they keep their defaults, so that none is ignored. `replay` names what was asked.
_OF_KINDS: Final[Mapping[str, tuple[BackendKind, ...]]] = {
    "base_url": ("openai", "replay"),
    "timeout_s": ("openai", "replay"),
    "retries": ("openai", "replay"),
    "structured": ("openai", "replay"),
    "token_limit_field": ("openai", "replay"),
    "device": ("local", "replay"),
    "dtype": ("local", "replay"),
    "batch": ("local", "replay"),
    "constrained": ("local", "replay"),
}
#: Longest wait, a day; the system's clock takes no endless one.
_LONGEST_S: Final = 86_400.0


@dataclass(frozen=True)
class BackendConfig:
    """One backend.

    Attributes:
        kind: `openai` any OpenAI-compatible URL, `local` a Hugging Face checkpoint in this process, `replay` recorded replies
            alone, `scripted` a function of a Python file.
        name: in ledgers and tables.
        model: name that the server knows, or the local checkpoint's folder.
        revision: exact revision; shown beside every figure.
        base_url: of the server, for `openai`; null takes OpenAI's.
        key_env: environment variable that holds the key; the key itself is never configuration.
        timeout_s: longest wait for a reply, each attempt.
        retries: of time-outs, 408, 409, 429 and 5xx, by the OpenAI client, with its back-off.
        concurrency: calls under way at once, over all threads and processes of a run.
        structured: how a schema is sent: `json_schema`, `json_object`, or `off` (the prompt alone asks for JSON).
        token_limit_field: name of the field for the longest reply; newer OpenAI models know `max_completion_tokens` alone.
        max_tokens: longest reply.
        temperature: 0 asks for the most likely reply.
        image_size: side of the head view in pixels.
        price: entry of the price table; null where calls cost nothing.
        device: of a local model, such as `cpu` or `cuda`; `auto` takes a GPU when there is one.
        dtype: of a local model.
        batch: calls that a local model answers together.
        constrained: whether a local model's tokens are held to the schema (extra `constrained`).
        source: `FILE.py:FUNCTION` of a scripted backend, a function of a request that returns a reply's text.
        cache: SQLite file of replies; null keeps none. `replay` reads it and asks nobody.
    """

    kind: BackendKind
    name: str
    model: str = ""
    revision: str = ""
    base_url: str | None = None
    key_env: str = "OPENAI_API_KEY"
    timeout_s: float = 120.0
    retries: int = 4
    concurrency: int = 8
    structured: Literal["json_schema", "json_object", "off"] = "json_schema"
    token_limit_field: Literal["max_tokens", "max_completion_tokens"] = "max_tokens"
    max_tokens: int = 2048
    temperature: float = 0.0
    image_size: int = 500
    price: str | None = None
    device: str = "auto"
    dtype: Literal["auto", "float32", "bfloat16", "float16"] = "auto"
    batch: int = 1
    constrained: bool = False
    source: str | None = None
    cache: str | None = "outputs/replies.sqlite"

    def __post_init__(self) -> None:
        require(self.name.isidentifier(), f"backend name {self.name!r} must be an identifier")
        require(bool(self.model) or self.kind == "scripted", f"backend kind {self.kind!r} needs a model, got ''")
        require((self.source is not None) == (self.kind == "scripted"), f"kind {self.kind!r} with source {self.source!r}")
        require_used(self, _OF_KINDS)
        # not shown: whoever gives something else gives the key
        require(self.key_env.isidentifier(), "key_env is the name of an environment variable; a key itself is never an option")
        require(self.kind != "replay" or self.cache is not None, "backend kind 'replay' needs a cache, got null")
        require(0.0 < self.timeout_s <= _LONGEST_S, f"timeout_s {self.timeout_s} outside (0, {_LONGEST_S:g}]")
        require(0 <= self.retries <= 20, f"retries {self.retries} outside [0, 20]")
        require(1 <= self.concurrency <= 1024, f"concurrency {self.concurrency} outside [1, 1024]")
        require(self.max_tokens > 0, f"max_tokens {self.max_tokens} must be positive")
        require(0.0 <= self.temperature <= 2.0, f"temperature {self.temperature} outside [0, 2]")
        require(32 <= self.image_size <= 2048, f"image_size {self.image_size} outside [32, 2048]")
        require(1 <= self.batch <= 1024, f"batch {self.batch} outside [1, 1024]")

    @property
    def on_this_machine(self) -> bool:
        """Whether `base_url` names a server of this machine."""
        try:
            return is_loopback(urlsplit(self.base_url or "").hostname or "")
        except ValueError:
            return False
