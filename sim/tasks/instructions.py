"""Wording of tasks: natural names of objects and sentence templates per task family.

Names are what people say ("the coffee table", not `CoffeeTable_1`). Where a scene holds several things of one type, furniture
is counted ("the second cabinet", by its id) and small objects are told apart by where they stand ("the mug from the side
table"), so that an instruction always means exactly one object. The same wording tells where to look for an object that is
out of sight at the start. Paper: natural-language instructions of the DualTHOR tasks.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np

_SPECIAL: Final[Mapping[str, str]] = {
    "TVStand": "TV stand",
    "Television": "TV",
    "CellPhone": "phone",
    "CounterTop": "counter",
    "HousePlant": "plant",
    "RemoteControl": "remote control",
    "GarbageCan": "garbage can",
    "StoveKnob": "stove knob",
    "PaperTowelRoll": "paper towel roll",
    "SinkBasin": "sink",
    "WineBottle": "wine bottle",
}
#: How furniture of one type is counted.
ORDINALS: Final = ("first", "second", "third", "fourth", "fifth", "sixth", "seventh", "eighth", "ninth")

_ENCLOSING: Final = frozenset(
    (
        "BathtubBasin",
        "Box",
        "Bowl",
        "Cabinet",
        "Cup",
        "Drawer",
        "Fridge",
        "GarbageCan",
        "LaundryHamper",
        "Microwave",
        "Mug",
        "Pot",
        "SinkBasin",
    )
)

#: Sentence templates by family. Slots: a, b objects; r, s receptacles; pr, ps their prepositions (`on` or `in`).
TEMPLATES: Final[Mapping[str, tuple[str, ...]]] = {
    "pick": (
        "Pick up {a}.",
        "Take {a} in your hand.",
        "Grab {a}.",
        "Please get hold of {a}.",
        "I need {a}, pick it up.",
        "Go and get {a}.",
    ),
    "place": (
        "Put {a} {pr} {r}.",
        "Move {a} to {r}.",
        "Bring {a} over and set it {pr} {r}.",
        "{a} belongs {pr} {r}, please put it there.",
        "Place {a} {pr} {r}.",
        "Fetch {a} and put it {pr} {r}.",
    ),
    "open": (
        "Open {a}.",
        "Please open {a}.",
        "Leave {a} open.",
        "Go to {a} and open it.",
        "{a} should be open.",
    ),
    "close": (
        "Close {a}.",
        "Please shut {a}.",
        "Make sure {a} is closed.",
        "Go to {a} and close it.",
        "{a} should not stay open.",
    ),
    "toggle_on": (
        "Turn on {a}.",
        "Switch {a} on.",
        "Please turn {a} on.",
        "{a} should be running, switch it on.",
        "Go to {a} and turn it on.",
    ),
    "toggle_off": (
        "Turn off {a}.",
        "Switch {a} off.",
        "Please turn {a} off.",
        "{a} should be off.",
        "Go to {a} and turn it off.",
    ),
    "transport_two": (
        "Put {a} and {b} {pr} {r}.",
        "Move both {a} and {b} to {r}.",
        "Bring {a} and {b} over and set them {pr} {r}.",
        "{a} and {b} belong {pr} {r}.",
        "Place {a} together with {b} {pr} {r}.",
    ),
    "transport_each": (
        "Put {a} {pr} {r} and {b} {ps} {s}.",
        "Move {a} to {r} and {b} to {s}.",
        "{a} goes {pr} {r}, {b} goes {ps} {s}.",
        "Place {a} {pr} {r}, then place {b} {ps} {s}.",
        "Bring {a} to {r} and {b} to {s}.",
    ),
    "pick_and_toggle_on": (
        "Pick up {a} and turn on {b}.",
        "Turn on {b} and take {a} in your hand.",
        "Grab {a} while switching {b} on.",
        "Switch on {b} and pick up {a}.",
    ),
    "pick_and_toggle_off": (
        "Pick up {a} and turn off {b}.",
        "Turn off {b} and take {a} in your hand.",
        "Grab {a} while switching {b} off.",
        "Switch off {b} and pick up {a}.",
    ),
    "pick_and_open": (
        "Pick up {a} and open {b}.",
        "Open {b} and take {a} in your hand.",
        "Grab {a} and leave {b} open.",
        "Have {a} in your hand and {b} open.",
    ),
    "place_any": (
        "Put {n} {pr} {r}.",
        "Bring {n} to {r}.",
        "There should be {n} {pr} {r}.",
        "Place {n} {pr} {r}, any one will do.",
        "Get {n} from somewhere and set it {pr} {r}.",
    ),
    "transport_any_two": (
        "Put {n} {pr} {r}.",
        "Bring {n} to {r}.",
        "There should be {n} {pr} {r}.",
        "Place {n} {pr} {r}, any of them will do.",
    ),
    "fill": (
        "Fill {a} with water.",
        "Fill {a} at {r}.",
        "Put some water in {a}.",
        "{a} should be full of water.",
        "Take {a} to {r} and fill it.",
    ),
    "slice": (
        "Slice {a} with {b}.",
        "Cut {a} with {b}.",
        "Take {b} and slice {a}.",
        "Use {b} to cut {a} into slices.",
    ),
    "clean": (
        "Clean {a} with {b}.",
        "{a} is dirty, wipe it with {b}.",
        "Take {b} and clean {a}.",
        "Use {b} to get {a} clean.",
    ),
    "cook": (
        "Cook {a} in {r}.",
        "Heat {a} in {r} until it is done.",
        "Put {a} in {r} and cook it.",
        "Use {r} to cook {a}.",
    ),
    "use_up": (
        "Use up {a}.",
        "Take all that is left of {a}.",
        "Finish {a}.",
        "Nothing of {a} should be left, use it up.",
    ),
    "fetch_two": (
        "Take {a} and {b} out of {s} and put them {pr} {r}.",
        "Get {a} and {b} from {s} and set them {pr} {r}.",
        "{a} and {b} are in {s}, move them to {r}.",
        "Fetch {a} and {b} from inside {s} and place both {pr} {r}.",
    ),
    "stow_two": (
        "Put {a} and {b} in {r}, which is closed.",
        "Open {r} and put {a} and {b} in it.",
        "Stow {a} and {b} inside {r}.",
        "{a} and {b} belong inside {r}, put them there.",
    ),
    "stow_two_close": (
        "Put {a} and {b} in {r} and close it.",
        "Stow {a} and {b} inside {r} and shut it again.",
        "Store {a} and {b} in {r}, then close {r}.",
        "{a} and {b} belong inside {r}, put them there and leave {r} closed.",
    ),
    "set_three": (
        "Put {a}, {b} and {c} {pr} {r}.",
        "Bring {a}, {b} and {c} to {r}.",
        "{a}, {b} and {c} belong {pr} {r}.",
        "Set out {a}, {b} and {c} {pr} {r}.",
    ),
    "tidy_three": (
        "Tidy up: {a} and {b} go {pr} {r}, {c} goes {ps} {s}.",
        "Put {a} and {b} {pr} {r}, and {c} {ps} {s}.",
        "{a} and {b} belong {pr} {r}, {c} belongs {ps} {s}.",
        "Bring {a} and {b} to {r} and {c} to {s}.",
    ),
    "carry_level": (
        "Carry {a} to {r} without spilling.",
        "{a} is full, set it down {pr} {r} and spill nothing.",
        "Move {a} to {r} with both hands and keep it level.",
        "Put the full pot, {a}, {pr} {r} without losing its water.",
    ),
    "store_ajar": (
        "Put {a} in {r}, which falls shut when nothing holds it open.",
        "Hold {r} open with one hand and put {a} in it, then let it fall shut.",
        "{r} closes by itself: keep it open while you put {a} inside.",
        "Store {a} in {r}; it does not stay open by itself, and should be closed afterwards.",
    ),
    "fetch_ajar": (
        "Take {a} out of {s}, which falls shut when nothing holds it open.",
        "Hold {s} open with one hand, take {a} out, then let it fall shut.",
        "{s} closes by itself: keep it open while you take {a} out.",
        "Get {a} from {s}; it does not stay open by itself, and should be closed afterwards.",
    ),
    "slice_steady": (
        "Slice {a} with {b}.",
        "Hold {a} with one hand and cut it with {b}.",
        "Cut {a} with {b}, it rolls away unless you hold it.",
        "Use {b} to slice {a} while the other hand keeps it still.",
    ),
    "clean_steady": (
        "Clean {a} with {b}.",
        "Hold {a} with one hand and wipe it with {b}.",
        "{a} is dirty, wipe it with {b} and hold it still meanwhile.",
        "Use {b} to clean {a} while the other hand keeps it still.",
    ),
    "pour_hold": (
        "Fill {a} from {b}, then have both in your hands.",
        "Pour from {b} into {a} and hold both of them at the end.",
        "Take {b}, fill {a} from it, and take {a} in the other hand.",
        "Have {a}, filled from {b}, in one hand and {b} in the other.",
    ),
    "toggle_both": (
        "Turn {on} {a} and {b}.",
        "Switch {on} both {a} and {b}.",
        "Make sure that {a} and {b} are {on}.",
        "Please turn {a} {on}, and {b} too.",
    ),
    "fetch": (
        "Take {a} out of {s} and put it {pr} {r}.",
        "Get {a} from {s} and set it {pr} {r}.",
        "{a} is in {s}, move it to {r}.",
        "Fetch {a} from inside {s} and place it {pr} {r}.",
    ),
    "fetch_hold": (
        "Take {a} out of {s}.",
        "Get {a} from {s}.",
        "{a} is in {s}, pick it up.",
        "Fetch {a} from inside {s}.",
    ),
    "stow": (
        "Put {a} in {r}, which is closed.",
        "Open {r} and put {a} in it.",
        "Stow {a} inside {r}.",
        "{a} belongs inside {r}, put it there.",
    ),
    "stow_close": (
        "Put {a} in {r} and close it.",
        "Stow {a} inside {r} and shut it again.",
        "Store {a} in {r}, then close {r}.",
        "{a} belongs inside {r}, put it there and leave {r} closed.",
    ),
    "lift": (
        "Lift {a}.",
        "Lift {a} with both hands.",
        "Pick up {a} using two hands.",
        "Hold {a} up with both hands.",
        "Raise {a}, it takes two hands.",
    ),
    "carry": (
        "Carry {a} to {r}.",
        "Put {a} {pr} {r}, it takes both hands.",
        "Lift {a} and set it down {pr} {r}.",
        "Move {a} onto {r} with both hands.",
        "{a} should stand {pr} {r}.",
    ),
    "hold_two": (
        "Hold {a} and {b} at the same time.",
        "Take {a} in one hand and {b} in the other.",
        "Pick up both {a} and {b} and keep them in your hands.",
        "Have {a} and {b} in your hands.",
    ),
    "carry_and_toggle": (
        "Carry {a} to {r} and turn on {b}.",
        "Turn on {b} and move {a} to {r} with both hands.",
        "Set {a} down {pr} {r}, and switch {b} on.",
        "Put {a} {pr} {r} and make sure that {b} is on.",
    ),
    "carry_and_place": (
        "Carry {a} to {r} and put {b} {ps} {s}.",
        "Put {b} {ps} {s}, and move {a} to {r} with both hands.",
        "Set {a} down {pr} {r}, and place {b} {ps} {s}.",
        "{a} goes {pr} {r}, {b} goes {ps} {s}.",
    ),
}


def natural_name(object_type: str) -> str:
    """What people call a type: `CoffeeTable` is `coffee table`."""
    if object_type in _SPECIAL:
        return _SPECIAL[object_type]
    return re.sub(r"(?<=[a-z])(?=[A-Z])", " ", object_type).lower()


def plural(object_type: str, count: int) -> str:
    """So many objects of a type, none of them in particular: `a mug`, `two mugs`."""
    name = natural_name(object_type)
    if count == 1:
        return f"{'an' if name[0] in 'aeiou' else 'a'} {name}"
    ending = "es" if name.endswith(("s", "x", "ch", "sh", "o")) else "s"
    if name.endswith("knife"):
        name, ending = name[:-2], "ves"
    return f"{('two', 'three', 'four')[count - 2]} {name}{ending}"


def preposition(object_id: str) -> str:
    """`in` for receptacles that enclose, `on` for those that carry."""
    return "in" if object_id.rsplit("_", 1)[0] in _ENCLOSING else "on"


def phrase(object_id: str, scene: Mapping[str, str | None], furniture: frozenset[str], located: bool = False) -> str:
    """A noun phrase with article that means one object of a scene.

    Args:
        object_id: the object.
        scene: for every object of the scene, the id of what carries it (None for furniture).
        furniture: ids of the room's own objects.
        located: whether the phrase says where a movable object is even when its name alone is unique.

    Raises:
        KeyError: when the scene does not hold the object.
    """
    if object_id not in scene:
        raise KeyError(f"{object_id!r} is not in the scene; it has {', '.join(sorted(scene))}")
    object_type, number = object_id.rsplit("_", 1)
    name = natural_name(object_type)
    same = [other for other in scene if other.rsplit("_", 1)[0] == object_type]
    carrier = scene[object_id]
    movable = object_id not in furniture and carrier is not None
    place = f" from {phrase(carrier, scene, furniture)}" if movable and carrier is not None else ""
    if len(same) == 1:
        return f"the {name}{place if located else ''}"
    if movable and [scene[other] for other in same].count(carrier) == 1:
        return f"the {name}{place}"
    rank = int(number) - 1
    ordinal = ORDINALS[rank] if rank < len(ORDINALS) else number
    return f"the {ordinal} {name}{place if located else ''}"


def wordings(family: str, slots: Mapping[str, str]) -> tuple[str, ...]:
    """Every sentence of a family with its slots filled, in template order.

    Raises:
        KeyError: on an unknown family or a missing slot.
    """
    if family not in TEMPLATES:
        raise KeyError(f"unknown family {family!r}; allowed: {', '.join(TEMPLATES)}")
    sentences = [template.format(**slots) for template in TEMPLATES[family]]
    return tuple(sentence[0].upper() + sentence[1:] for sentence in sentences)


def shuffled(sentences: Sequence[str], rng: np.random.Generator) -> tuple[str, ...]:
    """The sentences in random order."""
    return tuple(sentences[int(index)] for index in rng.permutation(len(sentences)))
