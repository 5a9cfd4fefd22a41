"""Slice, Clean, UseUp, Pour, Fill, Hold and Release, acted out in physics by both robots."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import pytest

from interface.feedback import Feedback
from interface.steps import PlanStep
from sim.scene.objects import ObjectPlacement
from sim.session.session import FreePlay, Session


def _started(
    robot: str,
    placements: Sequence[ObjectPlacement],
    room: str = "kitchen_1",
    states: Mapping[str, Mapping[str, bool]] | None = None,
) -> Session:
    session = Session(robot, image_size=0, all_known=True)
    session.reset(FreePlay(room, placements=placements, states=states or {}), 0)
    return session


def _act(session: Session, text: str) -> Feedback:
    """A step; where only the pelvis height is wrong, it is put right first, as the failure's margin says."""
    _, feedback = session.step(PlanStep.parse(text))
    outcome = feedback.outcomes[0]
    if outcome.code in ("BodyTooHigh", "BodyTooLow"):
        change = outcome.margins["height_m"]
        session.step(PlanStep.parse(f"Move{'Down' if change < 0 else 'Up'}({max(abs(change), 0.01):.3f})"))
        _, feedback = session.step(PlanStep.parse(text))
    return feedback


def _play(session: Session, *texts: str) -> None:
    for text in texts:
        feedback = _act(session, text)
        assert feedback.success, feedback.to_text()


def _code(session: Session, text: str) -> str:
    return _act(session, text).outcomes[0].code


TABLE = "DiningTable_1"


@pytest.mark.parametrize("robot", ["h1", "x1"])
def test_a_knife_slices(robot: str) -> None:
    session = _started(robot, [ObjectPlacement("Knife_1", TABLE, (1.5, -0.78)), ObjectPlacement("Apple_1", TABLE, (1.8, -0.8))])
    world = session.world
    assert _code(session, "Slice(left, Apple_1)") == "HandEmpty"
    whole = world.cameras.render("plan", 200, 200).rgb
    _play(session, "GoTo(Knife_1)", "Pick(left, Knife_1)", "GoTo(Apple_1)")
    assert _code(session, "Slice(left, Apple_1)") == "NeedsSteadying"
    _play(session, "Hold(right, Apple_1)", "Slice(left, Apple_1)", "Release(right)")
    assert (
        world.object("Apple_1").state.isSliced
        and world.grasps.held("left") == "Knife_1"
        and world.containment.parents("Apple_1") == (TABLE,)
    )
    parts = [part for _, part in world.scene.part_of_geom["Apple_1"] if "slice" in part.options]
    assert len(parts) >= 4 and (world.cameras.render("plan", 200, 200).rgb != whole).any()
    assert _code(session, "Slice(left, Apple_1)") == "AlreadyInState"
    assert _code(session, f"Slice(left, {TABLE})") == "NotSliceable"


@pytest.mark.parametrize("robot", ["h1", "x1"])
def test_a_sponge_cleans_dirt_and_spills(robot: str) -> None:
    session = _started(
        robot,
        [
            ObjectPlacement("DishSponge_1", TABLE, (1.5, -0.76)),
            ObjectPlacement("Bowl_1", TABLE, (1.85, -0.8), state={"isDirty": True}),
        ],
    )
    world = session.world
    _play(session, "GoTo(DishSponge_1)", "Pick(right, DishSponge_1)", "GoTo(Bowl_1)")
    assert _code(session, "Clean(right, Bowl_1)") == "NeedsSteadying"
    if robot == "h1":  # low enough for both hands before one of them has hold of the bowl
        _play(session, "MoveDown(0.1)")
    _play(session, "Hold(left, Bowl_1)", "Clean(right, Bowl_1)")
    assert not world.object("Bowl_1").state.isDirty
    assert _code(session, "Clean(right, Bowl_1)") == "NotDirty"
    assert _code(session, "Slice(right, Bowl_1)") == "NeedsTool"


@pytest.mark.parametrize("robot", ["h1", "x1"])
def test_a_hand_uses_up_a_roll(robot: str) -> None:
    session = _started(robot, [ObjectPlacement("PaperTowelRoll_1", TABLE, (1.5, -0.88))])
    _play(session, "GoTo(PaperTowelRoll_1)", "UseUp(right, PaperTowelRoll_1)")
    assert session.world.object("PaperTowelRoll_1").state.isUsedUp
    assert _code(session, "UseUp(right, PaperTowelRoll_1)") == "AlreadyInState"
    assert _code(session, f"UseUp(right, {TABLE})") == "NotUsable"


@pytest.mark.parametrize("robot", ["h1", "x1"])
def test_what_is_poured_arrives(robot: str) -> None:
    session = _started(
        robot,
        [
            ObjectPlacement("Cup_1", TABLE, (1.5, -0.85), state={"fillLiquid": "wine"}),
            ObjectPlacement("Bowl_1", TABLE, (1.8, -0.8)),
        ],
    )
    world = session.world
    had = world.object("Cup_1").state.fillLitres
    _play(session, "GoTo(Cup_1)", "Pick(right, Cup_1)", "GoTo(Bowl_1)")
    assert world.object("Cup_1").state.fillLitres == had, "carried level, nothing is lost"
    assert _code(session, f"Pour(right, {TABLE})") == "NotFillable"
    _play(session, "Pour(right, Bowl_1)")
    assert world.object("Bowl_1").state.fillLitres >= 0.75 * had and world.object("Bowl_1").state.fillLiquid == "wine"
    assert world.object("Cup_1").state.fillLitres < 0.01 and world.grasps.held("right") == "Cup_1"
    assert world.liquids.balance_l() == pytest.approx(0.0, abs=1e-9)
    assert _code(session, "Pour(right, Bowl_1)") == "Empty"


def test_a_cup_stands_below_the_coffee_machine() -> None:
    session = _started("h1", [ObjectPlacement("Mug_1", "CounterTop_2", (0.55, 2.12))], "kitchen_2")
    mug = session.world.object("Mug_1")
    _play(session, "GoTo(Mug_1)", "Pick(right, Mug_1)")
    assert _code(session, "Fill(right, CoffeeMachine_1)") == "SourceOff"
    assert _code(session, "Fill(right, Microwave_1)") == "NotFillable"
    _play(session, "GoTo(CoffeeMachine_1)", "Place(right, CoffeeMachine_1)", "ToggleOn(left, CoffeeMachine_1)")
    session.world.advance(4.0)
    assert mug.state.fillLiquid == "coffee" and mug.state.fillLitres >= 0.9 * mug.type.volume_l


@pytest.mark.parametrize("robot", ["h1", "x1"])
def test_hold_leaves_things_where_they_are_and_release_lets_go(robot: str) -> None:
    session = _started(robot, [ObjectPlacement("Cup_1", TABLE, (1.5, -0.85))])
    world = session.world
    before = world.poses.pose("Cup_1")[:3, 3]
    _play(session, "GoTo(Cup_1)", "Hold(right, Cup_1)")
    assert world.grasps.held("right") == "Cup_1" and np.linalg.norm(world.poses.pose("Cup_1")[:3, 3] - before) < 0.03
    assert _code(session, "Hold(right, Cup_1)") == "HandOccupied"
    _play(session, "Release(right)")
    assert world.grasps.held("right") is None and world.containment.parents("Cup_1") == (TABLE,)
    assert _code(session, "Release(right)") == "HandEmpty"


@pytest.mark.parametrize("robot", ["h1", "x1"])
def test_a_held_handle_keeps_the_robot_in_its_place(robot: str) -> None:
    session = _started(robot, [])
    _play(session, "GoTo(Drawer_1)", "Hold(right, Drawer_1)")
    assert session.world.grasps.held("right") == "Drawer_1"
    for move in ("MoveBack(0.2)", "MoveUp(0.1)", "MoveDown(0.1)", "RotateLeft(30)", "GoTo(Drawer_1)", "ResetArm(right)"):
        assert _code(session, move) == "InUse", move
    _play(session, "Release(right)", "MoveBack(0.1)", "GoTo(Drawer_1)", "Open(right, Drawer_1)")


def test_a_cup_is_filled_below_a_running_tap_and_carried_level() -> None:
    session = _started("h1", [ObjectPlacement("Mug_1", "CounterTop_1", (-0.5, 2.2))], states={"Faucet_1": {"isToggled": True}})
    mug = session.world.object("Mug_1")
    _play(session, "GoTo(Mug_1)", "Pick(right, Mug_1)", "GoTo(Faucet_1)", "Fill(right, Faucet_1)")
    assert mug.state.fillLiquid == "water" and mug.state.fillLitres >= 0.95 * mug.type.volume_l
    assert session.world.object("SinkBasin_1").state.fillLitres > 0.0, "the tap also ran when nothing was below it"
    assert session.world.liquids.balance_l() == pytest.approx(0.0, abs=1e-9)
    assert _code(session, "Fill(right, SinkBasin_1)") == "AlreadyInState"
