"""Belief, answers to failure codes, searching, and whole episodes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from configs.schema.robot import RobotConfig
from interface.belief import UNKNOWN, Belief
from interface.bodies import Arm
from interface.effects import Condition
from interface.episode import Outcome
from interface.observation import Camera, HistoryItem, Observation, Proprioception
from proprio_mllm.evaluation.episode import EpisodeKeyFields, Limits, run_episode
from proprio_mllm.evaluation.sessions import open_session
from proprio_mllm.planners.protocol import Planner, TaskInfo
from proprio_mllm.planners.scripted.planner import ScriptedPlanner
from sim.tasks.task import load_benchmark

KNOWN = ("CounterTop_1", "SideTable_1", "Fridge_1", "Drawer_1", "LightSwitch_1", "Faucet_1", "SinkBasin_1")


def history(*lines: str) -> tuple[HistoryItem, ...]:
    """Steps from their feedback texts."""
    return tuple(HistoryItem(" & ".join(part.rpartition(" ")[0] for part in line.split("; ")), line) for line in lines)


def answer(
    instruction: str, lines: Sequence[str] = (), seen: Sequence[str] = (), planner: ScriptedPlanner | None = None, seed: int = 0
) -> str:
    """What the planner does next after a history."""
    if planner is None:
        planner = ScriptedPlanner()
        planner.reset(TaskInfo(instruction, "h1", 20), np.random.default_rng(seed))
    body = Proprioception(np.zeros((64, 48), np.float32), 20.0, np.zeros(3), np.zeros((14, 3)))
    camera = Camera(np.eye(3), np.eye(4), 112, 112)
    image, known = np.zeros((112, 112, 3), np.uint8), (*KNOWN, *seen)
    shown = Observation(instruction, "h1", image, camera, tuple(seen), known, body, history(*lines), len(lines), 20)
    reply = planner.step(shown, None)
    assert reply.step is not None
    return reply.text


def test_belief_follows_hands_doors_and_places() -> None:
    belief = Belief.of(
        history(
            "GoTo(SideTable_1) ok",
            "Pick(right, Mug_1) ok; Pick(left, Cup_1) TooFar",
            "Open(left, Fridge_1) ok",
            "Place(right, Fridge_1) ok",
            "ToggleOn(left, LightSwitch_1) AlreadyInState",
            "nonsense InvalidOutput",
        )
    )
    assert belief.state.held == {Arm.RIGHT: None, Arm.LEFT: None}
    assert belief.state.at == {"Mug_1": "Fridge_1"}
    assert belief.state.conditions[Condition.OPEN] == {"Fridge_1": True}
    assert belief.state.conditions[Condition.ON] == {"LightSwitch_1": True}
    assert belief.state.here == "SideTable_1"
    assert belief.failures("Pick", "Cup_1") == [], "a success makes earlier failures moot"


def test_a_failure_beside_a_success_is_remembered() -> None:
    belief = Belief.of(history("Pick(left, Cup_1) TooFar; Pick(right, Mug_1) ok"))
    assert [event.code for event in belief.failures("Pick", "Cup_1")] == ["TooFar"]
    assert belief.state.arm_with("Mug_1") is Arm.RIGHT


@pytest.mark.parametrize(
    ("lines", "hands"),
    [
        (["Pick(right, Mug_1) ok", "Place(right, SideTable_1) PlaceMissed"], (None, None)),
        (["Pick(right, Mug_1) ok", "Place(right, SideTable_1) NothingHappened"], ("Mug_1", None)),
        (["Pick(right, Mug_1) Slipped"], (None, None)),
        (["Pick(left, Mug_1) HandOccupied"], (None, UNKNOWN)),
        (["Pick(right, Mug_1) AlreadyHeld"], (None, "Mug_1")),
        (["Open(right, Drawer_1) ok", "GoTo(Mug_1) InUse"], ("Drawer_1", None)),
        (["Open(right, Drawer_1) ok", "GoTo(Mug_1) InUse", "Release(right) ok"], (None, None)),
    ],
)
def test_belief_about_hands(lines: list[str], hands: tuple[str | None, str | None]) -> None:
    belief = Belief.of(history(*lines))
    assert (belief.state.held[Arm.RIGHT], belief.state.held[Arm.LEFT]) == hands


@pytest.mark.parametrize(
    ("code", "reply"),
    [
        ("BodyTooHigh", "MoveDown(0.1)"),
        ("BodyTooLow", "MoveUp(0.1)"),
        ("TooFar", "GoTo(Mug_1, auto, -20)"),
        ("Obstructed", "Pick(left, Mug_1)"),
        ("GraspMissed", "Pick(left, Mug_1)"),
        ("NothingHappened", "Pick(right, Mug_1)"),
        ("Slipped", "Pick(right, Mug_1)"),
        ("NeedsTwoHands", "Lift(Mug_1)"),
        ("HandOccupied", "Pick(left, Mug_1)"),
        ("NotPickupable", "Done()"),
    ],
)
def test_answers_to_codes_of_pick(code: str, reply: str) -> None:
    lines = ["GoTo(Mug_1) ok", f"Pick(right, Mug_1) {code}"]
    assert answer("Pick up the mug.", lines, ["Mug_1"]) == reply


def test_answers_continue() -> None:
    lines = ["GoTo(Mug_1) ok", "Pick(right, Mug_1) BodyTooHigh", "MoveDown(0.1) ok"]
    assert answer("Pick up the mug.", lines, ["Mug_1"]) == "Pick(right, Mug_1)"
    lines += ["Pick(right, Mug_1) BodyTooHigh"]
    assert answer("Pick up the mug.", lines, ["Mug_1"]) == "MoveDown(0.15)"
    lines += ["MoveDown(0.15) HeightLimit"]
    assert answer("Pick up the mug.", lines, ["Mug_1"]) == "Pick(right, Mug_1)", "a part of the way has been gone"
    lines += ["Pick(right, Mug_1) BodyTooHigh"]
    assert answer("Pick up the mug.", lines, ["Mug_1"]) == "GoTo(Mug_1, auto, -20)"
    lines += ["GoTo(Mug_1, auto, -20) NoFreePose"]
    assert answer("Pick up the mug.", lines, ["Mug_1"]) == "GoTo(Mug_1, auto, 20)"


def test_a_hopeless_action_is_given_up() -> None:
    lines = ["GoTo(Mug_1) ok", *["Pick(right, Mug_1) Obstructed"] * 16]
    assert answer("Pick up the mug.", lines, ["Mug_1"]) == "Done()"


def test_what_fails_by_chance_is_tried_again_where_it_is() -> None:
    lines = ["GoTo(Mug_1) ok", *["Pick(right, Mug_1) NothingHappened", "Pick(right, Mug_1) Slipped"] * 20]
    assert answer("Pick up the mug.", lines, ["Mug_1"]) == "Pick(right, Mug_1)"


def test_blocked_ways() -> None:
    lines = ["GoTo(Mug_1) BlockedPath"]
    assert answer("Pick up the mug.", lines, ["Mug_1"]).startswith("GoTo(Mug_1")
    assert answer("Pick up the mug.", lines * 2, ["Mug_1"]).startswith("Move")
    lines = ["GoTo(HousePlant_1) ok", "Lift(HousePlant_1) ok", "GoTo(SideTable_1) BlockedPath"]
    assert answer("Carry the plant to the side table.", lines, ["HousePlant_1"]).startswith("MoveUp")


def test_closed_things_are_opened_first() -> None:
    put = "Put the mug in the drawer."
    lines = ["GoTo(Mug_1) ok", "Pick(right, Mug_1) ok", "GoTo(Drawer_1) ok"]
    assert answer(put, lines, ["Mug_1"]) == "Open(left, Drawer_1)"
    assert answer(put, [*lines, "Open(left, Drawer_1) ok"], ["Mug_1"]) == "Place(right, Drawer_1)"
    on = ["GoTo(Box_1) ok", "Place(right, Box_1) ReceptacleClosed"]
    assert answer("Put the mug in the box.", ["Pick(right, Mug_1) ok", *on], ["Mug_1", "Box_1"]) == "Open(left, Box_1)"
    take = "Take the mug out of the fridge."
    assert answer(take) == "GoTo(Fridge_1)"
    assert answer(take, ["GoTo(Fridge_1) ok"]) == "Open(right, Fridge_1)"


def test_a_door_that_falls_shut_is_held() -> None:
    put = "Put the mug in the drawer, which falls shut when nothing holds it open."
    lines = ["GoTo(Mug_1) ok", "Pick(right, Mug_1) ok", "GoTo(Drawer_1) ok", "Open(left, Drawer_1) ok"]
    assert answer(put, lines, ["Mug_1"]) == "Place(right, Drawer_1)"
    assert answer(put, [*lines, "Place(right, Drawer_1) ok"], ["Mug_1"]) == "Release(left)"
    lines += ["Place(right, Drawer_1) ok", "Release(left) ok"]
    assert answer(put, lines, ["Mug_1"]) in ("Close(left, Drawer_1)", "Close(right, Drawer_1)")  # it may stand ajar
    assert answer(put, [*lines, "Close(left, Drawer_1) AlreadyInState"], ["Mug_1"]) == "Done()"
    assert answer(put, [*lines, "Close(left, Drawer_1) ok"], ["Mug_1"]) == "Done()"


def test_a_held_door_is_let_go_of_and_tried_from_elsewhere_with_the_other_arm() -> None:
    take = "Hold the drawer open with one hand, take the mug out, then let it fall shut."
    assert answer(take, ["GoTo(Drawer_1) ok"]) == "Open(right, Drawer_1)"
    lines = ["GoTo(Drawer_1) ok", "Open(right, Drawer_1) ok"]
    assert answer(take, lines, ["Mug_1"]) == "Pick(left, Mug_1)"
    lines += ["Pick(left, Mug_1) TooFar"]
    assert answer(take, lines, ["Mug_1"]) == "Release(right)"
    lines += ["Release(right) ok"]
    assert answer(take, lines, ["Mug_1"]) == "GoTo(Drawer_1, auto, -20)"
    assert answer(take, [*lines, "GoTo(Drawer_1, auto, -20) ok"], ["Mug_1"]) == "Open(left, Drawer_1)"


def test_a_door_that_stands_ajar_is_closed_before_it_is_opened_and_a_shut_one_left_alone_until_the_end() -> None:
    take = "Hold the drawer open with one hand, take the mug out, then let it fall shut."
    lines = ["GoTo(Drawer_1) ok", "Open(right, Drawer_1) AlreadyInState"]
    assert answer(take, lines) == "Close(right, Drawer_1)"
    assert answer(take, [*lines, "Close(right, Drawer_1) ok"]) == "Open(right, Drawer_1)"
    missed = ["GoTo(Drawer_1) ok", "Open(right, Drawer_1) ok", "Release(right) ok", "GoTo(Drawer_1, auto, -20) ok"]
    assert answer(take, missed) == "Open(left, Drawer_1)"


def test_what_was_too_far_is_walked_to_before_it_is_tried_again() -> None:
    both = "Hold the mug and the cup at the same time."
    near = [
        "GoTo(Cup_1) ok",
        "Pick(left, Cup_1) TooFar; Pick(right, Mug_1) BodyTooHigh",
        "MoveDown(0.1) ok",
        "Pick(right, Mug_1) ok",
    ]
    assert answer(both, near, ["Mug_1", "Cup_1"]) == "GoTo(Cup_1)"


def test_one_arm_after_the_other_then_another_stance() -> None:
    pick, lines = "Pick up the mug.", ["GoTo(Mug_1) ok", "Pick(right, Mug_1) GraspMissed"]
    assert answer(pick, lines, ["Mug_1"]) == "Pick(left, Mug_1)"
    assert answer(pick, [*lines, "Pick(left, Mug_1) Obstructed"], ["Mug_1"]).startswith("GoTo(Mug_1")
    lift = ["GoTo(Box_1) ok", "Lift(Box_1) GraspMissed"]
    assert answer("Lift the box.", lift, ["Box_1"]).startswith("GoTo(Box_1")


def test_what_rolls_away_is_held() -> None:
    lines = ["GoTo(Knife_1) ok", "Pick(right, Knife_1) ok", "GoTo(Apple_1) ok", "Slice(right, Apple_1) NeedsSteadying"]
    seen = ["Knife_1", "Apple_1"]
    assert answer("Slice the apple with the knife.", lines, seen) == "Hold(left, Apple_1)"
    assert answer("Slice the apple with the knife.", [*lines, "Hold(left, Apple_1) ok"], seen) == "Slice(right, Apple_1)"


def test_what_hangs_in_the_hand_that_held_it_has_to_rest_again() -> None:
    lines = ["GoTo(Knife_1) ok", "Pick(right, Knife_1) ok", "GoTo(Apple_1) ok", "Hold(left, Apple_1) ok", "MoveUp(0.1) ok"]
    lines += ["Slice(right, Apple_1) NeedsSteadying"]
    seen, task = ["Knife_1", "Apple_1"], "Slice the apple with the knife."
    assert answer(task, lines, seen) == "Release(left)"
    assert answer(task, [*lines, "Release(left) ok"], seen) == "Hold(left, Apple_1)"


def test_filling() -> None:
    lines = ["GoTo(Mug_1) ok", "Pick(right, Mug_1) ok", "GoTo(Faucet_1) ok"]
    fill = "Fill the mug at the sink."
    assert answer(fill, lines, ["Mug_1"]) == "ToggleOn(left, Faucet_1)"
    lines += ["ToggleOn(left, Faucet_1) ok"]
    assert answer(fill, lines, ["Mug_1"]) == "GoTo(SinkBasin_1)"
    assert answer(fill, [*lines, "GoTo(SinkBasin_1) ok"], ["Mug_1"]) == "Fill(right, SinkBasin_1)"


def test_both_arms_at_once() -> None:
    lines = ["GoTo(Mug_1) ok"]
    hold = "Hold the mug and the cup at the same time."
    assert answer(hold, lines, ["Mug_1", "Cup_1"]) == "Pick(right, Mug_1) & Pick(left, Cup_1)"
    lines += ["Pick(right, Mug_1) ok; Pick(left, Cup_1) TooFar"]
    assert answer(hold, lines, ["Mug_1", "Cup_1"]) == "GoTo(Cup_1)"
    put = ["Pick(right, Mug_1) ok; Pick(left, Cup_1) ok", "GoTo(CounterTop_1) ok"]
    both = "Place(right, CounterTop_1) & Place(left, CounterTop_1)"
    assert answer("Put the mug and the cup on the counter.", put, ["Mug_1", "Cup_1"]) == both


def test_both_arms_try_again_when_the_height_was_wrong() -> None:
    lines = ["GoTo(Mug_1) ok", "Pick(right, Mug_1) ok", "Pick(left, Cup_1) ok", "GoTo(SideTable_1) ok"]
    missed = "Place(right, SideTable_1) BodyTooHigh; Place(left, SideTable_1) BodyTooHigh"
    text, seen = "put the mug and the cup on the side table", ("Mug_1", "Cup_1")
    both = answer(text, lines, seen)
    assert both == "Place(right, SideTable_1) & Place(left, SideTable_1)"
    assert answer(text, [*lines, missed], seen) == "MoveDown(0.1)"
    assert answer(text, [*lines, missed, "MoveDown(0.1) ok"], seen) == both


def test_what_is_where_it_belongs_is_put_down_before_more_is_taken() -> None:
    text, seen = "put the mug and the cup on the side table, and the book on the counter", ("Mug_1", "Cup_1", "Book_1")
    lines = ["GoTo(Mug_1) ok", "Pick(right, Mug_1) ok", "Pick(left, Cup_1) ok", "GoTo(SideTable_1) ok"]
    half = "Place(right, SideTable_1) ok; Place(left, SideTable_1) BodyTooHigh"
    assert answer(text, [*lines, half], seen) == "MoveDown(0.1)"
    assert answer(text, [*lines, half, "MoveDown(0.1) ok"], seen).startswith("Place(left, SideTable_1)")


def test_what_is_steadied_is_let_go_of_before_it_is_taken() -> None:
    lines = ["GoTo(Mug_1) ok", "Hold(left, Mug_1) ok"]
    assert answer("pick up the mug", lines, ["Mug_1"]) == "Release(left)"
    assert answer("pick up the mug", [*lines, "Release(left) ok"], ["Mug_1"]).startswith("Pick(")


def test_what_is_in_hand_is_put_down_before_a_search() -> None:
    lines = ["GoTo(Mug_1) ok", "Pick(right, Mug_1) ok", "GoTo(CounterTop_1) ok"]
    assert answer("Put two mugs on the counter.", lines, ["Mug_1"]) == "Place(right, CounterTop_1)"
    assert answer("Put two mugs on the counter.", lines[:2], ["Mug_1", "Mug_2"]).endswith("Mug_2)")


def test_several_of_a_kind_are_told_apart_by_place() -> None:
    planner = ScriptedPlanner()
    planner.reset(TaskInfo("", "h1", 9), np.random.default_rng(0))
    pick = "Pick up the mug from the side table."
    assert answer(pick, [], ["Mug_2"]) == answer(pick, [], ["Mug_1", "Mug_2", "SideTable_1"]) == "GoTo(SideTable_1)"
    assert answer(pick, [], ["Mug_2", "SideTable_1"]) == "GoTo(Mug_2)"  # else one would see another there
    assert answer(pick, [], ["Mug_2"], planner) == "GoTo(SideTable_1)"
    assert answer(pick, ["GoTo(SideTable_1) ok"], ["Mug_2", "Mug_1"], planner) == "Pick(right, Mug_1)"


def test_search_looks_around_then_visits_the_furniture() -> None:
    def texts() -> list[str]:
        planner = ScriptedPlanner()
        planner.reset(TaskInfo("", "h1", 40), np.random.default_rng(0))
        lines: list[str] = []
        while len(lines) < 40:
            text = answer("Pick up the vase.", lines, (), planner)
            lines.append(f"{text} ok")
            if text == "Done()":
                break
        return lines

    found = texts()
    assert found[0].startswith("MoveUp")
    assert found[1].startswith("Rotate")
    assert {"GoTo(CounterTop_1) ok", "GoTo(SideTable_1) ok", "GoTo(Fridge_1) ok"} <= set(found)
    assert any(line.startswith("Open(") and "Fridge_1" in line for line in found)
    assert found[-1] == "Done() ok"
    assert texts() == found


def test_a_blocked_look_is_taken_once_more_and_no_later_one_twice() -> None:
    planner = ScriptedPlanner()
    planner.reset(TaskInfo("", "h1", 40), np.random.default_rng(0))
    lines: list[str] = []
    for code in ("ok", "BlockedPath", "ok", "ok", "ok", "ok", "ok"):
        lines.append(f"{answer('Pick up the vase.', lines, (), planner)} {code}")
    names = [line.partition("(")[0] for line in lines]
    assert names == ["MoveUp", "RotateLeft", "MoveBack", "RotateLeft", "RotateLeft", "RotateLeft", "GoTo"]


@pytest.mark.parametrize("text", ["", "hello", "x" * 10_000, "the " * 3_000, "put it in it", "Juggle the mug."])
def test_hostile_instructions_end_the_episode(text: str) -> None:
    assert answer(text, [], ["Mug_1"]) == "Done()"


@pytest.mark.parametrize("robot", ["h1", "x1"])
def test_an_episode_succeeds(robot: str) -> None:
    task = load_benchmark()[0]
    planner = ScriptedPlanner(image_size=28)
    assert isinstance(planner, Planner)
    fields = EpisodeKeyFields("scripted", robot, task.id, task.category, "easy", 0, 0, "")

    def session() -> object:
        return open_session(RobotConfig(robot), "easy", "fixed", task, 0, planner)

    record = run_episode(session, planner, fields, task.instruction, Limits(task.time_limit), 0)  # type: ignore[arg-type]
    assert record.outcome is Outcome.SUCCESS, record.message or record.trace
    assert record.steps <= task.time_limit
    assert record.invalid_output == 0
