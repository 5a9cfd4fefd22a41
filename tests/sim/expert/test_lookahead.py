"""What the expert asks the simulator in thought: answers agree with what then happens, and nothing is left moved."""

import numpy as np
import pytest

from interface.bodies import Arm
from interface.steps import Action
from sim.expert.expert import Expert
from sim.expert.lookahead import Lookahead
from sim.session.session import Session
from sim.tasks.sample import sample_task

DRAWER = "Drawer_1"


@pytest.fixture(scope="module")
def session():
    """H1 with something in one hand, before a drawer that falls shut, as the expert would go on."""
    session = Session("h1", "easy", image_size=0)
    task = sample_task(2, "bedroom_2", "store_ajar", "benchmark")
    session.reset(task, seed=task.seed)
    expert = Expert(session)
    expert.reset()
    while not any(session.body.hands.held.values()):
        session.step(expert.next_step())
    yield session
    session.close()


def _ways(session):
    bearer = next(arm for arm in Arm if session.body.hands.held[arm] is not None)
    return Action("Open", bearer.other, DRAWER), Action("Place", bearer, DRAWER)


def test_a_drawer_is_imagined_open_before_it_is_opened_in_thought(session):
    lookahead, (first, then) = Lookahead(session), _ways(session)
    here = session.body.posture.stance()
    stances = [lookahead.stance_of(Action("GoTo", object_id=DRAWER, bearing_deg=b)) for b in (None, -20.0, 20.0)]
    before, openness = session.world.data.qpos.copy(), session.world.objects[DRAWER].openness
    asked = {
        (number, height): (
            lookahead.might_lead_to(first, then, stance, height),
            lookahead.leads_to(first, then, stance, height),
        )
        for number, stance in enumerate(stances)
        if stance is not None
        for height in lookahead.heights_m()[:3]
    }
    assert any(acted for _, acted in asked.values()), asked
    assert all(might or not acted for might, acted in asked.values()), "nothing is ruled out that works"
    assert not lookahead.might_lead_to(first, then, here, session.body.posture.pelvis_height_m), "too far away from here"
    assert session.world.objects[DRAWER].openness == openness < 0.02
    assert np.array_equal(session.world.data.qpos, before)


def test_two_arms_together_need_both_targets_in_reach(session):
    lookahead, (first, then) = Lookahead(session), _ways(session)
    assert not lookahead.works_together([(first, then)], session.body.posture.stance())
    stance = lookahead.stance_of(Action("GoTo", object_id=DRAWER))
    assert not lookahead.works_together([(first, then)], stance), "what is shut cannot be filled"
