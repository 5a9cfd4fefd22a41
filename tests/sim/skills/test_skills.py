"""Skills in physics on both robots: what they achieve, and the codes of what they refuse."""

import numpy as np
import pytest

from interface.bodies import Arm
from interface.failures import FailureCategory, FailureCode
from interface.steps import Action, PlanStep
from sim.interfaces.metadata import world_metadata
from sim.scene.objects import ObjectPlacement
from sim.session.session import FreePlay, Session
from sim.skills.articulate import assess_open_close
from sim.skills.body.body import Body
from sim.skills.body.ready import ready_posture
from sim.skills.failures import SkillFailure
from sim.skills.navigation import Stance
from sim.skills.plan_cache import cached_plan
from sim.skills.push_door import Push
from sim.skills.runner import TwoTicks, refuse, run_skills
from sim.skills.set_down import assess_place_both
from sim.world.world import World

THINGS = (
    ObjectPlacement("Mug_1", "CounterTop_1", (-1.15, 2.19)),
    ObjectPlacement("Apple_1", "CounterTop_1", (-0.75, 2.19)),
    ObjectPlacement("Bottle_1", "CounterTop_2", (1.5, 2.19)),
)
ROOM = FreePlay("kitchen_1", placements=THINGS)


@pytest.fixture(scope="module", params=["h1", "x1"])
def session(request):
    made = Session(request.param, image_size=0)
    yield made
    made.close()


def start(session, task=ROOM):
    session.reset(task, 0)
    session._seen.update(session.world.objects)
    return session


def act(session, text):
    return session.act(PlanStep.parse(text)).outcomes


def reach(session, text):
    """Goes to the target and bends until the action is possible; then does it."""
    action = PlanStep.parse(text).actions[0]
    for place in ("", ", 0.45", ", 0.55"):
        act(session, f"GoTo({action.object_id}{place})")
        for _ in range(4):
            refusal = session.assess(action)
            if refusal is None:
                return act(session, text)[0]
            change = refusal.margins.get("height_m")
            if change is None:
                break
            act(session, f"{'MoveUp' if change > 0 else 'MoveDown'}({max(abs(change), 0.03):.2f})")
    raise AssertionError(f"{text}: {refusal}")


def test_pick_carry_and_place(session):
    start(session)
    assert reach(session, "Pick(right, Mug_1)").success
    assert session.body.hands.held[Arm.RIGHT] == "Mug_1" and session.world.containment.parents("Mug_1") == ()
    assert act(session, "Pick(right, Apple_1)")[0].code == "HandOccupied"
    assert act(session, "Pick(left, Mug_1)")[0].code == "AlreadyHeld"
    assert reach(session, "Place(right, CounterTop_1)").success
    assert session.body.hands.held[Arm.RIGHT] is None and "CounterTop_1" in session.world.containment.parents("Mug_1")


def test_a_drawer_opens_and_closes(session):
    start(session)
    assert reach(session, "Open(left, Drawer_1)").success
    assert session.world.objects["Drawer_1"].is_open
    assert act(session, "Open(left, Drawer_1)")[0].code == "AlreadyInState"
    assert reach(session, "Close(left, Drawer_1)").success
    assert session.world.objects["Drawer_1"].openness < 0.07


def close_with_some_arm(session, door):
    """Closes a door with the arm that can, as a planner would find out; returns what happened."""
    outcomes = []
    for arm in Arm:
        outcomes += act(session, f"Close({arm}, {door})")
        if outcomes[-1].success:
            break
    return outcomes[-1]


def stands_as_before(session, before):
    """Whether no movable object was moved by more than 3 cm and both arms are home."""
    moved = [name for name, place in before.items() if np.linalg.norm(session.world.poses.center(name)[:2] - place[:2]) > 0.03]
    home = all(np.allclose(session.body.arms.commanded(arm), ready_posture(session.body.kit, arm), atol=1e-6) for arm in Arm)
    return not moved and home


def places(session, door):
    others = (name for name, obj in session.world.objects.items() if obj.movable and name != door)
    return {name: session.world.poses.center(name) for name in others}


@pytest.mark.parametrize("door", ["Microwave_1", "Cabinet_1", "Fridge_1"])
def test_a_door_that_stands_open_is_pushed_shut(session, door):
    start(session, FreePlay("kitchen_1", states={door: {"isOpen": True}}, placements=THINGS))
    before = places(session, door)
    assert act(session, f"GoTo({door})")[0].code in ("", "BlockedPath")  # an arm may run into the open door on the way
    outcome = close_with_some_arm(session, door)
    assert outcome.success, outcome
    assert session.world.objects[door].openness < 0.12
    assert session.body.hands.held == dict.fromkeys(Arm) and stands_as_before(session, before)
    assert act(session, f"Close(left, {door})")[0].code in ("AlreadyInState", "")


def test_a_push_that_walks_has_no_company(session):
    start(session, FreePlay("kitchen_1", states={"Cabinet_1": {"isOpen": True}}, placements=THINGS))
    act(session, "GoTo(Cabinet_1)")
    assert assess_open_close(session.body, Action.parse("Close(left, Cabinet_1)")).walks
    codes = [outcome.code for outcome in act(session, "Close(left, Cabinet_1) & ResetArm(right)")]
    assert codes == ["ArmConflict", "ArmConflict"]


def test_what_a_robot_opens_it_closes_again(session):
    start(session)
    assert reach(session, "Open(left, Microwave_1)").success
    assert session.world.objects["Microwave_1"].is_open
    outcome = close_with_some_arm(session, "Microwave_1")
    assert outcome.success, outcome
    assert session.world.objects["Microwave_1"].openness < 0.12


def test_a_door_far_away_is_not_walked_to(session):
    start(session, FreePlay("kitchen_1", states={"Cabinet_1": {"isOpen": True}}))
    session.teleport(1.0, 0.8, 0.0)
    outcome = act(session, "Close(left, Cabinet_1)")[0]
    assert outcome.code == "TooFar" and outcome.margins["reach_m"] > 0.0 and session.world.time_s == 0.0


def test_a_push_is_planned_without_moving_anything_and_always_alike(session):
    start(session, FreePlay("kitchen_1", states={"Cabinet_1": {"isOpen": True}}))
    act(session, "GoTo(Cabinet_1)")
    body, action = session.body, Action.parse("Close(left, Cabinet_1)")
    before = (session.world.data.qpos.copy(), session.world.data.ctrl.copy(), body.planning_state())
    plans = []
    for _ in range(2):
        body.plans.state = None
        plans.append(assess_open_close(body, action))
    assert all(isinstance(plan, Push) for plan in plans)
    assert np.array_equal(plans[0].postures, plans[1].postures) and np.array_equal(plans[0].stances, plans[1].stances)
    assert np.array_equal(session.world.data.qpos, before[0]) and np.array_equal(session.world.data.ctrl, before[1])
    assert body.planning_state() == before[2]


def test_a_hypothesis_is_a_value_and_part_of_what_plans_depend_on(session):
    start(session)
    body = session.body
    state, base, height = body.planning_state(), body.posture.stance(), body.posture.pelvis_height_m
    there = body.assuming(stance=Stance(0.5, 0.5, 0.1))
    assert there.planning_state() != state and there.posture.stance() == Stance(0.5, 0.5, 0.1)
    lower = there.assuming(pelvis_height_m=0.8)
    assert (lower.posture.stance(), lower.posture.pelvis_height_m) == (Stance(0.5, 0.5, 0.1), 0.8)
    assert body.assuming(diagnose=False).planning_state() != state
    assert (body.planning_state(), body.posture.stance(), body.posture.pelvis_height_m) == (state, base, height)


def test_postures_from_an_assumed_stance_are_those_from_there(session):
    start(session)
    body = session.body
    q, base = body.arms.commanded(Arm.LEFT), body.posture.stance()
    moved = body.assuming(stance=Stance(base.x + 0.3, base.y - 0.1, base.yaw_rad))
    assert np.allclose(moved.ik.hand_at(Arm.LEFT, q) - body.ik.hand_at(Arm.LEFT, q), (0.3, -0.1, 0.0))


def test_a_switch_is_pressed(session):
    start(session)
    assert reach(session, "ToggleOn(left, StoveKnob_1)").success
    assert session.world.objects["StoveKnob_1"].state.isToggled and session.world.objects["StoveBurner_1"].state.isToggled
    assert act(session, "ToggleOn(left, StoveKnob_1)")[0].code == "AlreadyInState"


@pytest.mark.parametrize(
    ("room", "counter"), [("kitchen_2", ("CounterTop_1", (-0.6, 2.1))), ("bathroom_1", ("CounterTop_1", (0.2, 1.42)))]
)
def test_a_tap_beside_its_basin_fills_a_mug(session, room, counter):
    start(session, FreePlay(room, placements=(ObjectPlacement("Mug_1", *counter),)))
    assert reach(session, "ToggleOn(left, Faucet_1)").success and session.world.objects["Faucet_1"].state.isToggled
    arm = {"x1": "left", "h1": "right"}[session.robot.name]
    assert reach(session, f"Pick({arm}, Mug_1)").success
    assert reach(session, f"Fill({arm}, Faucet_1)").success
    assert session.world.objects["Mug_1"].state.fillLitres > 0.1


@pytest.mark.parametrize(
    ("text", "code"),
    [
        ("Pick(left, Fridge_1)", "NotPickupable"),
        ("Place(left, CounterTop_1)", "HandEmpty"),
        ("Open(left, CounterTop_1)", "NotOpenable"),
        ("ToggleOn(left, Fridge_1)", "NotToggleable"),
        ("Lift(Fridge_1)", "NotLiftable"),
        ("Lift(Mug_1)", "NotLiftable"),
        ("PlaceBoth(CounterTop_1)", "HandEmpty"),
        ("Close(left, Fridge_1)", "AlreadyInState"),
        ("Pick(left, Mug_1)", "TooFar"),
        ("GoTo(Unicorn_1)", "ObjectNotKnown"),
    ],
)
def test_refusals_move_nothing(session, text, code):
    start(session)
    outcome = act(session, text)[0]
    assert not outcome.success and outcome.code == code
    assert session.world.time_s == 0.0
    assert outcome.category is (FailureCategory.NAVIGATION if code == "TooFar" else FailureCategory.LOGICAL)


def test_moves_stop_at_obstacles(session):
    start(session)
    outcome = act(session, "MoveAhead(5)")[0]
    assert outcome.code == "BlockedPath" and 0.5 < outcome.margins["travel_m"] < 5.0
    assert session.stats.path_length_m == pytest.approx(outcome.margins["travel_m"], abs=0.05)


def test_rotation_and_sidestep(session):
    start(session)
    before = session.world.servos.base_pose.copy()
    assert act(session, "RotateLeft(90)")[0].success and act(session, "MoveRight(0.2)")[0].success
    after = session.world.servos.base_pose
    assert after[3] - before[3] == pytest.approx(np.pi / 2, abs=0.02)
    shift = after[:2] - before[:2]
    right = np.array([np.sin(after[3]), -np.cos(after[3])])
    assert shift @ right == pytest.approx(0.2, abs=0.02)


def test_pelvis_height_follows_the_legs_limits(session):
    start(session)
    low, high = session.robot.pelvis_height_range_m
    outcome = act(session, "MoveDown(0.9)")[0]
    assert outcome.code == "HeightLimit" and outcome.category is FailureCategory.BODY_ADJUSTMENT
    assert session.world.servos.base_pose[2] == pytest.approx(low, abs=0.01)
    assert outcome.margins["height_m"] == pytest.approx(high - 0.9 - low, abs=0.01)
    soles = [session.world.data.site(f"{side}_sole").xpos[2] for side in ("left", "right")]
    assert np.abs(soles).max() < 0.02


def test_parallel_arms_share_one_clock_and_one_object_is_a_conflict(session):
    start(session)
    pair = act(session, "ResetArm(left) & ResetArm(right)")
    assert all(outcome.success for outcome in pair)
    pair = act(session, "Pick(left, Mug_1) & Pick(right, Mug_1)")
    assert [outcome.code for outcome in pair] == ["ArmConflict", "ArmConflict"]


def test_hidden_in_a_closed_fridge(session):
    inside = FreePlay("kitchen_1", placements=(ObjectPlacement("Apple_1", "Fridge_1"),))
    start(session, inside)
    assert act(session, "Pick(left, Apple_1)")[0].code == "ReceptacleClosed"


def test_two_hands_lift_a_box():
    made = Session("h1", image_size=0)
    start(made, FreePlay("living_room_1", placements=(ObjectPlacement("Box_1", "CoffeeTable_1"),)))
    assert act(made, "Pick(left, Box_1)")[0].code == "NeedsTwoHands"
    assert reach(made, "Lift(Box_1)").success
    assert made.body.hands.lifted == "Box_1" and world_metadata(made.world)["inventoryObjects"][0]["arms"] == ["left", "right"]
    assert act(made, "ResetArm(left)")[0].code == "BothHandsBusy"
    assert reach(made, "PlaceBoth(Desk_1)").success
    assert "Desk_1" in made.world.containment.parents("Box_1")
    made.close()


@pytest.mark.parametrize("robot", ["h1", "x1"])
def test_a_load_that_is_carried_low_comes_up_before_the_desk(robot):
    """The arms raise it over the edge, or say how much higher the pelvis has to be; it never meets the desk's front."""
    made = Session(robot, image_size=0)
    plant = ObjectPlacement("HousePlant_1", "CoffeeTable_1", (-0.08, -0.9))
    start(made, FreePlay("living_room_1", placements=(plant,)))
    assert reach(made, "Lift(HousePlant_1)").success
    top = 0.8
    act(made, "GoTo(Desk_1)")
    assert made.world.poses.bounds("HousePlant_1")[0][2] < top
    action, verdicts = Action.parse("PlaceBoth(Desk_1)"), []
    for _ in range(4):
        verdicts.append(made.assess(action))
        if verdicts[-1] is None:
            break
        assert verdicts[-1].code is FailureCode.BODY_TOO_LOW and verdicts[-1].margins["height_m"] > 0.0
        act(made, f"MoveUp({max(verdicts[-1].margins['height_m'], 0.03):.2f})")
    assert verdicts[-1] is None
    plan = assess_place_both(made.body, action)
    assert plan.raised is not None and plan.surface_m == pytest.approx(top, abs=0.01)
    assert act(made, "PlaceBoth(Desk_1)")[0].success
    assert "Desk_1" in made.world.containment.parents("HousePlant_1")
    made.close()


def test_contingencies_are_acted_out():
    made = Session("h1", "hard", 0)
    start(made)
    act(made, "GoTo(Mug_1)")
    made.draw = lambda action: "broken"  # type: ignore[method-assign]
    outcome = reach(made, "Pick(right, Mug_1)")
    assert (outcome.code, outcome.contingency) == ("Broke", "broken")
    assert made.world.objects["Mug_1"].state.isBroken and made.body.hands.held[Arm.RIGHT] is None
    made.close()


def test_refuse_and_runaway_skills():
    action = PlanStep.parse("ResetArm(left)").actions[0]
    outcome = run_skills([(action, refuse(FailureCode.ARM_CONFLICT))], lambda: None)[0]
    assert outcome.code == "ArmConflict"

    def endless():
        while True:
            yield

    with pytest.raises(RuntimeError, match=r"skills did not end within 120 s: \['ResetArm\(left\)'\]"):
        run_skills([(action, endless())], lambda: None)
    assert isinstance(SkillFailure(FailureCode.DROPPED), Exception)


def test_a_contact_counts_when_it_holds_twice_running() -> None:
    touches = TwoTicks()
    assert [touches(now) for now in (True, False, True, True, False)] == [False, False, False, True, False]


def test_a_world_without_robot_is_refused():
    with pytest.raises(ValueError, match="need a world with a robot"):
        Body(World(None, "kitchen_1", settle_s=0.0))


def test_a_plan_is_made_once_until_something_changes(session):
    """Commands, states and the height that is considered decide about a plan; asked again from one state it is the same."""
    start(session)
    made = []

    @cached_plan
    def plan(body, action):
        made.append(action)
        return object()

    body, action = session.body, Action("ResetArm", arm=Arm.LEFT)
    first = plan(body, action)
    assert plan(body, action) is first and len(made) == 1
    assert plan(body, Action("ResetArm", arm=Arm.RIGHT)) is not first
    session.world.states.set_state("Mug_1", "isDirty", True)
    second = plan(body, action)
    assert second is not first
    body.hands.command(Arm.LEFT, 0.5)
    assert plan(body, action) is not second
    assert plan(body.assuming(pelvis_height_m=0.8), action) is not second
