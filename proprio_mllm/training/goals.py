"""Goals in words: the verbs of an instruction, hindsight relabelling that keeps them, and replies to self-asked questions.

SELU (stage 3) judges an instruction by its words alone. When the critic says that it was not completed, it asks itself which
objects *are* in the state that the verb aims at, and the instruction is rewritten with the same verb and that object. All of it
here is text: no simulator state is read. The sentences and the set of verbs are ours; the paper gives the principle.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

_OBJECT_ID = re.compile(r"^[A-Za-z][A-Za-z0-9]{0,39}_[1-9][0-9]?$")
_WORDS = re.compile(r"[A-Z]+(?=[A-Z][a-z])|[A-Z]?[a-z]+|[A-Z]+|[0-9]+")
_ENCLOSING: Final = frozenset(
    ("Box", "Bowl", "Cabinet", "Cup", "Drawer", "Fridge", "GarbageCan", "LaundryHamper", "Microwave", "Mug", "Pot", "SinkBasin")
)


@dataclass(frozen=True, slots=True)
class Verb:
    """One verb.

    Attributes:
        name: its key in `VERBS`.
        pattern: what shows it in an instruction.
        relation: the state it aims at, as `prompts.self_ask_prompt` takes it; `{}` stands for a receptacle.
        sentence: instruction with this verb; slots a (object), pr (preposition), r (receptacle).
    """

    name: str
    pattern: re.Pattern[str]
    relation: str
    sentence: str


def _verb(name: str, pattern: str, relation: str, sentence: str) -> Verb:
    return Verb(name, re.compile(pattern, re.IGNORECASE), relation, sentence)


#: Verbs by name. An instruction may have several (one per sub-goal); what is cooked a log does not tell, so none asks for it.
VERBS: Final[Mapping[str, Verb]] = {
    verb.name: verb
    for verb in (
        _verb(
            "place",
            r"\b(put(?! some water)|place|move|bring|carry|set|stand|belongs?|goes?|stow|store)\b|\bthere should be\b",
            "on {}",
            "Put {a} {pr} {r}.",
        ),
        _verb("lift", r"\blift\b|\b(both|two) hands\b", "lifted", "Lift {a}."),
        _verb(
            "turn_on",
            r"\b(turn|turning|switch|switching)\b.*?\bon\b|\brunning\b|\bsure that\b.*?\bon\b",
            "switched on",
            "Turn on {a}.",
        ),
        _verb(
            "turn_off",
            r"\b(turn|turning|switch|switching)\b.*?\boff\b|\bshould be off\b|\bsure that\b.*?\boff\b",
            "switched off",
            "Turn off {a}.",
        ),
        _verb("close", r"\b(close|closes|shut|closed)\b|\bnot stay open\b", "closed", "Close {a}."),
        _verb("slice", r"\b(slice|cut)\b", "sliced", "Slice {a}."),
        _verb("clean", r"\b(clean|wipe)\b", "clean", "Clean {a}."),
        _verb("fill", r"\b(fill|filled|pour)\b|\bput some water\b|\bfull of water\b", "filled", "Fill {a}."),
        _verb("use_up", r"\buse( it)? up\b|\bfinish\b|\ball that is left\b", "used up", "Use up {a}."),
        _verb("open", r"(?<!not stay )\bopen\b", "open", "Open {a}."),
        _verb("pick", r"\b(pick|take|grab|get|hold|keep|fetch|in your hands?)\b", "held", "Pick up {a}."),
    )
}
#: Verbs that are only means when the first one is there: opening a fridge to put something in, picking to place.
_MEANS: Final = (
    ("place", "open"),
    ("place", "pick"),
    ("place", "lift"),
    ("lift", "pick"),
    ("close", "open"),
    *((work, "pick") for work in ("slice", "clean", "fill", "use_up")),
)


def verbs_of(instruction: str) -> tuple[str, ...]:
    """Names of the verbs that an instruction aims at, in the order of `VERBS`; empty when it shows none."""
    text = instruction.replace(", which is closed", "")
    found = [name for name, verb in VERBS.items() if verb.pattern.search(text)]
    if re.search(r"\bset (both )?hands\b", text):  # the word showed placing
        found.remove("place")
    for strong, means in _MEANS:
        if strong in found and means in found:
            found.remove(means)
    return tuple(found)


def natural_name(object_id: str) -> str:
    """`CoffeeTable_1` as `the coffee table`."""
    return f"the {type_words(object_id.rpartition('_')[0])}"


def type_words(object_type: str) -> str:
    """`CoffeeTable` as `coffee table`."""
    words = _WORDS.findall(object_type)
    return " ".join(word if word.isupper() and len(word) > 1 else word.lower() for word in words)


def parse_ids(reply: str, inventory: Sequence[str]) -> tuple[str, ...]:
    """Object ids of a self-asked reply, in order and without repeats.

    What is not an id, or not in the inventory, is dropped: the critic may imagine objects, the relabelled goal must not.
    """
    allowed = set(inventory)
    found = [part.strip().rstrip(".") for part in reply.split(",")]
    return tuple(dict.fromkeys(name for name in found if _OBJECT_ID.match(name) and name in allowed))


@dataclass(frozen=True, slots=True)
class Relabel:
    """A rewritten goal: its sentence, its verbs with the objects found for them, and what was asked and answered."""

    goal: str
    parts: tuple[tuple[str, str, str], ...]
    asked: tuple[tuple[str, str], ...]


def relabel(
    instruction: str, inventory: Sequence[str], receptacles: Sequence[str], ask: Callable[[str], str], avoid: Sequence[str] = ()
) -> Relabel | None:
    """Hindsight: the same verbs with objects for which they came true.

    Args:
        instruction: the goal that was judged not completed.
        inventory: ids known to the robot.
        receptacles: ids that the robot tried to place something on or in, newest first; only these are asked about.
        ask: answers a relation (`open`, `on Table_1`) with ids, `prompts.answers` format.
        avoid: goals that must not come out, such as the original one.

    Returns:
        The goal, or None when no verb found an object whose type is unique in the inventory.
    """
    parts: list[tuple[str, str, str]] = []
    sentences: list[str] = []
    asked: list[tuple[str, str]] = []
    for name in verbs_of(instruction):
        verb = VERBS[name]
        places = [place for place in receptacles if place in inventory] if "{}" in verb.relation else [""]
        for place in places:
            relation = verb.relation.format(place)
            reply = ask(relation)
            asked.append((relation, reply))
            objs = [obj for obj in parse_ids(reply, inventory) if _unique(obj, inventory) and obj != place]
            if not objs or (place and not _unique(place, inventory)):
                continue
            preposition = "in" if place.rpartition("_")[0] in _ENCLOSING else "on"
            slots = {"a": natural_name(objs[0]), "r": natural_name(place) if place else "", "pr": preposition}
            parts.append((name, objs[0], place))
            sentences.append(verb.sentence.format(**slots))
            break
    if not sentences:
        return None
    goal = " and ".join([sentences[0][:-1], *(_lowered(sentence) for sentence in sentences[1:])]) + "."
    return None if goal in avoid else Relabel(goal, tuple(parts), tuple(asked))


def _lowered(sentence: str) -> str:
    return sentence[0].lower() + sentence[1:-1]


def _unique(obj: str, inventory: Sequence[str]) -> bool:
    kind = obj.rpartition("_")[0]
    return sum(name.rpartition("_")[0] == kind for name in set(inventory)) == 1
