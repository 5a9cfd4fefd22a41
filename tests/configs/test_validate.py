from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import Literal

import pytest

from configs.validate import ConfigError, build


class Colour(StrEnum):
    RED = "red"


@dataclass(frozen=True)
class Inner:
    size: int
    scale: float = 1.0


@dataclass(frozen=True)
class Outer:
    inner: Inner
    mode: Literal["a", "b"] = "a"
    names: tuple[str, ...] = ()
    limit: int | None = None
    colour: Colour = Colour.RED
    flag: bool = False

    def __post_init__(self) -> None:
        if self.limit is not None and self.limit < 0:
            raise ValueError(f"limit {self.limit} is negative")


def test_builds_nested_values() -> None:
    got = build(Outer, {"inner": {"size": 2, "scale": 3}, "names": ["x"], "mode": "b", "colour": "red"})
    assert got == Outer(Inner(2, 3.0), "b", ("x",))


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"inner": {"size": 2, "sise": 1}}, r"inner\.sise: unknown key; allowed: scale, size"),
        ({"inner": {}}, r"inner\.size: missing"),
        ({"inner": {"size": "2"}}, r"inner\.size: expected int, got '2'"),
        ({"inner": {"size": True}}, r"inner\.size: expected int, got True"),
        ({"inner": {"size": 1}, "mode": "c"}, r"mode: 'c' is not allowed; allowed: a, b"),
        ({"inner": {"size": 1}, "names": "x"}, r"names: expected a list, got 'x'"),
        ({"inner": {"size": 1}, "limit": "many"}, r"limit: expected int, got 'many'"),
        ({"inner": {"size": 1}, "limit": -1}, r"limit -1 is negative"),
        ({"inner": {"size": 1}, "colour": "blue"}, r"colour: 'blue' is not allowed; allowed: red"),
        ({"inner": 3}, r"inner: expected a mapping, got 3"),
    ],
)
def test_refuses_what_is_not_declared(values: dict[str, object], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        build(Outer, values)
