"""The order of jobs: what is due, in which hands, through which doors."""

import pytest

from interface.bodies import Arm
from interface.facts import Affordances, Facts, ObjectFacts
from interface.steps import Action
from sim.expert.jobs import Job, Setting, pending_leaves, plan_jobs
from sim.tasks.predicates import Predicate

LEFT, RIGHT = Arm.LEFT, Arm.RIGHT


def facts(held=None, lifted=None, fridge_open=False, places=None, lamp=False):
    places = {"Mug_1": "Counter_1", "Egg_1": "Counter_1", "Box_1": "Table_1"} | (places or {})
    hands = {LEFT: None, RIGHT: None} | (held or {})
    objects = {}
    for name in ("Counter_1", "Table_1", "Fridge_1", "Lamp_1", *places):
        in_hands = [arm.value for arm, item in hands.items() if item == name] + (["left", "right"] if lifted == name else [])
        fridge = name == "Fridge_1"
        objects[name] = ObjectFacts(
            name,
            Affordances(movable=name in places, pickupable=name in places, openable=fridge, encloses=fridge),
            holders=in_hands,
            carriers=(places[name],) if name in places and not in_hands else (),
            two_handed=name == "Box_1",
            openness=float(fridge and fridge_open),
            on=name == "Lamp_1" and lamp,
        )
    return Setting(Facts(objects, hands, lifted), places)


ON_TABLE = Predicate("on", "Mug_1", "Table_1")
IN_FRIDGE = Predicate("in", "Mug_1", "Fridge_1")
BOX = Predicate("on", "Box_1", "Counter_1")
LAMP = Predicate("toggled_on", "Lamp_1")


@pytest.mark.parametrize(
    ("goals", "state", "expected"),
    [
        ([Predicate("held", "Mug_1")], facts(), [Job("Pick", "Mug_1")]),
        ([Predicate("held", "Mug_1")], facts(held={LEFT: "Mug_1"}), []),
        ([ON_TABLE], facts(), [Job("Pick", "Mug_1")]),
        ([ON_TABLE], facts(held={LEFT: "Mug_1"}), [Job("Place", "Table_1", LEFT)]),
        ([ON_TABLE], facts(places={"Mug_1": "Fridge_1"}), [Job("Open", "Fridge_1")]),
        ([ON_TABLE], facts(places={"Mug_1": "Fridge_1"}, fridge_open=True), [Job("Pick", "Mug_1")]),
        ([IN_FRIDGE], facts(), [Job("Pick", "Mug_1")]),
        ([IN_FRIDGE], facts(held={RIGHT: "Mug_1"}), [Job("Open", "Fridge_1")]),
        ([IN_FRIDGE], facts(held={RIGHT: "Mug_1"}, fridge_open=True), [Job("Place", "Fridge_1", RIGHT)]),
        ([IN_FRIDGE, Predicate("closed", "Fridge_1")], facts(fridge_open=True), [Job("Pick", "Mug_1")]),
        (
            [IN_FRIDGE, Predicate("closed", "Fridge_1")],
            facts(places={"Mug_1": "Fridge_1"}, fridge_open=True),
            [Job("Close", "Fridge_1")],
        ),
        ([ON_TABLE, Predicate("on", "Egg_1", "Table_1")], facts(), [Job("Pick", "Mug_1"), Job("Pick", "Egg_1")]),
        (
            [ON_TABLE, Predicate("on", "Egg_1", "Table_1")],
            facts(held={RIGHT: "Mug_1", LEFT: "Egg_1"}),
            [Job("Place", "Table_1", RIGHT), Job("Place", "Table_1", LEFT)],
        ),
        ([BOX], facts(), [Job("Lift", "Box_1")]),
        ([BOX], facts(lifted="Box_1"), [Job("PlaceBoth", "Counter_1")]),
        ([BOX, LAMP], facts(), [Job("ToggleOn", "Lamp_1")]),
        ([Predicate("held", "Mug_1"), LAMP], facts(), [Job("ToggleOn", "Lamp_1"), Job("Pick", "Mug_1")]),
        ([Predicate("lifted", "Box_1")], facts(held={RIGHT: "Egg_1"}), [Job("Place", "Counter_1", RIGHT)]),
        ([LAMP, ON_TABLE], facts(lifted="Box_1"), [Job("PlaceBoth", "Table_1")]),
        # what a goal wants in a hand stays there
        ([Predicate("held", "Mug_1"), LAMP], facts(held={LEFT: "Mug_1"}), [Job("ToggleOn", "Lamp_1")]),
        # beside a switch there is one hand for one thing
        (
            [Predicate("held", "Mug_1"), Predicate("held", "Egg_1"), LAMP],
            facts(),
            [Job("ToggleOn", "Lamp_1"), Job("Pick", "Mug_1")],
        ),
    ],
)
def test_next_jobs(goals, state, expected):
    assert plan_jobs(goals, state) == expected


def test_pending_leaves_of_compound_goals():
    objects = facts().objects
    held = [Predicate("held", "Mug_1"), Predicate("held", "Egg_1")]
    assert pending_leaves([Predicate("count", of=tuple(held), at_least=1)], objects) == held[:1]
    assert pending_leaves([Predicate("or", of=tuple(held))], objects) == held[:1]
    assert pending_leaves([Predicate("and", of=tuple(held))], objects) == held
    closed = Predicate("not", of=(Predicate("closed", "Fridge_1"),))
    assert pending_leaves([closed], objects) == [Predicate("open", "Fridge_1")]


def test_a_negation_without_a_state_is_refused():
    unwanted = Predicate("not", of=(Predicate("on", "Mug_1", "Counter_1"),))
    with pytest.raises(ValueError, match="'on'"):
        pending_leaves([unwanted], facts().objects)


# ---- tools, liquids, heat, doors that fall shut


def kitchen(held=None, arms=(RIGHT, LEFT), **states):
    """A counter with food, dishes and tools, a sink, a microwave and a drawer that falls shut; `states` by object id."""
    hands = {LEFT: None, RIGHT: None} | (held or {})
    places = {"Knife_1": "Counter_1", "Sponge_1": "Counter_1", "Apple_1": "Counter_1", "Bread_1": "Counter_1",
              "Plate_1": "Counter_1", "Mug_1": "Counter_1", "Jug_1": "Counter_1", "Egg_1": "Drawer_1"}  # fmt: skip
    objects = {}
    for name in ("Counter_1", "Faucet_1", "Microwave_1", "Drawer_1", "Cabinet_1", *places):
        in_hands = [arm.value for arm, item in hands.items() if item == name]
        doors, movable = name in ("Microwave_1", "Drawer_1", "Cabinet_1"), name in places
        can = Affordances(
            movable=movable, pickupable=movable, openable=doors, encloses=doors, cutter=name == "Knife_1",
            wiper=name == "Sponge_1", unsteady=name in ("Apple_1", "Plate_1"), heat_source=name == "Microwave_1",
            toggleable=name in ("Microwave_1", "Faucet_1"),
        )  # fmt: skip
        carriers = (places[name],) if movable and not in_hands else ()
        outlet = name if name == "Faucet_1" else None
        known = {"self_closing": name == "Drawer_1", "carriers": carriers, "switch": name, "outlet": outlet}
        objects[name] = ObjectFacts(name, can, tuple(in_hands), **known | states.get(name, {}))
    return Setting(Facts(objects, hands), places, arms)


SLICED, CLEAN, FILLED = Predicate("sliced", "Apple_1"), Predicate("clean", "Plate_1"), Predicate("filled", "Mug_1")
STORED = [Predicate("in", "Mug_1", "Drawer_1"), Predicate("closed", "Drawer_1")]
FETCHED = [Predicate("held", "Egg_1"), Predicate("closed", "Drawer_1")]
COOKED, INSIDE = Predicate("cooked", "Egg_1"), {"carriers": ("Microwave_1",)}
DIRTY = {"Plate_1": {"dirty": True}}
OPEN = {"Drawer_1": {"openness": 1.0}}
WORK = Job("Slice", "Apple_1", RIGHT)


@pytest.mark.parametrize(
    ("goals", "state", "expected"),
    [
        ([SLICED], kitchen(), [Job("Pick", "Knife_1")]),
        ([SLICED], kitchen({RIGHT: "Knife_1"}), [Job("Hold", "Apple_1", LEFT, WORK)]),
        ([SLICED], kitchen({RIGHT: "Knife_1", LEFT: "Apple_1"}), [WORK]),
        ([Predicate("sliced", "Bread_1")], kitchen({LEFT: "Knife_1"}), [Job("Slice", "Bread_1", LEFT)]),
        ([CLEAN], kitchen({LEFT: "Sponge_1"}, **DIRTY), [Job("Hold", "Plate_1", RIGHT, Job("Clean", "Plate_1", LEFT))]),
        ([FILLED], kitchen(), [Job("Pick", "Mug_1")]),
        ([FILLED], kitchen({LEFT: "Mug_1"}), [Job("ToggleOn", "Faucet_1")]),
        ([FILLED], kitchen({LEFT: "Mug_1"}, Faucet_1={"on": True}), [Job("Fill", "Faucet_1", LEFT)]),
        ([FILLED], kitchen(Jug_1={"fill": 1.0}), [Job("Pick", "Jug_1")]),
        ([FILLED], kitchen({LEFT: "Jug_1"}, Jug_1={"fill": 1.0}), [Job("Pour", "Mug_1", LEFT)]),
        ([Predicate("used_up", "Jug_1")], kitchen(), [Job("UseUp", "Jug_1")]),
        ([COOKED], kitchen(Egg_1=INSIDE, Microwave_1={"openness": 1.0}), [Job("Close", "Microwave_1")]),
        ([COOKED], kitchen(Egg_1=INSIDE), [Job("ToggleOn", "Microwave_1")]),
        ([COOKED], kitchen(Egg_1=INSIDE, Microwave_1={"on": True}), [Job("ResetArm", "", RIGHT)]),
        (STORED, kitchen({RIGHT: "Mug_1"}), [Job("Open", "Drawer_1", then=Job("Place", "Drawer_1", RIGHT))]),
        (STORED, kitchen({RIGHT: "Mug_1", LEFT: "Drawer_1"}, **OPEN), [Job("Place", "Drawer_1", RIGHT)]),
        (STORED, kitchen({LEFT: "Drawer_1"}, Mug_1={"carriers": ("Drawer_1",)}, **OPEN), [Job("Release", "", LEFT)]),
        (FETCHED, kitchen(), [Job("Open", "Drawer_1", then=Job("Pick", "Egg_1"))]),
        (FETCHED, kitchen({LEFT: "Drawer_1"}, **OPEN), [Job("Pick", "Egg_1")]),
        (FETCHED, kitchen({LEFT: "Drawer_1", RIGHT: "Egg_1"}, **OPEN), [Job("Release", "", LEFT)]),
        # one arm opens an ordinary door first, because it has no other hand for it later
        ([Predicate("in", "Mug_1", "Cabinet_1")], kitchen(arms=(RIGHT,)), [Job("Open", "Cabinet_1")]),
        ([Predicate("in", "Mug_1", "Cabinet_1"), Predicate("in", "Jug_1", "Cabinet_1")], kitchen(), [Job("Open", "Cabinet_1")]),
        # one hand stays free for a door that falls shut
        ([Predicate("in", "Mug_1", "Drawer_1"), Predicate("in", "Jug_1", "Drawer_1")], kitchen(), [Job("Pick", "Mug_1")]),
        # what was only held where it is is let go of, what was picked up is put back
        ([Predicate("held", "Mug_1")], kitchen({LEFT: "Apple_1"}, Apple_1={"carriers": ("Counter_1",)}),
         [Job("Release", "", LEFT)]),
        ([Predicate("held", "Mug_1")], kitchen({LEFT: "Apple_1"}), [Job("Place", "Counter_1", LEFT)]),
    ],
)  # fmt: skip
def test_next_jobs_with_tools_liquids_heat_and_springs(goals, state, expected):
    assert plan_jobs(goals, state) == expected


@pytest.mark.parametrize(
    ("job", "arm", "text"),
    [
        (Job("Pick", "Mug_1"), LEFT, "Pick(left, Mug_1)"),
        (Job("Lift", "Box_1"), LEFT, "Lift(Box_1)"),
        (Job("PlaceBoth", "Table_1"), None, "PlaceBoth(Table_1)"),
        (Job("ResetArm", "", RIGHT), RIGHT, "ResetArm(right)"),
    ],
)
def test_a_job_is_an_action_of_the_grammar(job, arm, text):
    assert job.action(arm) == Action.parse(text)


def test_of_an_exists_the_missing_objects_are_fetched():
    on_table = Predicate("exists", object_type="Mug", of=(Predicate("on", "$", "Table_1"),), at_least=1)
    assert pending_leaves([on_table], facts().objects) == [Predicate("on", "Mug_1", "Table_1")]
    assert plan_jobs([on_table], facts()) == [Job("Pick", "Mug_1")]
