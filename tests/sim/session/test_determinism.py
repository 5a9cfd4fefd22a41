"""The same seed and actions give the same bits in every process, whatever else was done before."""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys

import pytest

from interface.steps import PlanStep
from sim.session.session import FreePlay, Session

PLAN = ("GoTo(SoapBottle_1)", "Pick(left, SoapBottle_1)", "MoveBack(0.2)", "ToggleOn(right, LightSwitch_1)", "Release(left)")


def fingerprint(robot: str) -> str:
    """Hash of positions, outcomes and the last picture of a short episode with contingencies."""
    session = Session(robot, "natural", image_size=64, all_known=True)
    session.reset(FreePlay("bathroom_1"), seed=11)
    digest = hashlib.sha256()
    for text in PLAN:
        observation, feedback = session.step(PlanStep.parse(text))
        digest.update(feedback.to_text().encode() + session.world.data.qpos.tobytes() + observation.image.tobytes())
    session.close()
    return digest.hexdigest()


@pytest.mark.parametrize("robot", ["h1", pytest.param("x1", marks=pytest.mark.slow)])
def test_processes_agree(robot: str) -> None:
    code = f"import runpy; print(runpy.run_path({__file__!r})['fingerprint']({robot!r}))"
    found = {fingerprint(robot)}
    for hash_seed in ("1", "2"):
        done = subprocess.run(
            [sys.executable, "-c", code],
            capture_output=True,
            text=True,
            check=True,
            env=os.environ | {"PYTHONHASHSEED": hash_seed},
        )
        found.add(done.stdout.strip().splitlines()[-1])
    assert len(found) == 1
