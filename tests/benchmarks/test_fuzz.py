"""Random calls: a short run without a violation, and checks that do see what is wrong."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.fuzz import FuzzConfig, calls, check, main, run_world
from sim.interfaces.controller import Controller


def test_a_short_run_is_clean(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["actions=160", "seed=3", "per_world=40", "rooms=[kitchen_1, bathroom_2]"]) == 0
    line = capsys.readouterr().out.strip().splitlines()[-1]
    assert line.startswith("160 calls in 2 rooms with 2 robots") and "0 violations" in line


def test_calls_are_a_function_of_the_seed() -> None:
    config = FuzzConfig(actions=12, per_world=12, seed=1, robots=("x1",), rooms=("bathroom_1",))
    assert run_world(config, 0) == run_world(config, 0)


@pytest.fixture
def controller():
    made = Controller("x1", "bathroom_1", 24, 24, privileged=True)
    yield made
    made.stop()


def test_a_third_is_malformed(controller: Controller) -> None:
    stream = calls(np.random.default_rng(0), controller, 1.0 / 3.0)
    bad = [malformed for _, malformed in (next(stream) for _ in range(3000))]
    assert 0.3 < np.mean(bad) < 0.37


@pytest.mark.parametrize(
    ("harm", "message"),
    [
        ("nan", "physics is not finite"),
        ("lost", "SoapBottle_1 is lost"),
        ("joint", "joint left_elbow_pitch_joint is at"),
        ("holder", "hand holds"),
        ("heat", "SoapBottle_1 has 900"),
        ("liquid", "liquid is not conserved"),
    ],
)
def test_harm_is_seen(controller: Controller, harm: str, message: str) -> None:
    world = controller.session.world
    event = controller.step("Pass")
    assert check(controller, event) == []
    soap = world.object("SoapBottle_1")
    if harm == "nan":
        world.data.qpos[soap.qpos_adr] = np.nan
    elif harm == "lost":
        world.data.xpos[soap.body_id, 2] = -1.0
    elif harm == "joint":
        world.data.qpos[world.model.joint("left_elbow_pitch_joint").qposadr[0]] = 9.0
    elif harm == "holder":
        soap.held_by.append("left")
    elif harm == "heat":
        soap.state.temperature = 900.0
    else:
        world.object("SinkBasin_1").state.fillLitres += 0.5
    assert any(message in line for line in check(controller, event))


def test_an_event_that_is_not_well_formed_is_seen(controller: Controller) -> None:
    event = controller.step("Pass")
    del event.metadata["agent"]
    assert check(controller, event) == ["the event lacks ['agent']"]


def test_wrong_arguments(capsys: pytest.CaptureFixture[str]) -> None:
    for arguments, message in (
        (["actions=0"], "actions must be at least 1"),
        (["rooms=[attic]"], "unknown room 'attic'"),
        (["malformed=2"], r"malformed must be within [0, 1]"),
        (["seed=-1"], "seed must not be negative"),
    ):
        assert main(arguments) == 2
        assert message in capsys.readouterr().err
