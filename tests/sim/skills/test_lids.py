"""Lids, covers and screens: they open and close, stay where they are left, and shut away what is below them."""

from __future__ import annotations

from dataclasses import replace

import mujoco
import numpy as np
import pytest

from interface.steps import PlanStep
from robots.spec import load_robot
from sim.interfaces.metadata import world_metadata
from sim.scene.catalogue import load_catalogue
from sim.scene.compiler import build_type_spec
from sim.scene.objects import ObjectPlacement, index_object
from sim.session.session import FreePlay, Session
from sim.world.world import World

LIDDED = ("Box", "Book", "Kettle", "Laptop", "Toilet", "LaundryHamper")


def alone(name, openness):
    """A type alone on a floor with its lid somewhere."""
    model = build_type_spec(name).compile()
    data = mujoco.MjData(model)
    obj = index_object(model, f"{name}_1", load_catalogue())
    data.qpos[obj.moving[0].qpos_adr] = openness * obj.moving[0].range[1]
    mujoco.mj_forward(model, data)
    return model, data, obj


def entry(world, name):
    return next(found for found in world_metadata(world)["objects"] if found["objectId"] == name)


def act(session, text):
    return session.act(PlanStep.parse(text)).outcomes[0]


def reach(session, text):
    """Goes to the target and bends until the action is possible; then does it."""
    action = PlanStep.parse(text).actions[0]
    refusal = None
    for place in ("", ", 0.45", ", 0.55"):
        act(session, f"GoTo({action.object_id}{place})")
        for _ in range(4):
            refusal = session.assess(action)
            if refusal is None:
                return act(session, text)
            change = refusal.margins.get("height_m")
            if change is None:
                break
            act(session, f"{'MoveUp' if change > 0 else 'MoveDown'}({max(abs(change), 0.03):.2f})")
    raise AssertionError(f"{text}: {refusal}")


def test_every_openable_type_has_something_that_moves():
    for kind in load_catalogue().types.values():
        assert kind.has("openable") == kind.openable, kind.name
    assert {name for name, kind in load_catalogue().types.items() if kind.lidded} == set(LIDDED)


@pytest.mark.parametrize("name", LIDDED)
@pytest.mark.parametrize("openness", [0.0, 0.25, 0.5, 1.0])
def test_a_lid_stays_where_it_is_left(name, openness):
    model, data, obj = alone(name, openness)
    part = obj.moving[0]
    before = data.qpos[part.qpos_adr]
    mujoco.mj_step(model, data, round(5.0 / model.opt.timestep))
    assert data.qpos[part.qpos_adr] == pytest.approx(before, abs=0.08)
    assert data.xmat[obj.body_id].reshape(3, 3)[2, 2] > 0.999  # an open one does not tip its object over


@pytest.mark.parametrize("name", LIDDED)
def test_a_lid_is_a_share_of_its_object(name):
    kind, (model, data, obj) = load_catalogue().get(name), alone(name, 0.0)
    lid = float(model.body_mass[obj.moving[0].body_id])
    if kind.movable:
        assert obj.mass_kg == pytest.approx(kind.mass) and 0.0 < lid < 0.25 * obj.mass_kg
    closed = np.concatenate([obj.local_min, obj.local_max])
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for geom in obj.geom_ids:
        center = data.geom_xpos[geom] + data.geom_xmat[geom].reshape(3, 3) @ model.geom_aabb[geom, :3]
        half = np.abs(data.geom_xmat[geom].reshape(3, 3)) @ model.geom_aabb[geom, 3:]
        low, high = np.minimum(low, center - half), np.maximum(high, center + half)
    assert np.concatenate([low, high]) == pytest.approx(closed, abs=1e-6)
    if name == "Laptop":
        assert obj.height_m == pytest.approx(0.03, abs=0.001)
        _, data, _ = alone(name, 1.55 / 1.9)
        assert data.site_xpos[obj.moving[0].handle_site][2] == pytest.approx(0.3, abs=0.01)


@pytest.fixture(scope="module")
def world():
    """A bedroom with lids in all positions, and things below closed ones."""
    placements = (
        ObjectPlacement("Box_1", "Desk_1", (-1.08, -2.44), yaw_deg=180.0),
        ObjectPlacement("Box_2", "Bed_1", (-1.2, 1.1), state={"isOpen": True}),
        ObjectPlacement("Laptop_1", "Desk_1", (-0.52, -2.44), yaw_deg=180.0),
        ObjectPlacement("Book_1", "Desk_1", (-0.08, -2.44), yaw_deg=180.0, state={"openness": 0.5}),
        ObjectPlacement("CellPhone_1", "Box_1"),
        ObjectPlacement("CellPhone_2", "LaundryHamper_1"),
    )
    made = World(load_robot("h1"), "bedroom_1", placements)
    yield made
    made.cameras.close()


def test_metadata_tells_what_is_open(world):
    for name, is_open, openness in (
        ("Box_1", False, 0.0),
        ("Box_2", True, 1.0),
        ("Laptop_1", True, 0.85),
        ("Book_1", True, 0.5),
        ("LaundryHamper_1", False, 0.0),
    ):
        found = entry(world, name)
        assert found["openable"] and found["isOpen"] == is_open, name
        assert found["openness"] == pytest.approx(openness, abs=0.02), name
    assert entry(world, "CellPhone_1")["parentReceptacles"][0] == "Box_1"
    assert entry(world, "CellPhone_2")["parentReceptacles"] == ["LaundryHamper_1"]


def test_a_half_open_lid_is_restored_to_the_bit(world):
    snapshot = world.save()
    world.advance(0.5)
    after = world.data.qpos.copy()
    world.restore(snapshot)
    world.advance(0.5)
    assert np.array_equal(world.data.qpos, after)
    world.restore(snapshot)


def test_lids_stay_where_they_are_in_a_room_with_a_robot_that_moves(world):
    names = ("Box_1", "Box_2", "Laptop_1", "Book_1", "LaundryHamper_1")
    snapshot, before = world.save(), [world.object(name).openness for name in names]
    for k in range(50):
        world.servos.set_hand("left", 0.5 + 0.5 * float(np.sin(k)))
        world.advance(0.1)
    assert [world.object(name).openness for name in names] == pytest.approx(before, abs=0.03)
    world.restore(snapshot)


def test_a_load_does_not_weigh_on_the_lid(world):
    box = world.object("Box_1")
    before = world.model.body_mass[list(box.body_ids)].copy()
    world.states.set_mass("Box_1", 3.0)
    now = world.model.body_mass[list(box.body_ids)]
    assert now.sum() == pytest.approx(3.0) and now[1] == before[1]
    world.states.set_mass("Box_1", 0.3)
    assert world.model.body_mass[list(box.body_ids)] == pytest.approx(before)


@pytest.fixture(scope="module")
def session():
    made = Session("h1", image_size=0)
    yield made
    made.close()


def start(session, room, *placements):
    session.reset(FreePlay(room, placements=placements), 0)
    session._seen.update(session.world.objects)
    return session.world


def test_what_is_in_a_closed_box_or_hamper_is_out_of_reach(session):
    phone = (ObjectPlacement("CellPhone_1", "Box_1"), ObjectPlacement("CellPhone_2", "LaundryHamper_1"))
    start(session, "bedroom_1", ObjectPlacement("Box_1", "Desk_1"), *phone)
    for name in ("CellPhone_1", "CellPhone_2"):
        assert session.assess(PlanStep.parse(f"Pick(right, {name})").actions[0]).code == "ReceptacleClosed"


def test_the_keys_of_a_laptop_are_below_its_screen(session):
    laptop = ObjectPlacement("Laptop_1", "Desk_1", (-0.22, -2.36), yaw_deg=180.0)
    start(session, "bedroom_1", laptop)
    assert reach(session, "ToggleOn(right, Laptop_1)").success
    start(session, "bedroom_1", replace(laptop, state={"isOpen": False}))
    assert session.assess(PlanStep.parse("ToggleOn(right, Laptop_1)").actions[0]).code == "Obstructed"


def test_a_lifted_box_and_laptop_keep_their_lids_shut(session):
    start(session, "living_room_1", ObjectPlacement("Box_1", "CoffeeTable_1", (0.1, -0.84)))
    assert reach(session, "Lift(Box_1)").success
    act(session, "RotateLeft(90)")
    assert session.world.object("Box_1").openness < 0.02
    start(session, "bedroom_1", ObjectPlacement("Laptop_1", "Desk_1", (-0.22, -2.3), yaw_deg=180.0, state={"isOpen": False}))
    assert reach(session, "Pick(right, Laptop_1)").success
    act(session, "MoveBack(0.3)")
    assert session.world.object("Laptop_1").openness < 0.05


def test_an_open_book_is_picked_up_by_its_pages(session):
    start(session, "bedroom_1", ObjectPlacement("Book_1", "Desk_1", (-0.22, -2.3), yaw_deg=180.0, state={"isOpen": True}))
    assert reach(session, "Pick(right, Book_1)").success
    assert session.world.containment.parents("Book_1") == () and session.world.object("Book_1").is_open


def test_a_toilet_lid_shuts_nothing_away(session):
    start(session, "bathroom_1", ObjectPlacement("ToiletPaper_1", "Toilet_1"))
    refusal = session.assess(PlanStep.parse("Pick(right, ToiletPaper_1)").actions[0])
    assert refusal is None or refusal.code != "ReceptacleClosed"


CASES = (
    ("bedroom_1", (ObjectPlacement("Box_1", "Bed_1", (-0.85, 0.9)),), "right", "Box_1"),
    ("bedroom_1", (ObjectPlacement("Book_1", "Desk_1", (-0.6, -2.3), yaw_deg=180.0),), "right", "Book_1"),
    ("kitchen_2", (ObjectPlacement("Kettle_1", "StoveBurner_1"),), "right", "Kettle_1"),
    ("bedroom_1", (ObjectPlacement("Laptop_1", "Desk_1", (-0.22, -2.4), yaw_deg=180.0),), "right", "Laptop_1"),
    ("bathroom_2", (), "right", "Toilet_1"),
    ("bedroom_1", (), "right", "LaundryHamper_1"),
)


@pytest.mark.parametrize(("room", "placements", "arm", "name"), CASES, ids=[case[-1] for case in CASES])
def test_a_lid_opens_and_closes_by_hand(session, room, placements, arm, name):
    world = start(session, room, *placements)
    before = world.poses.pose(name)[:3, 3]
    verbs = ("Close", "Open") if world.object(name).is_open else ("Open", "Close")
    for verb in verbs:
        outcome = reach(session, f"{verb}({arm}, {name})")
        assert outcome.success, outcome
        assert entry(world, name)["isOpen"] == (verb == "Open")
        if verb == "Close":
            assert world.object(name).openness < 0.12
    assert np.linalg.norm(world.poses.pose(name)[:3, 3] - before) < 0.08
    assert world.poses.pose(name)[2, 2] > 0.99
