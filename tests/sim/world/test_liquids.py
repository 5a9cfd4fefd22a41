"""Liquids: volumes, taps, spills, wiping, and books that always balance."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from sim.robots.spec import load_robot
from sim.scene.compiler import PUDDLES
from sim.scene.objects import ObjectPlacement
from sim.world.liquids import balance_l, capacity_l, pour, spill, wipe
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
    full, empty_kg = capacity_l(mug.type), world.total_mass_kg("Mug_1")
    world.set_state("Mug_1", "fillLiquid", "coffee")
    assert mug.state.fillLitres == pytest.approx(full) and mug.state.isFilledWithLiquid
    assert world.total_mass_kg("Mug_1") == pytest.approx(empty_kg + full)
    world.set_state("Mug_1", "fillLitres", 0.05 * full)
    assert not mug.state.isFilledWithLiquid and mug.state.fillLiquid == "coffee"
    world.set_state("Mug_1", "isFilledWithLiquid", False)
    assert mug.state.fillLitres == 0.0 and mug.state.fillLiquid == ""
    assert balance_l(world) == pytest.approx(0.0, abs=1e-12)
    for name, value, message in (("fillLitres", 9.0, "holds 0 to"), ("fillLiquid", "lava", "unknown liquid 'lava'")):
        with pytest.raises(WorldError, match=message):
            world.set_state("Mug_1", name, value)
    with pytest.raises(WorldError, match="Fridge is not fillable"):
        world.set_state("Fridge_1", "fillLitres", 1.0)


def test_pouring_moves_what_fits_and_spills_the_rest() -> None:
    world = _world()
    cup, mug = world.object("Cup_1"), world.object("Mug_1")
    world.set_state("Cup_1", "fillLiquid", "water")
    before = cup.state.fillLitres
    came = pour(world, cup, mug, before)
    assert came == pytest.approx(capacity_l(mug.type)) and cup.state.fillLitres == 0.0
    assert [puddle.surface for puddle in world.liquids.puddles] == ["DiningTable_1"]
    assert world.liquids.puddles[0].litres == pytest.approx(before - came)
    assert world.metadata()["spills"][0]["surface"] == "DiningTable_1"
    assert wipe(world, "DiningTable_1") == pytest.approx(before - came) and not world.liquids.puddles
    assert balance_l(world) == pytest.approx(0.0, abs=1e-12)


def test_what_breaks_or_falls_over_runs_out() -> None:
    world = _world()
    world.set_state("Mug_1", "fillLiquid", "coffee")
    world.set_state("Mug_1", "isBroken", True)
    assert world.object("Mug_1").state.fillLitres == 0.0 and world.liquids.puddles[0].liquid == "coffee"
    world.set_state("Cup_1", "fillLiquid", "water")
    cup = world.object("Cup_1")
    half = np.sqrt(0.5)
    world.data.qpos[cup.qpos_adr + 2] += 0.06
    world.data.qpos[cup.qpos_adr + 3 : cup.qpos_adr + 7] = (half, half, 0.0, 0.0)
    mujoco.mj_forward(world.model, world.data)
    world.advance(3.0)
    assert cup.state.fillLitres == 0.0 and not cup.state.isFilledWithLiquid
    assert balance_l(world) == pytest.approx(0.0, abs=1e-12)


def test_tap_fills_over_seconds_and_the_basin_overflows_into_its_drain() -> None:
    world = _world(ObjectPlacement("Pot_1", "SinkBasin_1", (0.12, 2.31)), ObjectPlacement("Mug_1", "CounterTop_1"))
    pot, basin = world.object("Pot_1"), world.object("SinkBasin_1")
    world.set_state("Faucet_1", "isToggled", True)
    levels = []
    for _ in range(6):
        world.advance(1.0)
        levels.append(pot.state.fillLitres)
    assert np.diff(levels) == pytest.approx(0.15)
    assert basin.state.fillLitres == 0.0 and world.object("Mug_1").state.fillLitres == 0.0
    world.set_state("Pot_1", "isFilledWithLiquid", True)
    world.set_state("SinkBasin_1", "fillLitres", 11.9)
    world.advance(3.0)
    assert basin.state.fillLitres == pytest.approx(12.0) and world.liquids.drained > 0.0
    assert balance_l(world) == pytest.approx(0.0, abs=1e-9)


def test_coffee_machine_fills_a_mug_with_hot_coffee() -> None:
    world = World(None, "kitchen_2", [ObjectPlacement("Mug_1", "CoffeeMachine_1", (0.72, 2.35))])
    world.set_state("CoffeeMachine_1", "isToggled", True)
    world.advance(4.0)
    mug = world.object("Mug_1")
    assert mug.state.fillLiquid == "coffee" and mug.state.fillLitres > 0.1 and mug.state.temperature > 45.0


def test_levels_and_puddles_are_seen() -> None:
    world = _world(ObjectPlacement("Mug_1", "DiningTable_1", (1.75, -1.15)))
    dry = world.render("overview", 240, 320).rgb
    world.set_state("SinkBasin_1", "fillLitres", 3.0)
    low = world.render("overview", 240, 320).rgb
    world.set_state("SinkBasin_1", "fillLitres", 12.0)
    high = world.render("overview", 240, 320).rgb
    assert (dry != low).any() and (low != high).any()
    world.set_state("Mug_1", "fillLiquid", "water")
    table = world.render("plan", 240, 240).rgb
    spill(world, world.object("Mug_1"))
    wet = world.render("plan", 240, 240).rgb
    assert (np.abs(wet.astype(int) - table).max(axis=-1) > 30).sum() > 20


def test_many_puddles_join_and_nothing_is_lost() -> None:
    world = World(load_robot("x1"), "living_room_1")
    vase = world.object("Vase_1")
    for x in np.linspace(-2.5, 2.5, PUDDLES + 3):
        world.set_state("Vase_1", "isFilledWithLiquid", True)
        world.data.qpos[vase.qpos_adr : vase.qpos_adr + 2] = (x, 1.6)
        mujoco.mj_kinematics(world.model, world.data)
        spill(world, vase)
    assert len(world.liquids.puddles) == PUDDLES
    assert {puddle.surface for puddle in world.liquids.puddles} == {"Floor"}
    assert balance_l(world) == pytest.approx(0.0, abs=1e-12)


def test_snapshots_hold_liquids() -> None:
    world = _world()
    world.set_state("Cup_1", "fillLiquid", "wine")
    before, picture = world.save(), world.render("plan", 120, 120).rgb
    spill(world, world.object("Cup_1"))
    assert world.liquids.puddles and (world.render("plan", 120, 120).rgb != picture).any()
    world.restore(before)
    assert not world.liquids.puddles and world.object("Cup_1").state.fillLiquid == "wine"
    assert np.array_equal(world.render("plan", 120, 120).rgb, picture)
    assert balance_l(world) == pytest.approx(0.0, abs=1e-12)
