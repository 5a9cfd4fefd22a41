"""Sessions: observations, statistics, goals, exact snapshots, determinism."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
import yaml

import robots
from interface.bodies import Arm
from interface.failures import FailureCode
from interface.steps import Action, PlanStep
from sim.scene.objects import ObjectPlacement
from sim.session.session import FreePlay, Session
from sim.tasks.predicates import Predicate
from sim.tasks.task import load_benchmark

MUG = ObjectPlacement("Mug_1", "CounterTop_1", (-1.15, 2.22))


@dataclass(frozen=True)
class Start:
    x_m: float
    y_m: float
    yaw_deg: float
    pelvis_height_m: dict[str, float]


TASK = FreePlay(
    "kitchen_1",
    "Bring the mug.",
    start=Start(-1.0, 1.0, 90.0, {"h1": 0.95}),
    placements=(MUG,),
    goals=(Predicate("held", "Mug_1"),),
    time_limit=8,
    seed=4,
)


def steps(session, *texts):
    return [session.step(PlanStep.parse(text))[1] for text in texts]


@pytest.fixture(scope="module")
def session():
    made = Session("h1", image_size=56)
    yield made
    made.close()


def test_success_takes_every_goal(session):
    there, held = Predicate("on", "Mug_1", "CounterTop_1"), Predicate("held", "Mug_1")
    for goals, status in (((there, held), (True, False)), ((there, there), (True, True)), ((), ())):
        session.reset(replace(TASK, goals=goals), 0)
        assert session.goal_status() == status
        assert session.succeeded == session.finished == (bool(status) and all(status))


def test_goals_are_read_when_things_have_come_to_rest(session):
    session.reset(replace(TASK, goals=(Predicate("on", "Mug_1", "CounterTop_1"),)), 0)
    mug, data = session.world.objects["Mug_1"], session.world.data
    data.qpos[mug.qpos_adr + 2] += 0.02
    data.qvel[mug.dof_adr + 1] = -3.0  # off over the front edge
    assert session.succeeded
    feedback = session.act(PlanStep.parse("Done()"))
    assert feedback.duration_s == 0.0 and not session.succeeded


def test_observation_holds_what_a_planner_may_see(session):
    seen = session.reset(TASK, 0)
    assert seen.image.shape == (56, 56, 3) and seen.robot == "h1" and seen.instruction == "Bring the mug."
    assert seen.proprioception.motion.shape == (64, 48) and np.isfinite(seen.proprioception.motion).all()
    assert "Mug_1" in seen.visible_objects and "Fridge_1" in seen.known_objects
    assert seen.history == () and seen.step == 0 and seen.time_limit == 8
    pose = seen.camera.camera_in_pelvis
    assert np.allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-9)
    assert 0.3 < pose[2, 3] < 1.0 and pose[2, 2] < 0.0  # above the pelvis, looking down
    assert session.world.servos.base_pose[2] == pytest.approx(0.95, abs=0.01)


def test_fetching_the_mug(session):
    session.reset(TASK, 0)
    assert session.goal_status() == (False,) and not session.finished
    assert steps(session, "GoTo(Mug_1)")[0].success
    refusal = session.assess(Action.parse("Pick(right, Mug_1)"))
    while refusal is not None:
        assert refusal.code in (FailureCode.BODY_TOO_HIGH, FailureCode.BODY_TOO_LOW)
        change = refusal.margins["height_m"]
        steps(session, f"{'MoveUp' if change > 0 else 'MoveDown'}({max(abs(change), 0.05):.2f})")
        refusal = session.assess(Action.parse("Pick(right, Mug_1)"))
    assert steps(session, "Pick(right, Mug_1)")[0].success
    assert session.goal_status() == (True,) and session.succeeded and session.finished
    assert session.body.hands.held[Arm.RIGHT] == "Mug_1"
    assert session.stats.path_length_m > 0.2 and session.stats.makespan_s > 2.0
    assert 0.0 < session.stats.arm_utilisation <= 0.5
    assert session.observation().history[-1].feedback == "Pick(right, Mug_1) ok"


def test_restoring_and_repeating_is_bit_equal(session):
    session.reset(TASK, 0)
    steps(session, "GoTo(Mug_1)", "MoveDown(0.1)")
    saved = session.snapshot()
    first = steps(session, "Pick(right, Mug_1)", "MoveUp(0.05)")
    physics = session.world.data.qpos.copy(), session.world.data.qvel.copy(), session.stats, session.history
    session.restore(saved)
    assert session.body.hands.held[Arm.RIGHT] is None and session.stats == saved.stats
    assert steps(session, "Pick(right, Mug_1)", "MoveUp(0.05)") == first
    assert np.array_equal(session.world.data.qpos, physics[0]) and np.array_equal(session.world.data.qvel, physics[1])
    assert (session.stats, session.history) == physics[2:]


def test_same_seed_and_actions_give_the_same_trajectory(session):
    texts = ("GoTo(Mug_1)", "MoveDown(0.1)", "Pick(left, Mug_1)")
    ends = []
    for _ in range(2):
        session.reset(TASK, 3)
        steps(session, *texts)
        ends.append((session.world.data.qpos.copy(), session.history))
    assert np.array_equal(ends[0][0], ends[1][0]) and ends[0][1] == ends[1][1]


def test_unseen_objects_are_not_known(session):
    hidden = FreePlay("kitchen_1", start=Start(0.0, 0.0, -90.0, {}), placements=(MUG,))
    session.reset(hidden, 0)
    assert "Mug_1" not in session.known_objects
    assert steps(session, "GoTo(Mug_1)")[0].outcomes[0].code == "ObjectNotKnown"
    steps(session, "RotateLeft(180)")
    assert "Mug_1" in session.known_objects


def test_luck_is_keyed_by_the_seed():
    task = FreePlay("kitchen_1", start=Start(0.85, 1.75, 90.0, {"h1": 0.9}), placements=())
    codes = set()
    made = Session("h1", "hard", 0)
    made.reset(task, 0)
    saved = made.snapshot()
    for seed in range(3):
        made._contingency = type(made._contingency)(made._contingency.config, "hard", seed)
        made.restore(saved)
        codes.add(made.draw(Action.parse("ToggleOn(left, StoveKnob_1)")))
    assert codes <= {"success", "nothing"}
    made.close()


def test_the_budget_charges_no_step_that_chance_spoils():
    made = Session("h1", "hard", 0, step_limit=2)
    made.reset(TASK, 3)
    steps(made, "GoTo(Mug_1)")
    struck = []
    while not made.finished:
        _, feedback = made.step(PlanStep.parse("Pick(left, Mug_1)"))
        struck.append(bool(feedback.outcomes[0].contingency))
        assert made.observation().step == made.stats.charged
    assert sum(struck) == made.stats.struck > 0
    assert (made.stats.charged, made.stats.steps) == (2, 1 + len(struck))
    made.close()


def test_done_ends_the_episode(session):
    session.reset(TASK, 0)
    feedback = steps(session, "Done()")[0]
    assert feedback.success and session.finished and session.ended
    with pytest.raises(RuntimeError, match="the episode is over"):
        steps(session, "MoveBack(0.1)")
    with pytest.raises(RuntimeError, match="no episode"):
        Session("h1").step(PlanStep.parse("Done()"))


def test_a_robot_described_elsewhere_acts(tmp_path: Path) -> None:
    source = Path(robots.__file__).parent / "specs" / "x1.yaml"
    values = yaml.safe_load(source.read_text(encoding="utf-8"))
    values |= {"name": "mine", "mjcf": str((source.parent / values["mjcf"]).resolve())}
    (tmp_path / "mine.yaml").write_text(yaml.safe_dump(values), encoding="utf-8")
    session = Session(str(tmp_path / "mine.yaml"), image_size=0)
    try:
        session.reset(next(task for task in load_benchmark() if task.room == "kitchen_1"), seed=0)
        assert session.robot.name == "mine"
        assert session.act(PlanStep.parse("GoTo(StoveKnob_2)")).success
        assert session.assess(PlanStep.parse("Pick(left, StoveKnob_2)").actions[0]) is not None
    finally:
        session.close()


def test_what_is_visible_does_not_depend_on_the_picture() -> None:
    seen = set()
    for size in (0, 16, 112, 200):
        made = Session("h1", "easy", size)
        observation = made.reset(TASK, 3)
        assert observation.image.shape == (size, size, 3)
        seen.add((observation.visible_objects, observation.known_objects))
        made.close()
    assert len(seen) == 1 and "Mug_1" in next(iter(seen))[0]
