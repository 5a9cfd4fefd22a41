"""Instructions are read as the goals that they were written for: the benchmark's, every template's, and free ones."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import pytest

from proprio_mllm.planners.scripted.instruction import Goal, read_goals
from proprio_mllm.planners.scripted.words import Mention, candidates, find_mentions
from sim.scene.rooms import load_room
from sim.tasks.instructions import TEMPLATES, phrase, preposition, wordings
from sim.tasks.predicates import Predicate
from sim.tasks.task import Task, load_benchmark

Wanted = tuple[str, ...]
#: What each family asks for, by slot.
FAMILIES: dict[str, tuple[Wanted, ...]] = {
    "pick": (("held", "a"),),
    "place": (("on", "a", "r"),),
    "place_any": (("on", "n", "r"),),
    "open": (("open", "a"),),
    "close": (("closed", "a"),),
    "toggle_on": (("toggled_on", "a"),),
    "toggle_off": (("toggled_off", "a"),),
    "toggle_both": (("toggled_on", "a"), ("toggled_on", "b")),
    "fill": (("filled", "a"),),
    "slice": (("sliced", "a"),),
    "slice_steady": (("sliced", "a"),),
    "clean": (("clean", "a"),),
    "clean_steady": (("clean", "a"),),
    "cook": (("on", "a", "r"), ("cooked", "a")),
    "use_up": (("used_up", "a"),),
    "pour_hold": (("filled", "a"), ("held", "a"), ("held", "b")),
    "transport_two": (("on", "a", "r"), ("on", "b", "r")),
    "transport_any_two": (("on", "n", "r"),),
    "transport_each": (("on", "a", "r"), ("on", "b", "s")),
    "set_three": (("on", "a", "r"), ("on", "b", "r"), ("on", "c", "r")),
    "tidy_three": (("on", "a", "r"), ("on", "b", "r"), ("on", "c", "s")),
    "pick_and_toggle_on": (("held", "a"), ("toggled_on", "b")),
    "pick_and_toggle_off": (("held", "a"), ("toggled_off", "b")),
    "pick_and_open": (("held", "a"), ("open", "b")),
    "fetch": (("on", "a", "r"),),
    "fetch_two": (("on", "a", "r"), ("on", "b", "r")),
    "fetch_hold": (("held", "a"),),
    "fetch_ajar": (("held", "a"), ("closed", "s")),
    "stow": (("on", "a", "r"),),
    "stow_close": (("on", "a", "r"), ("closed", "r")),
    "stow_two": (("on", "a", "r"), ("on", "b", "r")),
    "stow_two_close": (("on", "a", "r"), ("on", "b", "r"), ("closed", "r")),
    "store_ajar": (("on", "a", "r"), ("closed", "r")),
    "lift": (("lifted", "a"),),
    "carry": (("on", "a", "r"),),
    "carry_level": (("on", "a", "r"), ("filled", "a")),
    "carry_and_toggle": (("on", "a", "r"), ("toggled_on", "b")),
    "carry_and_place": (("on", "a", "r"), ("on", "b", "s")),
    "hold_two": (("held", "a"), ("held", "b")),
}
#: Slots that a family needs things of its own for.
THINGS: dict[str, dict[str, str]] = {
    "slice": {"a": "Apple_1", "b": "Knife_1"},
    "slice_steady": {"a": "Tomato_1", "b": "ButterKnife_2"},
    "clean": {"a": "Mug_1", "b": "DishSponge_1"},
    "clean_steady": {"a": "Bowl_1", "b": "HandTowel_1"},
    "fill": {"a": "Cup_1", "r": "SinkBasin_1"},
    "cook": {"a": "Potato_1", "r": "Microwave_1"},
    "use_up": {"a": "TissueBox_1"},
    "pour_hold": {"a": "Mug_1", "b": "WineBottle_1"},
    "carry_level": {"a": "Pot_1"},
    "toggle_on": {"a": "LightSwitch_1"},
    "toggle_off": {"a": "StoveKnob_2"},
    "toggle_both": {"a": "StoveKnob_1", "b": "StoveKnob_2"},
    "open": {"a": "Fridge_1"},
    "close": {"a": "Cabinet_1"},
}
ORDINALS = ("first", "second")


def spoken(object_id: str, place: str = "") -> str:
    scene: dict[str, str | None] = {object_id: None}
    name = phrase(object_id, scene, frozenset(scene))
    ordinal = int(object_id.rsplit("_", 1)[1])
    return name.replace("the ", "the second ", 1) + place if ordinal == 2 else name + place


def resolved(goals: Sequence[Goal], ids: Sequence[str]) -> set[Wanted]:
    def one(mention: Mention) -> str:
        return next(iter(candidates(mention, ids)), f"?{mention.name}")

    return {(g.kind, one(g.obj), *((one(g.place),) if g.kind == "on" and g.place else ())) for g in goals}


def sentences(family: str) -> Iterator[tuple[str, dict[str, str]]]:
    """Every wording of a family with things that are told apart by name, by number and by place."""
    kits = (
        {"a": "Mug_2", "b": "TissueBox_1", "c": "Book_1", "r": "DiningTable_1", "s": "CounterTop_2"},
        {"a": "PaperTowelRoll_1", "b": "Tomato_1", "c": "RemoteControl_1", "r": "Drawer_1", "s": "Cabinet_2"},
    )
    for kit in kits:
        slots = kit | THINGS.get(family, {})
        if "toggle" in family:
            slots |= {} if family in THINGS else {"b": "FloorLamp_1"}
        for place in ("", " from the side table"):
            words = {slot: spoken(name, place if slot in "abc" else "") for slot, name in slots.items()}
            words |= {"pr": preposition(slots["r"]), "ps": preposition(slots["s"]), "on": "on"}
            words["n"] = "a mug" if family == "place_any" else "two mugs"
            for sentence in wordings(family, words):
                yield sentence, slots | {"n": "Mug_1"}


def leaves(goal: Predicate) -> list[Wanted]:
    """What a goal asks for; of any thing of a type, its first one."""
    record = goal.to_json()
    if record.get("object_type"):
        return [("on", f"{record['object_type']}_1", inner["receptacle_id"]) for inner in record["of"]]
    if goal.of:
        return [leaf for operand in goal.of for leaf in leaves(operand)]
    if goal.kind in ("on", "in"):
        return [("on", goal.object_id, goal.receptacle_id)]
    return [(goal.kind, goal.object_id)]


def reads_right(task: Task, sentence: str) -> bool:
    """Whether a sentence gives the task's goals; several things of one type are told apart only when they are seen."""
    ids = [item.id for item in load_room(task.room).furniture] + [item.object_id for item in task.placements or ()]
    wanted = [leaf for goal in task.goals if isinstance(goal, Predicate) for leaf in leaves(goal)]
    goals = read_goals(sentence, ids)
    if len(goals) != len(wanted):
        return False

    def fits(goal: Goal, want: Wanted) -> bool:
        place = want[2:] == () or (goal.place is not None and want[2] in candidates(goal.place, ids))
        return goal.kind == want[0] and want[1] in candidates(goal.obj, ids) and place

    return all(any(fits(goal, want) for goal in goals) for want in wanted)


def test_the_benchmark_is_read_as_it_is_meant() -> None:
    all_of_them = [(task, text) for task in load_benchmark() for text in (task.instruction, *task.paraphrases)]
    wrong = [f"{task.id}: {text}" for task, text in all_of_them if not reads_right(task, text)]
    assert len(all_of_them) > 100
    assert len(wrong) <= 0.05 * len(all_of_them), wrong


def test_every_family_has_an_expectation() -> None:
    assert set(TEMPLATES) <= set(FAMILIES)


@pytest.mark.parametrize("family", sorted(TEMPLATES))
def test_templates(family: str) -> None:
    found = list(sentences(family))
    wrong = []
    for sentence, slots in found:
        wanted = {(kind, *(slots[slot] for slot in of)) for kind, *of in FAMILIES[family]}
        got = resolved(read_goals(sentence), [*slots.values(), "Mug_2"])
        if got != wanted:
            wrong.append(f"{sentence} {sorted(got)}")
    assert len(wrong) <= 0.05 * len(found), wrong


@pytest.mark.parametrize(
    ("sentence", "wanted"),
    [
        ("Fill the mug at the sink.", {("filled", "Mug_1")}),
        ("Put some water in the cup.", {("filled", "Cup_1")}),
        ("Take the knife and slice the apple.", {("sliced", "Apple_1")}),
        ("Hold the apple with one hand and cut it with the knife.", {("sliced", "Apple_1")}),
        ("The plate is dirty, wipe it with the dish sponge and hold it still meanwhile.", {("clean", "Plate_1")}),
        ("Use the microwave to cook the potato.", {("on", "Potato_1", "Microwave_1"), ("cooked", "Potato_1")}),
        ("Nothing of the tissue box should be left, use it up.", {("used_up", "TissueBox_1")}),
        ("Put two mugs on the desk.", {("on", "Mug_1", "Desk_1")}),
        ("Get a mug from somewhere and set it on the desk.", {("on", "Mug_1", "Desk_1")}),
        ("The mug, the cup and the book belong on the desk.", {("on", f"{x}_1", "Desk_1") for x in ("Mug", "Cup", "Book")}),
        ("Carry the pot to the desk without spilling.", {("on", "Pot_1", "Desk_1"), ("filled", "Pot_1")}),
        (
            "Hold the drawer open with one hand and put the mug in it, then let it fall shut.",
            {("on", "Mug_1", "Drawer_1"), ("closed", "Drawer_1")},
        ),
        ("The drawer closes by itself: keep it open while you take the mug out.", {("held", "Mug_1"), ("closed", "Drawer_1")}),
        (
            "Take the kettle, fill the mug from it, and take the mug in the other hand.",
            {("filled", "Mug_1"), ("held", "Mug_1"), ("held", "Kettle_1")},
        ),
        ("Could you bring me my phone?", {("held", "CellPhone_1")}),
        ("Put the cup that is on the side table into the cupboard", {("on", "Cup_1", "Cabinet_1")}),
        (
            "Turn the TV off, then put the remote on the table",
            {("toggled_off", "Television_1"), ("on", "RemoteControl_1", "DiningTable_1")},
        ),
    ],
)
def test_other_sentences(sentence: str, wanted: set[Wanted]) -> None:
    types = (
        "Mug Cup Apple Plate Potato Microwave TissueBox Desk Book Pot Drawer Kettle CellPhone Cabinet Television RemoteControl"
    )
    ids = [f"{name}_1" for name in [*types.split(), "DiningTable", "SideTable"]]
    assert resolved(read_goals(sentence, ids), ids) == wanted


def test_where_how_many_and_with_what() -> None:
    (goal,) = read_goals("Fetch the second mug from the first side table and put it in the fridge.")
    assert goal.obj == Mention("mug", 2, place=Mention("sidetable", 1))
    (goal,) = read_goals("Bring two butter knives to the desk.")
    assert (goal.obj.name, goal.obj.count, goal.obj.definite) == ("butterknife", 2, False)
    (goal,) = read_goals("Slice the bread with the knife.")
    assert goal.tool == Mention("knife")
    (goal,) = read_goals("Polish it, then pick up the strange gadget from the desk.", ["StrangeGadget_3"])
    assert candidates(goal.obj, ["StrangeGadget_3", "Gadget_1"]) == ["StrangeGadget_3"]


def test_marks_in_the_text_are_no_things() -> None:
    text, mentions = find_mentions("put the mug on <7> <0+9>", [])
    assert text.count("<") == len(mentions) == 1


@pytest.mark.parametrize(
    "text",
    [
        "",
        " ",
        "hello",
        "it",
        "put it in it",
        "close it",
        "x" * 10_000,
        "the " * 5_000,
        "put the mug " * 900,
        "<0> <1+2> <99>",
        "\n\0é",
    ],
)
def test_what_asks_for_nothing_gives_no_error(text: str) -> None:
    assert isinstance(read_goals(text), tuple)
