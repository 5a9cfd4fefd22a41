"""Actions change the same facts in physics as by the table of actions: the expert's episodes, acted out in both worlds."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import pytest

from interface.bodies import PAPER_ROBOTS
from interface.effects import LetGo
from interface.facts import Facts
from interface.steps import Action
from robots.spec import load_robot
from sim.collection.text_facts import TextFacts
from sim.expert.expert import Expert
from sim.session.session import Session
from sim.tasks.drafts import Draft
from sim.tasks.sample import TRAIN_SEEDS, sample_task, scene_of
from sim.tasks.task import Task, load_benchmark
from sim.world.facts import world_facts

TASKS = load_benchmark()
#: Families with tools, liquids, two-handed loads and doors that fall shut.
FAMILIES = ("slice_steady", "store_ajar", "carry", "clean", "use_up", "fetch_two", "pick_and_toggle_on")


@dataclass
class Left:
    """What physics alone decides, until something is done about it again.

    Attributes:
        places: what was let go of: where it comes to rest.
        doors: doors with a spring that were let go of: whether they fall shut.
        levels: vessels that something was poured out of: whether anything is left.
    """

    places: set[str] = field(default_factory=set)
    doors: set[str] = field(default_factory=set)
    levels: set[str] = field(default_factory=set)

    def look(self, action: Action, text: TextFacts) -> None:
        """Before an action that succeeded in physics."""
        state, target = text.state, action.object_id or ""
        held = state.lifted if action.arm is None else state.held[action.arm]
        if action.spec.has_effect(LetGo) and held is not None and held not in state.in_place:
            (self.doors if held in state.self_closing else self.places).add(held)
        else:
            self.places -= {target, held}
            self.doors.discard(target)
        if action.name == "Pour" and held is not None:
            self.levels.add(held)
        if action.name == "Fill":
            self.levels.discard(held or "")


def differences(physics: Facts, words: Facts, left: Left) -> Iterator[tuple[str, str, object, object]]:
    """Object, fact, and what it is in either world."""
    if (dict(physics.held), physics.lifted) != (dict(words.held), words.lifted):
        yield "hands", "held", physics.held, words.held
    for name, item in words.objects.items():
        real = physics.objects[name]
        facts = ["holders", "on", "dirty", "sliced", "used_up", "two_handed", "can", "switch", "outlet", "self_closing"]
        facts += ["open"] * (name not in left.doors) + ["filled"] * (name not in left.levels)
        for fact in facts:
            one, other = getattr(real, fact), getattr(item, fact)
            if (set(one) != set(other)) if fact == "holders" else one != other:
                yield name, fact, one, other
        rests = item.can.movable and not item.holders  # what a hand has just taken may be a millimetre over where it was
        if rests and not left.places & {name, *item.carriers} and real.carriers[:1] != item.carriers[:1]:
            yield name, "carriers", real.carriers, item.carriers


def compared(robot: str, task: Task) -> int:
    """Acts the expert's plan out in both worlds until something fails; how many steps were compared."""
    session = Session(robot, "easy", image_size=0)
    session.reset(task, seed=0)
    expert = Expert(session)
    expert.reset()
    objects = {placement.object_id: placement.receptacle for placement in task.placements}
    starts = {placement.object_id: dict(placement.state) for placement in task.placements if placement.state}
    states = {name: dict(values) for name, values in task.states.items()}
    draft = Draft(task.family, task.room, objects, starts, states, list(task.goals))
    text, left, steps = TextFacts(draft, scene_of(task.room), load_robot(robot)), Left(), 0
    try:
        while True:
            found = list(differences(world_facts(session.world), text.now(), left))
            assert not found, (task.id, steps, session.history[-1:], found)
            if session.finished:
                return steps
            held = set(filter(None, session.body.hands.held.values()))
            _, feedback = session.step(expert.next_step())
            if not feedback.success:  # what a failure leaves behind no table says
                return steps
            let_go = held - set(session.body.hands.held.values())
            fallen = [session.world.containment.parents(name)[:1] for name in let_go if session.world.objects[name].movable]
            if () in fallen:  # to the floor, which no table says
                return steps
            for outcome in feedback.outcomes:
                left.look(outcome.action, text)
                text.succeed(outcome.action, next((place for (place,) in fallen), ""))
            steps += 1
    finally:
        session.close()


@pytest.mark.parametrize("family", FAMILIES)
def test_physics_and_table_change_the_same_facts(family: str) -> None:
    task = next(task for task in TASKS if task.family == family)
    assert compared(PAPER_ROBOTS[FAMILIES.index(family) % 2], task) > 0


@pytest.mark.parametrize("family", ["fill", "pour_hold"])
def test_physics_and_table_change_the_same_facts_in_families_of_training_too(family: str) -> None:
    task = sample_task(TRAIN_SEEDS.start, family=family, robots=("h1",))
    assert compared("h1", task) > 0


@pytest.mark.slow
@pytest.mark.parametrize("robot", PAPER_ROBOTS)
def test_physics_and_table_change_the_same_facts_in_many_tasks(robot: str) -> None:
    assert sum(compared(robot, task) for task in TASKS[5::18]) > 100
