"""Steps of the expert's logs as planning exercises in text alone, with names exchanged among equals.

What to do next follows mostly from the instruction, the log and the names, and a model without pretraining has to learn that
from a few thousand logged steps, far too few to tell one name from another. An exercise is a logged step in which object types
change places with types that are used alike (a mug with a book, a desk with a shelf), in the instruction, the ids, the log and
the answer. The picture would no longer agree, so exercises have none, and steps that depend on where things are (heights,
turns, chosen distances) are left out.

The paper starts from a language model that can read; this is part of what stands in for its pretraining.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np

__all__ = ["GROUPS", "OBJECT_ID", "Exchange", "is_symbolic"]

#: Object types that tasks use alike, with the words that instructions use for them.
GROUPS: Final[tuple[Mapping[str, str], ...]] = (
    {
        "Mug": "mug", "Cup": "cup", "Bowl": "bowl", "Bottle": "bottle", "Apple": "apple", "Tomato": "tomato", "Book": "book",
        "SaltShaker": "salt shaker", "PepperShaker": "pepper shaker", "PaperTowelRoll": "paper towel roll",
        "SoapBottle": "soap bottle", "RemoteControl": "remote control", "TissueBox": "tissue box",
    },
    {
        "CounterTop": "counter", "DiningTable": "dining table", "CoffeeTable": "coffee table", "SideTable": "side table",
        "Desk": "desk", "Dresser": "dresser", "Shelf": "shelf",
    },
    {"Box": "box", "HousePlant": "plant", "Pot": "pot"},
    {"Fridge": "fridge", "Cabinet": "cabinet", "Drawer": "drawer"},
    {
        "StoveKnob": "stove knob", "FloorLamp": "floor lamp", "LightSwitch": "light switch", "Faucet": "faucet",
        "Television": "TV",
    },
)  # fmt: skip
#: An object id: its type and number.
OBJECT_ID: Final = re.compile(r"([A-Z][A-Za-z]*)_(\d+)")
#: Longer names first: a soap bottle is no bottle.
_WORDS: Final = sorted((word for group in GROUPS for word in group.values()), key=len, reverse=True)
_WORD: Final = re.compile(r"\b(" + "|".join(_WORDS) + r")\b(?! stand)")
_POSED: Final = re.compile(r"\b(Move|Rotate)|GoTo\([^)]*,")


def is_symbolic(step: str) -> bool:
    """Whether a plan step follows from words: no height, no turn, no chosen distance or bearing."""
    return _POSED.search(step) is None


class Exchange:
    """A one-to-one exchange of type names inside each group."""

    def __init__(self, types: Mapping[str, str]) -> None:
        """Takes the new type of each type; the words follow."""
        self._types = dict(types)
        words = {name: word for group in GROUPS for name, word in group.items()}
        self._words = {words[old]: words[new] for old, new in types.items()}

    @staticmethod
    def draw(rng: np.random.Generator) -> Exchange:
        """A random exchange."""
        types: dict[str, str] = {}
        for group in GROUPS:
            names = list(group)
            types |= {name: names[i] for name, i in zip(names, rng.permutation(len(names)), strict=True)}
        return Exchange(types)

    def ids(self, text: str) -> str:
        """A text with object ids, their types exchanged."""
        return OBJECT_ID.sub(lambda match: f"{self._types.get(match[1], match[1])}_{match[2]}", text)

    def words(self, text: str) -> str:
        """An instruction with its names exchanged."""
        return _WORD.sub(lambda match: self._words[match[1]], text)

    def row(self, row: Mapping[str, Any]) -> dict[str, Any]:
        """The text columns of a `demos` row with all names exchanged."""
        names: Sequence[str] = ("visible", "known")
        return {
            **row,
            **{name: [self.ids(item) for item in row[name]] for name in names},
            "instruction": self.words(row["instruction"]),
            "history": [{"step": self.ids(h["step"]), "feedback": self.ids(h["feedback"])} for h in row["history"]],
            "target": self.ids(row["target"]),
        }
