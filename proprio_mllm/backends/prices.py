"""What calls cost, by a dated table (`prices.yaml`), and the most that a call can cost before it is made.

Paper: none; the paper does not report cost.
"""

from __future__ import annotations

import functools
import json
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import date
from pathlib import Path
from typing import Final

import yaml

from configs.validate import ConfigError, build
from proprio_mllm.backends.protocol import ChatImage, ChatRequest

_FILE: Final = Path(__file__).with_name("prices.yaml")
_VERSION: Final = 1
_PER_TOKEN: Final = 1e-6
#: More than the marks around a message count as, in any chat format known here.
_MESSAGE_TOKENS: Final = 16


@dataclass(frozen=True, slots=True)
class LongPrice:
    """The price of a call with a long prompt, for all of its tokens.

    Attributes:
        above: prompt tokens above which it holds.
        prompt: USD per million tokens read.
        completion: USD per million tokens written.
    """

    above: int
    prompt: float
    completion: float


@dataclass(frozen=True, slots=True)
class Price:
    """One entry of the table.

    Attributes:
        models: names by which servers know the model.
        prompt: USD per million tokens read.
        completion: USD per million tokens written, hidden thoughts included.
        image_tokens: most tokens that a picture of up to 2048 x 2048 pixels counts as.
        published: day on which the price was published, ISO 8601.
        source: where.
        long: price above a length of the prompt, where there is one.
    """

    models: tuple[str, ...]
    prompt: float
    completion: float
    image_tokens: int
    published: str
    source: str
    long: LongPrice | None = None

    def __post_init__(self) -> None:
        """Checks the date and the signs.

        Raises:
            ValueError: on a date or a price that cannot be.
        """
        date.fromisoformat(self.published)
        if min(self.prompt, self.completion, self.image_tokens) < 0:
            raise ValueError(f"prices must not be negative, got {self.prompt}, {self.completion}, {self.image_tokens}")

    def cost_usd(self, prompt_tokens: int, completion_tokens: int) -> float:
        """Price of a call."""
        rate = self.long if self.long is not None and prompt_tokens > self.long.above else self
        return (prompt_tokens * rate.prompt + completion_tokens * rate.completion) * _PER_TOKEN

    def bound_usd(self, request: ChatRequest) -> float:
        """The most that one answer to a request costs.

        Tokenizers work on UTF-8, so a text has at most as many tokens as bytes: about four times what it really has.
        """
        tokens = 0
        for message in request.messages:
            tokens += _MESSAGE_TOKENS
            for part in message.content:
                tokens += self.image_tokens if isinstance(part, ChatImage) else len(part.encode())
        if request.schema is not None:
            tokens += 2 * len(json.dumps(request.schema.model_json_schema()))  # closing it for strict servers makes it longer
        return self.cost_usd(tokens, request.max_tokens)


@functools.cache
def price_table() -> Mapping[str, Price]:
    """All entries by name.

    Raises:
        ConfigError: when the table is not one.
    """
    raw = yaml.safe_load(_FILE.read_text(encoding="utf-8"))
    if raw.get("version") != _VERSION:
        raise ConfigError(f"{_FILE.name}: version {raw.get('version')!r} is unknown; known: {_VERSION}")
    return {name: build(Price, entry, f"{_FILE.name}: {name}") for name, entry in raw["prices"].items()}


def price_of(name: str) -> Price:
    """An entry of the table.

    Raises:
        ValueError: when there is none of that name; the message names those that there are.
    """
    table = price_table()
    if name not in table:
        raise ValueError(f"backend.price={name!r} is not allowed; allowed: {', '.join(sorted(table))}")
    return table[name]
