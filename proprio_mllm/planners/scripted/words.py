"""Noun phrases of an instruction, and the ids that they may mean.

A phrase is an article or number, at most one ordinal, and a name: `the second counter`, `two mugs`, `a red mug`. Names are the
types' names taken apart (`CoffeeTable_1` is a coffee table), plus a short list of household words, so that a thing has a name
before it has been seen. Paper: not in it; part of a reference planner of this project.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Final

#: Longest instruction that is read, characters.
_LONGEST: Final = 2000
_ORDINALS: Final = ("first", "second", "third", "fourth", "fifth", "sixth", "seventh", "eighth", "ninth")
_COUNTS: Final[Mapping[str, int]] = {"a": 1, "an": 1, "one": 1, "any": 1, "some": 1, "two": 2, "three": 3, "four": 4}
_ARTICLES: Final = frozenset(("the", "that", "this", "my", "your", "its", "those", "these", *_COUNTS))
#: Names that differ from the type's own.
_SYNONYMS: Final[Mapping[str, str]] = {
    "tv": "television",
    "phone": "cellphone",
    "counter": "countertop",
    "worktop": "countertop",
    "plant": "houseplant",
    "sink": "sinkbasin",
    "basin": "sinkbasin",
    "bathtub": "bathtubbasin",
    "tap": "faucet",
    "refrigerator": "fridge",
    "couch": "sofa",
    "cupboard": "cabinet",
    "bin": "garbagecan",
    "trash can": "garbagecan",
    "hamper": "laundryhamper",
    "lamp": "desklamp",
    "remote": "remotecontrol",
    "sponge": "dishsponge",
    "towel": "handtowel",
    "bookshelf": "shelf",
    "paper towel": "papertowelroll",
    "burner": "stoveburner",
    "knob": "stoveknob",
    "tissues": "tissuebox",
    "plant pot": "houseplant",
}
#: Household names that are understood before anything of the kind has been seen.
_NAMES: Final = frozenset(
    (
        "alarm clock", "apple", "bathtub basin", "bed", "book", "bottle", "bowl", "box", "bread", "butter knife",
        "cabinet", "cell phone", "chair", "coffee machine", "coffee table", "counter top", "cup", "desk", "desk lamp",
        "dining table", "dish sponge", "drawer", "dresser", "egg", "faucet", "floor lamp", "fork", "fridge",
        "garbage can", "hand towel", "house plant", "kettle", "knife", "ladle", "laptop", "laundry hamper", "lettuce",
        "light switch", "microwave", "mug", "pan", "paper towel roll", "pepper shaker", "pillow", "plate", "pot",
        "potato", "remote control", "salt shaker", "shelf", "side table", "sink basin", "soap bottle", "sofa",
        "spatula", "spoon", "stove burner", "stove knob", "television", "tissue box", "toaster", "toilet",
        "toilet paper", "tomato", "tv stand", "vase", "watering can", "wine bottle",
    )
)  # fmt: skip
#: Words that end a name.
_STOPS: Final = frozenset(
    (
        "a", "an", "the", "and", "or", "to", "on", "in", "into", "onto", "inside", "from", "of", "off", "with",
        "without", "using", "up", "down", "out", "over", "at", "by", "for", "while", "then", "there", "it", "its",
        "them", "is", "are", "be", "being", "should", "must", "goes", "go", "belong", "belongs", "stand", "stands",
        "stay", "stays", "closes", "falls", "fell", "which", "that", "until", "unless", "too", "open", "closed", "shut",
        "filled", "together", "both", "please", "so", "as", "has", "have", "can", "will", "one", "two", "after",
        "before",
    )
)  # fmt: skip
#: What follows an article without being a thing.
_NOT_THINGS: Final = frozenset(
    (
        "hand", "hands", "other", "end", "time", "same", "water", "slices", "slice", "way", "room", "floor", "while",
        "moment", "rest", "lid", "door", "top", "side", "inside", "middle", "task", "instruction", "any", "one", "both",
        "two", "will",
    )
)  # fmt: skip
_TOKEN: Final = re.compile(r"[a-z0-9]+|[,.;:]")


@dataclass(frozen=True, slots=True)
class Mention:
    """A thing that an instruction speaks of.

    Attributes:
        name: its name, lower case without blanks, in the singular (`sidetable`).
        ordinal: number of the id that it names, None without one.
        count: how many are meant.
        definite: whether certain ones are meant (`the`), not just any.
        place: where it is said to be.
    """

    name: str
    ordinal: int | None = None
    count: int = 1
    definite: bool = True
    place: Mention | None = None


def type_of(object_id: str) -> str:
    """The type's name of an id in lower case: `sidetable` for `SideTable_2`."""
    return object_id.rsplit("_", 1)[0].lower()


def candidates(mention: Mention, ids: Iterable[str]) -> list[str]:
    """The ids that a mention may mean, in the order of their numbers.

    A name that is the last word of a longer one means that as well where nothing fits exactly: `the table` a `DiningTable`.
    """
    numbered = sorted(ids, key=_number)
    fitting = [one for one in numbered if type_of(one) == mention.name]
    fitting = fitting or [one for one in numbered if len(mention.name) > 2 and type_of(one).endswith(mention.name)]
    if mention.ordinal is not None:
        return [one for one in fitting if _number(one)[0] == mention.ordinal]
    return fitting


def _number(object_id: str) -> tuple[int, str]:
    ending = object_id.rsplit("_", 1)[-1]
    return (int(ending) if ending.isdecimal() else 0, object_id)


def find_mentions(text: str, ids: Iterable[str]) -> tuple[str, list[Mention]]:
    """Takes the noun phrases out of a sentence.

    Args:
        text: any text; what goes beyond 2000 characters is not read.
        ids: ids whose types are names, too.

    Returns:
        The text in lower case with `<0>`, `<1>` … for its phrases, and the phrases.
    """
    names = _NAMES | {_apart(one) for one in ids}
    words = _TOKEN.findall(text[:_LONGEST].lower())
    mentions: list[Mention] = []
    parts: list[str] = []
    at = 0
    while at < len(words):
        found = _phrase(words, at, names)
        if found is None:
            parts.append(words[at])
            at += 1
            continue
        mention, at = found
        parts.append(f"<{len(mentions)}>")
        mentions.append(mention)
    return " ".join(parts), mentions


def _apart(object_id: str) -> str:
    return re.sub(r"(?<=[a-z])(?=[A-Z])", " ", object_id.rsplit("_", 1)[0]).lower()


def _phrase(words: list[str], at: int, names: frozenset[str]) -> tuple[Mention, int] | None:
    """The noun phrase that starts at a word, and the index behind it."""
    start, article = at, ""
    while at < len(words) and words[at] in _ARTICLES and (not article or words[at] in _COUNTS):
        article, at = words[at], at + 1
    ordinal: int | None = None
    if at < len(words) and words[at] in _ORDINALS:
        ordinal, at = _ORDINALS.index(words[at]) + 1, at + 1
    elif article and at < len(words) and words[at].isdecimal() and len(words[at]) < 4:
        ordinal, at = int(words[at]), at + 1
    if not article and ordinal is None:
        found = _longest(words, start, start + 1, names)
        return None if found is None else (Mention(found[0], definite=False), found[2])
    end = at
    while end < len(words) and words[end] not in _STOPS and words[end][0].isalnum() and end - at < 5:
        end += 1
    count = _COUNTS.get(article, 1)
    found = _longest(words, at, end, names)
    if found is not None:
        return Mention(found[0], ordinal, count, article not in _COUNTS), found[2]
    if end == at or words[at] in _NOT_THINGS or words[at] in _ORDINALS:
        return None
    end = min(end, at + 3)
    return Mention(_singular("".join(words[at:end])), ordinal, count, article not in _COUNTS), end


def _longest(words: list[str], first: int, last: int, names: frozenset[str]) -> tuple[str, int, int] | None:
    """The longest known name that starts in [first, last): name, start and end."""
    best: tuple[str, int, int] | None = None
    for start in range(first, min(last, len(words))):
        for length in (4, 3, 2, 1):
            if start + length > len(words) or (best is not None and length <= best[2] - best[1]):
                continue
            spoken = " ".join(words[start : start + length])
            single = next((form for form in _singulars(spoken) if form in names or form in _SYNONYMS), None)
            if single is not None:
                best = (_SYNONYMS.get(single, single.replace(" ", "")), start, start + length)
                break
    return best


def _singulars(name: str) -> tuple[str, ...]:
    """A name and what it may be the plural of."""
    forms = [name]
    if name.endswith("ves"):
        forms += [f"{name[:-3]}fe", f"{name[:-3]}f"]
    if name.endswith("es"):
        forms.append(name[:-2])
    if name.endswith("s"):
        forms.append(name[:-1])
    return tuple(forms)


def _singular(name: str) -> str:
    return name[:-1] if name.endswith("s") and not name.endswith("ss") else name
