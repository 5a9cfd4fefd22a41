"""The price table: every entry, what calls cost by it, and a bound that no call passes."""

from __future__ import annotations

from datetime import date

import pytest
from pydantic import BaseModel

from configs.validate import ConfigError
from proprio_mllm.backends import prices
from proprio_mllm.backends.prices import LongPrice, Price, price_of, price_table
from proprio_mllm.backends.protocol import ChatMessage, ChatRequest
from tests.backends.loopback import ask


class Steps(BaseModel):
    steps: list[str]


def test_every_entry() -> None:
    table = price_table()
    assert {"gpt-4o-2024-08-06", "gemini-1.5-pro", "gpt-4o-mini", "gpt-4.1", "gemini-2.5-pro", "gemini-2.5-flash"} == set(table)
    for name, price in table.items():
        assert name in price.models
        assert date(2024, 1, 1) < date.fromisoformat(price.published) < date(2026, 1, 1)
        assert price.source
        assert 0 < price.prompt < price.completion
        assert price.long is None or (price.long.prompt > price.prompt and price.long.completion >= price.completion)


@pytest.mark.parametrize(
    ("name", "prompt_tokens", "completion_tokens", "cost_usd"),
    [
        ("gpt-4o-2024-08-06", 1_000_000, 0, 2.50),
        ("gpt-4o-2024-08-06", 1000, 100, 0.0035),
        ("gemini-1.5-pro", 128_000, 1000, 0.165),
        ("gemini-1.5-pro", 200_000, 1000, 0.51),
        ("gpt-4o-mini", 0, 1_000_000, 0.60),
        ("gemini-2.5-pro", 0, 0, 0.0),
    ],
)
def test_costs(name: str, prompt_tokens: int, completion_tokens: int, cost_usd: float) -> None:
    assert price_of(name).cost_usd(prompt_tokens, completion_tokens) == pytest.approx(cost_usd)


def test_the_bound_counts_bytes_pictures_the_schema_and_the_longest_reply() -> None:
    price = Price(("m",), prompt=1.0, completion=1.0, image_tokens=500, published="2025-01-01", source="here")
    text = ChatRequest((ChatMessage("user", ("ü" * 100,)),), max_tokens=50)
    assert price.bound_usd(text) == pytest.approx((200 + 16 + 50) * 1e-6)
    assert price.bound_usd(ask("now")) == pytest.approx((len("you plan") + len("now") + 2 * 16 + 500 + 2048) * 1e-6)
    assert price.bound_usd(ask("now", schema=Steps)) > price.bound_usd(ask("now")) + 100e-6
    long = Price(("m",), 1.0, 1.0, 500, "2025-01-01", "here", LongPrice(100, 10.0, 10.0))
    assert long.bound_usd(text) == pytest.approx(10 * price.bound_usd(text))


def test_an_unknown_entry() -> None:
    with pytest.raises(
        ValueError, match=r"backend\.price='gpt-9' is not allowed; allowed: gemini-1\.5-pro, gemini-2\.5-flash, "
    ):
        price_of("gpt-9")


REST = "completion: 1, image_tokens: 1, source: s"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("version: 2\nprices: {}", "version 2 is unknown; known: 1"),
        ("version: 1\nprices: {a: {models: [a], prompt: 1}}", r"a\.completion: missing"),
        (f"version: 1\nprices: {{a: {{models: [a], prompt: -1, published: '2025-01-01', {REST}}}}}", "not be negative, got -1"),
        (f"version: 1\nprices: {{a: {{models: [a], prompt: 1, published: 'May', {REST}}}}}", "a: .*'May'"),
    ],
)
def test_a_wrong_table(tmp_path, monkeypatch, text: str, message: str) -> None:
    (tmp_path / "prices.yaml").write_text(text)
    monkeypatch.setattr(prices, "_FILE", tmp_path / "prices.yaml")
    with pytest.raises(ConfigError, match=message):
        price_table.__wrapped__()
