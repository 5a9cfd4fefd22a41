"""Task families: what each one puts into a room and asks for.

Categories follow the paper. `single`: one arm is enough. `optional`: one arm can, two are faster, so that the time limit is
one that only two arms keep. `essential`: one arm cannot: because an object takes two hands, because several things have to be
in the hands at once, because a door falls shut that nothing holds open, or because food rolls away from under the knife. Most
families of two arms are compositions of single-arm ones; `store_ajar`, `fetch_ajar`, `slice_steady`, `clean_steady` and
`carry_level` are designed by hand.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np

from sim.tasks.drafts import Builder, Draft, Scene
from sim.tasks.instructions import plural, preposition
from sim.tasks.predicates import ANY, Predicate

CATEGORIES: Final = ("single", "optional", "essential")

_FOOD_STEADY: Final = ("Bread", "Lettuce")
_FOOD_ROLLING: Final = ("Apple", "Tomato", "Potato")
_COOKABLE: Final = ("Potato", "Bread")
_KNIVES: Final = ("Knife", "ButterKnife")
_WIPERS: Final = ("DishSponge", "HandTowel")
_DISHES_STEADY: Final = ("Mug", "Pan", "Pot")
_DISHES_SLIDING: Final = ("Bowl", "Plate", "Cup")
_VESSELS: Final = ("Mug", "Cup", "Bowl")
_JUGS: Final = ("Bottle", "WineBottle", "Kettle", "WateringCan")
_POURED_INTO: Final = ("Mug", "Cup", "Bowl", "Vase")
_USED_UP: Final = ("PaperTowelRoll", "TissueBox", "ToiletPaper", "SoapBottle")
_LIDDED: Final = ("Laptop", "Book", "Kettle", "Box")
_GADGETS: Final = ("DeskLamp", "CellPhone")
#: Where a third thing finds no place that the shorter robot reaches.
_CROWDED_BY_TWO: Final = ("SideTable", "SinkBasin", "BathtubBasin")
#: What both hands of both robots get into; an open door leaves room for one arm of the shorter robot.
_FOR_BOTH: Final = ("Drawer",)
#: What one hand can hold open while the other reaches inside, on both robots; a held door keeps the smaller one too far away.
_FALLS_SHUT: Final = ("Drawer",)


@dataclass(frozen=True, slots=True)
class Family:
    """A kind of task.

    Attributes:
        category: `single`, `optional` or `essential`.
        build: fills a draft.
        steps: plan steps that it usually takes.
    """

    category: Literal["single", "optional", "essential"]
    build: Callable[[Builder], None]
    steps: int


def family_of(name: str) -> Family:
    """The family of that name.

    Raises:
        KeyError: on an unknown name.
    """
    if name not in FAMILIES:
        raise KeyError(f"unknown family {name!r}; allowed: {', '.join(FAMILIES)}")
    return FAMILIES[name]


def draw(
    family: str, scene: Scene, rng: np.random.Generator, distractors: tuple[int, int] = (1, 4), without: Collection[str] = ()
) -> Draft:
    """Draws a task of a family in a room.

    Args:
        family: a name of `FAMILIES`.
        scene: the room.
        rng: source of randomness.
        distractors: least and greatest number of objects that the task does not need.
        without: types that must not occur.

    Raises:
        NoDraft: when the room lacks what the family needs.
        KeyError: on an unknown family.
    """
    builder = Builder(Draft(family, scene.room), scene, rng, without)
    family_of(family).build(builder)
    builder.add_distractors(int(rng.integers(distractors[0], distractors[1] + 1)))
    return builder.draft


def _located(object_id: str, receptacle: str) -> Predicate:
    return Predicate(preposition(receptacle), object_id, receptacle)  # type: ignore[arg-type]


# ---- one arm


def _pick(b: Builder) -> None:
    a = b.small()
    b.ask(Predicate("held", a), a=a)


def _place(b: Builder) -> None:
    r = b.target()
    a = b.small(r, avoid=(r,))
    b.ask(_located(a, r), a=a, r=r)


def _place_any(b: Builder) -> None:
    r = b.target()
    a = b.small(r, avoid=(r,))
    kind = a.rsplit("_", 1)[0]
    b.add(kind, b.choose([s for s in b.scene.surfaces if s in b.scene.small[kind] and s != r], "second surface"))
    b.draft.words["n"] = plural(kind, 1)
    b.ask(Predicate("exists", object_type=kind, of=(_located(ANY, r),), at_least=1), r=r)


def _openable(b: Builder, is_open: bool) -> str:
    """Furniture with a door, drawer or lid, or a movable thing with a lid."""
    movable = b.unused(b.scene.small, among=_LIDDED) + b.unused(b.scene.big, among=_LIDDED)
    kind = b.choose([*b.scene.containers, *b.scene.lids, *movable], "thing that opens")
    if kind in movable:
        table = b.scene.small if kind in b.scene.small else b.scene.big
        kind = b.add(kind, b.choose([s for s in table[kind] if s in b.scene.surfaces], "surface"))
        b.start(kind, isOpen=is_open)
    else:
        b.draft.states.setdefault(kind, {})["isOpen"] = is_open
    return kind


def _open(b: Builder) -> None:
    a = _openable(b, is_open=False)
    b.small()
    b.ask(Predicate("open", a), a=a)


def _close(b: Builder) -> None:
    a = _openable(b, is_open=True)
    b.small()
    b.ask(Predicate("closed", a), a=a)


def _switchable(b: Builder, on: bool) -> str:
    """A switch of the room, or a lamp or phone that is put there."""
    movable = b.unused(b.scene.small, among=_GADGETS)
    kind = b.choose([*b.scene.switches, *movable], "switch")
    if kind in movable:
        kind = b.add(kind, b.choose([s for s in b.scene.small[kind] if s in b.scene.surfaces], "surface"))
        b.start(kind, isToggled=on)
    else:
        b.draft.states.setdefault(kind, {})["isToggled"] = on
    return kind


def _toggle(on: bool) -> Callable[[Builder], None]:
    def build(b: Builder) -> None:
        a = _switchable(b, on=not on)
        b.small()
        b.ask(Predicate("toggled_on" if on else "toggled_off", a), a=a)

    return build


def _fill(b: Builder) -> None:
    tap = b.choose(tuple(b.scene.basins), "tap with a basin")
    a = b.small(among=_VESSELS)
    b.ask(Predicate("filled", a), a=a, r=b.scene.basins[tap])


def _slice(b: Builder) -> None:
    _ask_sliced(b, _FOOD_STEADY)


def _clean(b: Builder) -> None:
    _ask_clean(b, _DISHES_STEADY)


def _ask_sliced(b: Builder, food: Sequence[str]) -> None:
    a = b.small(among=food)
    knife = b.small(among=_KNIVES)
    b.ask(Predicate("sliced", a), a=a, b=knife)


def _ask_clean(b: Builder, dishes: Sequence[str]) -> None:
    a = b.small(among=dishes)
    sponge = b.small(among=_WIPERS)
    b.start(a, isDirty=True)
    b.ask(Predicate("clean", a), a=a, b=sponge)


def _cook(b: Builder) -> None:
    heater = b.choose([place for place in b.scene.heaters if place in b.scene.containers], "microwave")
    b.draft.states[heater] = {"isOpen": True}
    a = b.small(heater, among=_COOKABLE)
    b.ask(Predicate("and", of=(_located(a, heater), Predicate("cooked", a))), a=a, r=heater)


def _use_up(b: Builder) -> None:
    a = b.small(among=_USED_UP)
    b.ask(Predicate("used_up", a), a=a)


# ---- two arms are faster


def _transport_two(b: Builder) -> None:
    r = b.target(roomy=True)
    a = b.small(r, avoid=(r,))
    # Half of the time both stand together, so that both hands can reach at once.
    c = b.near(a, r) if b.rng.random() < 0.5 else b.small(r, avoid=(r,))
    b.ask(_located(a, r), _located(c, r), a=a, b=c, r=r)


def _transport_any_two(b: Builder) -> None:
    r = b.target(roomy=True)
    a = b.small(r, avoid=(r,))
    kind = a.rsplit("_", 1)[0]
    for _ in range(2):
        b.add(kind, b.choose([s for s in b.scene.surfaces if s in b.scene.small[kind] and s != r], "second surface"))
    b.draft.words["n"] = plural(kind, 2)
    b.ask(Predicate("exists", object_type=kind, of=(_located(ANY, r),), at_least=2), r=r)


def _transport_each(b: Builder) -> None:
    r = b.target()
    s = b.target(r)
    a = b.small(r, avoid=(r, s))
    c = b.near(a, s)  # taken from two places and put on two others, they would be no faster with two arms
    b.draft.beside[c] = a
    b.ask(_located(a, r), _located(c, s), a=a, b=c, r=r, s=s)


def _pick_and_toggle(on: bool) -> Callable[[Builder], None]:
    def build(b: Builder) -> None:
        lamps = b.unused(b.scene.small, among=("DeskLamp",))
        if lamps and b.rng.random() < 0.5:
            switch = b.small(among=lamps)
            b.start(switch, isToggled=not on)
            place = b.draft.objects[switch]
        else:
            switch, place = b.pair(b.scene.switches, b.scene.surfaces, "switch beside a surface")
            b.draft.states.setdefault(switch, {})["isToggled"] = not on
        a = b.small(at=place)
        b.draft.beside[a] = switch
        b.ask(Predicate("held", a), Predicate("toggled_on" if on else "toggled_off", switch), a=a, b=switch)

    return build


def _pick_and_open(b: Builder) -> None:
    c, place = b.pair(b.scene.containers, b.scene.surfaces, "container beside a surface")
    b.draft.states.setdefault(c, {})["isOpen"] = False
    a = b.small(at=place)
    b.draft.beside[a] = c
    b.ask(Predicate("held", a), Predicate("open", c), a=a, b=c)


def _toggle_both(b: Builder) -> None:
    a, c = b.pair(b.scene.switches, b.scene.switches, "pair of switches")
    on = bool(b.rng.random() < 0.5)
    for switch in (a, c):
        b.draft.states.setdefault(switch, {})["isToggled"] = not on
    b.small()
    kind = "toggled_on" if on else "toggled_off"
    b.draft.words["on"] = "on" if on else "off"
    b.ask(Predicate(kind, a), Predicate(kind, c), a=a, b=c)


def _fetch(b: Builder, among: Sequence[str] = ()) -> None:
    s = b.container(is_open=False, among=among)
    r = b.target(roomy=True)
    a = b.small(r, at=s)
    b.ask(_located(a, r), a=a, r=r, s=s)


def _fetch_two(b: Builder) -> None:
    _fetch(b, _FOR_BOTH)
    r, s = b.draft.focus["r"], b.draft.focus["s"]
    c = b.small(r, at=s)
    b.ask(_located(c, r), b=c)


def _fetch_hold(b: Builder) -> None:
    s = b.container(is_open=False)
    a = b.small(at=s)
    b.ask(Predicate("held", a), a=a, s=s)


def _stow(b: Builder, among: Sequence[str] = ()) -> None:
    r = b.container(is_open=False, among=among)
    a = b.small(r)
    b.ask(_located(a, r), a=a, r=r)


def _stow_two(b: Builder) -> None:
    _stow(b, _FOR_BOTH)
    r = b.draft.focus["r"]
    c = b.near(b.draft.focus["a"], r) if b.rng.random() < 0.5 else b.small(r)
    b.ask(_located(c, r), b=c)


def _stow_close(b: Builder) -> None:
    _stow(b)
    b.ask(Predicate("closed", b.draft.focus["r"]))


def _stow_two_close(b: Builder) -> None:
    _stow_two(b)
    b.ask(Predicate("closed", b.draft.focus["r"]))


def _set_three(b: Builder) -> None:
    r = b.choose([place for place in b.scene.roomy if place.rsplit("_", 1)[0] not in _CROWDED_BY_TWO], "large surface")
    a = b.small(r, avoid=(r,))
    c = b.near(a, r) if b.rng.random() < 0.5 else b.small(r, avoid=(r,))
    d = b.small(r, avoid=(r,))
    b.ask(_located(a, r), _located(c, r), _located(d, r), a=a, b=c, c=d, r=r)


def _tidy_three(b: Builder) -> None:
    r = b.target(roomy=True)
    s = b.target(r)
    a = b.small(r, avoid=(r, s))
    c = b.near(a, r) if b.rng.random() < 0.5 else b.small(r, avoid=(r, s))
    d = b.small(s, avoid=(r, s))
    b.ask(_located(a, r), _located(c, r), _located(d, s), a=a, b=c, c=d, r=r, s=s)


# ---- one arm cannot


def _lift(b: Builder) -> None:
    a = b.big()
    b.small()
    b.ask(Predicate("lifted", a), a=a)


def _carry(b: Builder) -> None:
    r = b.big_target()
    a = b.big(r)
    b.ask(_located(a, r), a=a, r=r)


def _carry_level(b: Builder) -> None:
    r = b.big_target(among=("Pot",))
    a = b.big(r, among=("Pot",))
    b.ask(_located(a, r), Predicate("filled", a), a=a, r=r)


def _hold_two(b: Builder) -> None:
    a = b.small()
    c = b.near(a) if b.rng.random() < 0.5 else b.small()
    b.ask(Predicate("held", a), Predicate("held", c), a=a, b=c)


def _carry_and_toggle(b: Builder) -> None:
    _carry(b)
    switch = b.switch(on=False)
    b.ask(Predicate("toggled_on", switch), b=switch)


def _carry_and_place(b: Builder) -> None:
    _carry(b)
    r = b.draft.focus["r"]
    s = b.target(r)
    c = b.small(s, avoid=(s,))
    b.ask(_located(c, s), b=c, s=s)


def _store_ajar(b: Builder) -> None:
    r = b.container(is_open=False, falls_shut=True, among=_FALLS_SHUT)
    a = b.small(r)
    b.ask(_located(a, r), Predicate("closed", r), a=a, r=r)


def _fetch_ajar(b: Builder) -> None:
    s = b.container(is_open=False, falls_shut=True, among=_FALLS_SHUT)
    a = b.small(at=s)
    b.ask(Predicate("held", a), Predicate("closed", s), a=a, s=s)


def _slice_steady(b: Builder) -> None:
    _ask_sliced(b, _FOOD_ROLLING)


def _clean_steady(b: Builder) -> None:
    _ask_clean(b, _DISHES_SLIDING)


def _pour_hold(b: Builder) -> None:
    a = b.small(among=_POURED_INTO)
    jug = b.small(among=_JUGS)
    b.start(jug, fillLiquid="water")
    b.ask(Predicate("filled", a), Predicate("held", a), Predicate("held", jug), a=a, b=jug)


#: Every family by name.
FAMILIES: Final[Mapping[str, Family]] = {
    "pick": Family("single", _pick, 4),
    "place": Family("single", _place, 8),
    "place_any": Family("single", _place_any, 8),
    "open": Family("single", _open, 3),
    "close": Family("single", _close, 3),
    "toggle_on": Family("single", _toggle(on=True), 3),
    "toggle_off": Family("single", _toggle(on=False), 3),
    "fill": Family("single", _fill, 9),
    "slice": Family("single", _slice, 8),
    "clean": Family("single", _clean, 8),
    "cook": Family("single", _cook, 14),
    "use_up": Family("single", _use_up, 4),
    "transport_two": Family("optional", _transport_two, 10),
    "transport_any_two": Family("optional", _transport_any_two, 10),
    "transport_each": Family("optional", _transport_each, 14),
    "pick_and_toggle_on": Family("optional", _pick_and_toggle(on=True), 7),
    "pick_and_toggle_off": Family("optional", _pick_and_toggle(on=False), 7),
    "pick_and_open": Family("optional", _pick_and_open, 7),
    "toggle_both": Family("optional", _toggle_both, 6),
    "fetch": Family("optional", _fetch, 9),
    "fetch_two": Family("optional", _fetch_two, 12),
    "fetch_hold": Family("optional", _fetch_hold, 5),
    "stow": Family("optional", _stow, 9),
    "stow_two": Family("optional", _stow_two, 13),
    "stow_close": Family("optional", _stow_close, 11),
    "stow_two_close": Family("optional", _stow_two_close, 15),
    "set_three": Family("optional", _set_three, 16),
    "tidy_three": Family("optional", _tidy_three, 18),
    "lift": Family("essential", _lift, 4),
    "carry": Family("essential", _carry, 7),
    "carry_level": Family("essential", _carry_level, 7),
    "hold_two": Family("essential", _hold_two, 7),
    "carry_and_toggle": Family("essential", _carry_and_toggle, 10),
    "carry_and_place": Family("essential", _carry_and_place, 13),
    "store_ajar": Family("essential", _store_ajar, 10),
    "fetch_ajar": Family("essential", _fetch_ajar, 7),
    "slice_steady": Family("essential", _slice_steady, 10),
    "clean_steady": Family("essential", _clean_steady, 10),
    "pour_hold": Family("essential", _pour_hold, 9),
}
