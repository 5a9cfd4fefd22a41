"""The words between the things of an instruction: idioms become verbs, things that are named together become groups.

`put <0> and <1> on <2> , which is closed` becomes `put <0+1> on <2>`. What is said beside, such as that both hands are needed
or that a door falls shut, is taken out of the text and kept as a fact. Paper: not in it; part of a reference planner.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

from proprio_mllm.planners.furniture import CONTAINERS
from proprio_mllm.planners.scripted.words import Mention

#: Vessels that one pours from.
_POURERS: Final = ("bottle", "winebottle", "kettle", "wateringcan", "jug", "pitcher")
#: Verbs by the kind of goal that they ask for.
_VERBS: Final[Mapping[str, tuple[str, ...]]] = {
    "held": ("pick", "take", "grab", "get", "fetch", "have", "hold", "keep", "need", "grasp", "find"),
    "on": (
        "put", "place", "set", "move", "bring", "carry", "stow", "store", "goes", "go", "belong", "belongs", "stand", "stands",
        "transport", "deliver", "lay", "return", "tidy", "lies", "rest",
    ),
    "lifted": ("lift", "raise"),
    "open": ("open",),
    "closed": ("close", "shut"),
    "toggled_on": ("turnon",),
    "toggled_off": ("turnoff",),
    "sliced": ("slice", "cut", "chop"),
    "clean": ("clean", "wipe", "wash", "rinse"),
    "cooked": ("cook", "heat"),
    "filled": ("fill", "pour"),
    "used_up": ("useup",),
    "state": ("is", "are"),
}  # fmt: skip
#: Kind of goal by verb.
KIND_OF: Final = {verb: kind for kind, verbs in _VERBS.items() for verb in verbs}
#: Verbs whose things come before them.
_OF_SUBJECT: Final = frozenset(("goes", "go", "belong", "belongs", "stand", "stands", "lies", "rest", "be", "is", "are"))
#: Prepositions of where something goes.
INTO: Final = frozenset(("on", "in", "onto", "into", "inside", "to"))
PREPOSITIONS: Final = INTO | {"at", "with", "using", "from"}
_GROUP: Final = r"<[\d+]+>"
_HANDS: Final = r"(?:in|with) (?:your|one|the other|each|either|both|a|my)(?: of your)? hands?|in the other|at the same time"
_AJAR: Final = r"falls? shut|(?:closes|shuts) by itself|not stay open by itself"
_LEVEL: Final = r"without spilling|(?:and )?spill nothing|(?:and )?keep it level|without losing its water"
_TWO_HANDS: Final = r"(?:with|using|it takes|it needs|takes|needs) (?:both|two) hands"
#: Idioms and what they are read as, in this order.
_IDIOMS: Final[tuple[tuple[str, str], ...]] = (
    (r"\bpick(?:ing)? up\b|\bget hold of\b", "take"),
    (r"\btake all that is left of\b|\buse up\b|\bfinish\b", "useup"),
    (rf"nothing of ({_GROUP}) should be left", r"useup \1"),
    (r"\b(?:turn|switch)(?:ing)? (on|off)\b", r"turn\1"),
    (rf"\b(?:turn|switch)(?:ing)? ((?:both )?(?:{_GROUP}|it|them)) (on|off)\b", r"turn\2 \1"),
    (r"\bset out\b|\bset up\b", "set"),
    (rf"\bput (?:some )?water (?:in|into) ({_GROUP})", r"fill \1"),
    (rf"({_GROUP}) should be full(?: of water)?", r"fill \1"),
    (rf"\bget ({_GROUP}) clean", r"clean \1"),
    (rf"\buse ({_GROUP}) to (?:cook|heat) ({_GROUP})", r"cook \2 in \1"),
    (rf"\buse ({_GROUP}) to\b", r"with \1 ,"),
    (r"\bis (?:dirty|full)\b|\binto slices\b|\buntil it is done\b", ""),
    (r"\bit rolls away unless you hold it|while the other hand keeps it still|and hold it still(?: meanwhile)?", ""),
    (r"\bthere should be\b", "put"),
    (rf"({_GROUP}) (?:should|must) (?:be|stand|go|lie) (?=(?:on|in|inside) <)", r"\1 belongs "),
    (rf"({_GROUP}) (?:should|must) not (?:stay|be|stand) open", r"close \1"),
    (rf"({_GROUP}) (?:should |must )?(?:(?:be|is|are|stays?) )?open\b", r"open \1"),
    (rf"({_GROUP}) (?:should |must )?(?:(?:be|is|are|stays?) )?(?:closed|shut)\b", r"close \1"),
    (rf"({_GROUP}) (?:should |must )?(?:be|is|are|stays?) (?:on(?! <)|running)", r"turnon \1"),
    (rf"({_GROUP}) (?:should |must )?(?:be|is|are|stays?) off\b", r"turnoff \1"),
)


@dataclass(frozen=True, slots=True)
class Sentence:
    """An instruction, prepared for reading its verbs.

    Attributes:
        text: words, and marks like `<0>` and `<0+1>` for things.
        mentions: the things; those that are said to be somewhere know where.
        door: what falls shut by itself, where the sentence is about holding that open.
        ajar: whether something falls shut by itself.
        level: whether nothing may be spilled.
        heavy: whether both hands are asked for.
        in_hands: whether something shall be in the hands.
    """

    text: str
    mentions: tuple[Mention, ...]
    door: Mention | None
    ajar: bool
    level: bool
    heavy: bool
    in_hands: bool


def read_sentence(text: str, mentions: Sequence[Mention]) -> Sentence:
    """Prepares what `find_mentions` gives."""
    text = re.sub(r"[.:]", " ,", text)
    ajar, heavy = re.search(_AJAR, text) is not None, re.search(_TWO_HANDS, text) is not None
    level, in_hands = re.search(_LEVEL, text) is not None, re.search(_HANDS + r"|hold both", text) is not None
    located = list(mentions)
    text = _located(text, located)
    door: Mention | None = None
    if ajar:
        text, door = _without_door(text, located)
    text = re.sub(r",? which (?:is|are|falls|does) [^,;]*", " ", text)
    text = re.sub(f"{_LEVEL}|{_TWO_HANDS}", " ", text)
    for _ in range(2):
        text = _grouped(text)
        for pattern, reading in _IDIOMS:
            text = re.sub(pattern, reading, _tidy(text))
        text = re.sub(_HANDS, " ", text)
    return Sentence(_tidy(text), tuple(located), door, ajar, level, heavy, in_hands)


def _located(text: str, mentions: list[Mention]) -> str:
    """Takes `from the side table` into the phrase before it; vessels that are poured from are no places."""
    pouring = re.search(r"\b(?:fill|filled|pour)\b", text) is not None
    pattern = re.compile(
        r"(?:<(\d+)> and )?<(\d+)> (?:from inside|out of|from|inside of|(?:that|which) (?:is|are) (?:on|in|at|inside)) <(\d+)>"
    )
    at = 0
    while match := pattern.search(text, at):
        before, obj, place = match[1], int(match[2]), int(match[3])
        if pouring and mentions[place].name in _POURERS:
            at = match.end(2)
            continue
        mentions[obj] = replace(mentions[obj], place=mentions[place])
        # what is shut away is said of both; what stands somewhere, of the last thing alone
        if before is not None and mentions[place].name in CONTAINERS and mentions[int(before)].place is None:
            mentions[int(before)] = replace(mentions[int(before)], place=mentions[place])
        text = f"{text[: match.start(2) - 1]}<{obj}>{text[match.end() :]}"
    return text


def _without_door(text: str, mentions: Sequence[Mention]) -> tuple[str, Mention | None]:
    """Takes out what is said about a door that falls shut, and gives the door where it is held open."""
    door = re.search(r"hold <(\d+)> open|<(\d+)> (?:closes|shuts) by itself", text)
    for pattern in (
        r"hold <\d+> open (?:with one hand )?(?:and|,)",
        r"<\d+> (?:closes|shuts) by itself",
        r"keep it open while you",
        r",? ?then let it fall shut",
        r"[;,]? it does not stay open by itself ,? ?and should be closed afterwards",
    ):
        text = re.sub(pattern, " ", text)
    return text, None if door is None else mentions[int(door[1] or door[2])]


def _grouped(text: str) -> str:
    """Joins what is named together before a verb takes it; what a preposition goes before stands alone."""
    text = _tidy(text)
    pattern = re.compile(r"<([\d+]+)>(?: ,)?(?: and| together with| as well as|(?<=,)) <([\d+]+)>")
    at = 0
    while match := pattern.search(text, at):
        before = text[: match.start()].split()
        after = text[match.end() :].split()
        subject = match[0].count(",") and after[:1] and after[0] in _OF_SUBJECT and any(word in KIND_OF for word in before)
        if (before and before[-1] in PREPOSITIONS) or subject:
            at = match.start() + 1
            continue
        text = f"{text[: match.start()]}<{match[1]}+{match[2]}>{text[match.end() :]}"
    return text


def _tidy(text: str) -> str:
    return " ".join(text.replace(",", " , ").replace(";", " ; ").split())
