"""Drawers: the geometry that a push is planned with, and both robots that shut what they or others left open."""

import numpy as np
import pytest

from interface.bodies import Arm
from interface.steps import Action, PlanStep
from sim.scene.objects import ObjectPlacement
from sim.session.session import FreePlay, Session
from sim.skills.articulate import assess_open_close
from sim.skills.body.ready import ready_posture
from sim.skills.door import Door
from sim.skills.push_door import Push

NAME = "Drawer_1"


@pytest.fixture(scope="module", params=["h1", "x1"])
def session(request):
    made = Session(request.param, image_size=0, all_known=True)
    yield made
    made.close()


def act(session, text):
    return session.act(PlanStep.parse(text)).outcomes[0]


def start(session, openness):
    phone = ObjectPlacement("CellPhone_1", NAME)
    session.reset(FreePlay("kitchen_1", placements=(phone,), states={NAME: {"openness": openness}}), 0)
    return session.body


def test_the_front_of_a_drawer_is_where_its_geometry_says(session):
    body = start(session, 0.5)
    part = body.obj(NAME).moving[0]
    model, data = session.world.model, session.world.data
    panel = next(geom for geom in np.flatnonzero(model.geom_bodyid == part.body_id) if model.geom_aabb[geom, 5] > 0.07)
    door = Door.of(body, body.obj(NAME), part)
    assert door.slides and door.now == pytest.approx(0.13, abs=2e-3)
    middle = data.geom_xpos[panel]
    face = door.point(door.now, 0.5 * door.width_m, float(middle[2]))
    assert face == pytest.approx(middle + model.geom_aabb[panel, 4] * door.front, abs=1e-6)
    assert door.point(door.now + 0.1, 0.1, 0.8) - door.point(door.now, 0.1, 0.8) == pytest.approx(0.1 * door.front, abs=1e-9)
    ahead = face[:2] + 0.3 * door.front[:2]
    assert door.distance_m(ahead[None], door.now) == pytest.approx(0.3, abs=1e-6)
    assert door.distance_m(ahead[None], 0.0) == pytest.approx(0.3 + door.now, abs=1e-6)
    assert part.travel_m(-0.2) == pytest.approx(0.2)


@pytest.mark.parametrize("arm", Arm)
def test_a_drawer_that_stands_wide_open_is_pushed_shut(session, arm):
    body = start(session, 1.0)
    inside = body.world.poses.center("CellPhone_1") - session.world.poses.handle(NAME)
    assert act(session, f"GoTo({NAME})").success
    assert isinstance(assess_open_close(body, Action("Close", arm=arm, object_id=NAME)), Push)
    outcome = act(session, f"Close({arm}, {NAME})")
    assert outcome.success, outcome
    assert session.world.objects[NAME].openness < 0.02
    assert np.linalg.norm(body.world.poses.center("CellPhone_1") - session.world.poses.handle(NAME) - inside) < 0.03
    assert all(np.allclose(body.arms.commanded(each), ready_posture(body.kit, each), atol=1e-6) for each in Arm)
    assert act(session, f"Close({arm}, {NAME})").code == "AlreadyInState"


def test_either_arm_shuts_what_the_other_opened(session):
    start(session, 0.0)
    act(session, f"GoTo({NAME})")
    refusal = session.assess(Action("Open", arm=Arm.LEFT, object_id=NAME))
    if refusal is not None:
        change = refusal.margins["height_m"]
        act(session, f"{'MoveUp' if change > 0 else 'MoveDown'}({max(abs(change), 0.03):.2f})")
    assert act(session, f"Open(left, {NAME})").success and session.world.objects[NAME].openness > 0.6
    before = session.snapshot()
    for arm in Arm:
        session.restore(before)
        outcome = act(session, f"Close({arm}, {NAME})")
        assert outcome.success and session.world.objects[NAME].openness < 0.02, outcome
