"""Doors and drawers that fall shut: they stay open only in a hand, and the other hand reaches through."""

from __future__ import annotations

import pytest

from interface.steps import Action, PlanStep
from sim.interfaces.metadata import world_metadata
from sim.scene.objects import ObjectPlacement
from sim.session.session import FreePlay, Session
from sim.world.world import World, WorldError

DOORS = ("Fridge_1", "Cabinet_1", "Drawer_1", "Microwave_1")


def test_springs_shut_doors_and_drawers_within_two_seconds() -> None:
    states = {name: {"isOpen": True, "selfClosing": True} for name in DOORS[:3]} | {"Microwave_1": {"isOpen": True}}
    world = World(None, "kitchen_1", (), states=states, settle_s=0.005)
    world.advance(0.5)
    assert all(0.3 < world.objects[name].openness < 0.9 for name in DOORS[:3]), "slowed by a damper"
    world.advance(2.0)
    assert [round(world.objects[name].openness, 2) for name in DOORS] == [0.0, 0.0, 0.0, 1.0]
    assert {entry["objectId"] for entry in world_metadata(world)["objects"] if entry["selfClosing"]} == set(DOORS[:3])


def test_what_has_no_door_cannot_fall_shut() -> None:
    with pytest.raises(WorldError, match="CounterTop_1"):
        World(None, "kitchen_1", (), states={"CounterTop_1": {"selfClosing": True}}, settle_s=0.005)
    with pytest.raises(WorldError, match="Toilet_1"):
        World(None, "bathroom_1", (), states={"Toilet_1": {"selfClosing": True}}, settle_s=0.005)


@pytest.mark.parametrize("robot", ["h1", "x1"])
def test_one_hand_holds_a_drawer_open_while_the_other_takes_something_out(robot: str) -> None:
    session = Session(robot, image_size=0, all_known=True)
    placements = [ObjectPlacement("PepperShaker_1", "Drawer_1", (1.36, 2.72))]
    session.reset(FreePlay("kitchen_3", placements=placements, states={"Drawer_1": {"selfClosing": True}}), 0)
    world = session.world
    place = {"h1": ("MoveDown(0.2)", "GoTo(Drawer_1)"), "x1": ("GoTo(Drawer_1, 0.4, 0)", "MoveDown(0.05)")}[robot]
    mine, other = {"h1": ("right", "left"), "x1": ("left", "right")}[robot]
    for text in (*place, f"Open({mine}, Drawer_1)"):
        assert session.act(PlanStep.parse(text)).success, text
    assert world.grasps.held(mine) == "Drawer_1" and world.objects["Drawer_1"].openness > 0.6
    assert session.act(PlanStep.parse("MoveBack(0.2)")).outcomes[0].code == "InUse"
    assert session.act(PlanStep.parse(f"Pick({mine}, PepperShaker_1)")).outcomes[0].code == "HandOccupied"
    saved = session.snapshot()
    assert session.act(PlanStep.parse(f"Release({mine})")).success
    assert world.objects["Drawer_1"].openness < 0.03
    assert session.assess(Action.parse(f"Pick({other}, PepperShaker_1)")) is not None, "shut away again"
    session.restore(saved)
    for text in (f"Pick({other}, PepperShaker_1)", f"Release({mine})"):
        assert session.act(PlanStep.parse(text)).success, text
    assert world.grasps.held(other) == "PepperShaker_1" and world.objects["Drawer_1"].openness < 0.03


def test_imagined_steps_leave_no_trace() -> None:
    session = Session("x1", "hard", image_size=0, all_known=True)
    session.reset(FreePlay("kitchen_3", placements=[]), 0)
    before = session.world.save()
    with session.imagining():
        assert session.act(PlanStep.parse("GoTo(Drawer_1)")).success
        assert session.draw(Action.parse("Open(left, Drawer_1)")) == "success", "no contingency in thought"
    assert session.history == () and session.stats.steps == 0
    assert (session.world.data.qpos == before.physics.qpos).all()
