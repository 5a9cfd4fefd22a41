"""Ids and steps in plain words, which sentence embeddings know better than the action grammar.

Paper: baselines LLM-Planner and RAP, whose plans and objects are in words to begin with.
"""

from __future__ import annotations

import re
from collections.abc import Iterable

_CAMEL = re.compile(r"(?<=[a-z])(?=[A-Z])|(?<=[A-Z])(?=[A-Z][a-z])")
_NUMBER = re.compile(r"_\d+\b|(?<![A-Za-z])-?\d+(?:\.\d+)?")
_ARM = re.compile(r"(?<=[(,\s])(?:left|right|auto)(?=\s*[,)])")
_OTHER = re.compile(r"[^A-Za-z]+")


def type_words(object_id: str) -> str:
    """The type's name in words: `coffee table` for `CoffeeTable_1`."""
    return _plain(_NUMBER.sub("", object_id))


def step_words(step: str) -> str:
    """A step without arms and amounts: `pick mug and open fridge` for `Pick(left, Mug_1) & Open(right, Fridge_1)`."""
    return _plain(_NUMBER.sub("", _ARM.sub(" ", step)).replace("&", " and "))


def plan_words(steps: Iterable[str]) -> str:
    """Steps in words, one after the other."""
    return ", ".join(step_words(step) for step in steps)


def _plain(text: str) -> str:
    return _OTHER.sub(" ", _CAMEL.sub(" ", text)).strip().lower()
