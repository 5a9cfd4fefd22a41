"""Liquids: volumes, taps, spills, wiping, and books that always balance."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from robots.spec import load_robot
from sim.interfaces.metadata import world_metadata
from sim.scene.compiler import PUDDLES
from sim.scene.objects import ObjectPlacement
from sim.world.world import World, WorldError

CUPS = (
    ObjectPlacement("Mug_1", "DiningTable_1", (1.3, -1.4)),
    ObjectPlacement("Cup_1", "DiningTable_1", (1.6, -1.4)),
    ObjectPlacement("Bowl_1", "DiningTable_1", (1.9, -1.4)),
)


def _world(*placements: ObjectPlacement, **kwargs: object) -> World:
    return World(None, "kitchen_1", placements or CUPS, **kwargs)  # type: ignore[arg-type]


def test_states_and_mass_follow_the_volume() -> None:
    world = _world()
    mug = world.object("Mug_1")
    full, empty_kg = mug.type.volume_l, world.containment.total_mass_kg("Mug_1")
    world.states.set_state("Mug_1", "fillLiquid", "coffee")
    assert mug.state.fillLitres == pytest.approx(full) and mug.state.isFilledWithLiquid
    assert world.containment.total_mass_kg("Mug_1") == pytest.approx(empty_kg + full)
    world.states.set_state("Mug_1", "fillLitres", 0.05 * full)
    assert not mug.state.isFilledWithLiquid and mug.state.fillLiquid == "coffee"
    world.states.set_state("Mug_1", "isFilledWithLiquid", False)
    assert mug.state.fillLitres == 0.0 and mug.state.fillLiquid == ""
    assert world.liquids.balance_l() == pytest.approx(0.0, abs=1e-12)
    for name, value, message in (("fillLitres", 9.0, "holds 0 to"), ("fillLiquid", "lava", "unknown liquid 'lava'")):
        with pytest.raises(WorldError, match=message):
            world.states.set_state("Mug_1", name, value)
    with pytest.raises(WorldError, match="Fridge is not fillable"):
        world.states.set_state("Fridge_1", "fillLitres", 1.0)


def test_pouring_moves_what_fits_and_spills_the_rest() -> None:
    world = _world()
    cup, mug = world.object("Cup_1"), world.object("Mug_1")
    world.states.set_state("Cup_1", "fillLiquid", "water")
    before = cup.state.fillLitres
    came = world.liquids.pour(cup, mug, before)
    assert came == pytest.approx(mug.type.volume_l) and cup.state.fillLitres == 0.0
    assert [puddle.surface for puddle in world.liquids.puddles] == ["DiningTable_1"]
    assert world.liquids.puddles[0].litres == pytest.approx(before - came)
    assert world_metadata(world)["spills"][0]["surface"] == "DiningTable_1"
    assert world.liquids.wipe("DiningTable_1") == pytest.approx(before - came) and not world.liquids.puddles
    assert world.liquids.balance_l() == pytest.approx(0.0, abs=1e-12)


def test_what_breaks_or_falls_over_runs_out() -> None:
    world = _world()
    world.states.set_state("Mug_1", "fillLiquid", "coffee")
    world.states.set_state("Mug_1", "isBroken", True)
    assert world.object("Mug_1").state.fillLitres == 0.0 and world.liquids.puddles[0].liquid == "coffee"
    world.states.set_state("Cup_1", "fillLiquid", "water")
    cup = world.object("Cup_1")
    half = np.sqrt(0.5)
    world.data.qpos[cup.qpos_adr + 2] += 0.06
    world.data.qpos[cup.qpos_adr + 3 : cup.qpos_adr + 7] = (half, half, 0.0, 0.0)
    mujoco.mj_forward(world.model, world.data)
    world.advance(3.0)
    assert cup.state.fillLitres == 0.0 and not cup.state.isFilledWithLiquid
    assert world.liquids.balance_l() == pytest.approx(0.0, abs=1e-12)


def test_tap_fills_over_seconds_and_the_basin_overflows_into_its_drain() -> None:
    world = _world(ObjectPlacement("Pot_1", "SinkBasin_1", (0.12, 2.31)), ObjectPlacement("Mug_1", "CounterTop_1"))
    pot, basin = world.object("Pot_1"), world.object("SinkBasin_1")
    world.states.set_state("Faucet_1", "isToggled", True)
    levels = []
    for _ in range(6):
        world.advance(1.0)
        levels.append(pot.state.fillLitres)
    assert np.diff(levels) == pytest.approx(0.15)
    assert basin.state.fillLitres == 0.0 and world.object("Mug_1").state.fillLitres == 0.0
    world.states.set_state("Pot_1", "isFilledWithLiquid", True)
    world.states.set_state("SinkBasin_1", "fillLitres", 11.9)
    world.advance(3.0)
    assert basin.state.fillLitres == pytest.approx(12.0) and world.liquids.drained > 0.0
    assert world.liquids.balance_l() == pytest.approx(0.0, abs=1e-9)


def test_coffee_machine_fills_a_mug_with_hot_coffee() -> None:
    world = World(None, "kitchen_2", [ObjectPlacement("Mug_1", "CoffeeMachine_1", (0.72, 2.35))])
    world.states.set_state("CoffeeMachine_1", "isToggled", True)
    world.advance(4.0)
    mug = world.object("Mug_1")
    assert mug.state.fillLiquid == "coffee" and mug.state.fillLitres > 0.1 and mug.state.temperature > 45.0


def test_levels_and_puddles_are_seen() -> None:
    world = _world(ObjectPlacement("Mug_1", "DiningTable_1", (1.75, -1.15)))
    dry = world.cameras.render("overview", 240, 320).rgb
    world.states.set_state("SinkBasin_1", "fillLitres", 3.0)
    low = world.cameras.render("overview", 240, 320).rgb
    world.states.set_state("SinkBasin_1", "fillLitres", 12.0)
    high = world.cameras.render("overview", 240, 320).rgb
    assert (dry != low).any() and (low != high).any()
    world.states.set_state("Mug_1", "fillLiquid", "water")
    table = world.cameras.render("plan", 240, 240).rgb
    world.liquids.spill(world.object("Mug_1"))
    wet = world.cameras.render("plan", 240, 240).rgb
    assert (np.abs(wet.astype(int) - table).max(axis=-1) > 30).sum() > 20


def test_many_puddles_join_and_nothing_is_lost() -> None:
    world = World(load_robot("x1"), "living_room_1")
    vase = world.object("Vase_1")
    for x in np.linspace(-2.5, 2.5, PUDDLES + 3):
        world.states.set_state("Vase_1", "isFilledWithLiquid", True)
        world.data.qpos[vase.qpos_adr : vase.qpos_adr + 2] = (x, 1.6)
        mujoco.mj_kinematics(world.model, world.data)
        world.liquids.spill(vase)
    assert len(world.liquids.puddles) == PUDDLES
    assert {puddle.surface for puddle in world.liquids.puddles} == {"Floor"}
    assert world.liquids.balance_l() == pytest.approx(0.0, abs=1e-12)


def test_snapshots_hold_liquids() -> None:
    world = _world()
    world.states.set_state("Cup_1", "fillLiquid", "wine")
    before, picture = world.save(), world.cameras.render("plan", 120, 120).rgb
    world.liquids.spill(world.object("Cup_1"))
    assert world.liquids.puddles and (world.cameras.render("plan", 120, 120).rgb != picture).any()
    world.restore(before)
    assert not world.liquids.puddles and world.object("Cup_1").state.fillLiquid == "wine"
    assert np.array_equal(world.cameras.render("plan", 120, 120).rgb, picture)
    assert world.liquids.balance_l() == pytest.approx(0.0, abs=1e-12)
