"""What a newcomer would add, file by file: a skill, a quantiser and a stage. Paths are those of the map in CONTRIBUTING.md."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

__all__ = ["QUANTIZER", "SKILL", "STAGE", "Addition", "Edit"]


@dataclass(frozen=True)
class Edit:
    """A change of a file: `new` is put before the first `mark`; a file without a mark is new."""

    path: str
    new: str
    mark: str = ""

    def apply(self, root: Path) -> None:
        """Changes the file below a checkout."""
        path = root / self.path
        if not self.mark:
            assert not path.exists(), self.path
            path.write_text(self.new, encoding="utf-8")
            return
        text = path.read_text(encoding="utf-8")
        assert self.mark in text, f"{self.path} has no {self.mark!r} any more"
        path.write_text(text.replace(self.mark, self.new + self.mark, 1), encoding="utf-8")


@dataclass(frozen=True)
class Addition:
    """What is changed for one thing, its name, a program that uses it and prints `works`, and tests that must still pass."""

    row: str
    name: str
    edits: tuple[Edit, ...]
    program: str
    checks: tuple[str, ...] = ()


SKILL = Addition(
    "a skill",
    "tap",
    (
        Edit(
            "interface/actions.py",
            """    ActionSpec(
        "Tap",
        ActionKind.ARM,
        "touch an object from above with the empty hand",
        takes_object=True,
        requires=needs.FREE_HAND + needs.ACCESSIBLE,
        meets=(*_REACH, _C.TOOL_MISSED),
    ),
""",
            """    ActionSpec("Done",""",
        ),
        Edit(
            "sim/skills/tap.py",
            '''"""Tap: a fingertip of the empty hand touches an object from above."""

from __future__ import annotations

import numpy as np

from interface.failures import FailureCode
from interface.steps import Action
from sim.skills.articulate import plan_press
from sim.skills.body.body import Body
from sim.skills.failures import require
from sim.skills.failures import SkillFailure
from sim.skills.manipulate import GRASP_GAP_M, OutcomeDraw, stow
from sim.skills.reach import Reach
from sim.skills.runner import Skill


def assess_tap(body: Body, action: Action) -> Reach:
    """What Tap would do."""
    assert action.arm is not None and action.object_id is not None
    require(body.world, action)
    low, high = body.world.poses.bounds(action.object_id)
    top = np.array([(low[0] + high[0]) / 2.0, (low[1] + high[1]) / 2.0, high[2] - 0.01])
    return plan_press(body, action.arm, top, (action.object_id,))


def tap(body: Body, action: Action, outcome_draw: OutcomeDraw) -> Skill:
    """Tap: touches an object and comes back."""
    del outcome_draw
    reach = assess_tap(body, action)
    assert action.arm is not None and action.object_id is not None
    arm, solid = action.arm, body.objects.solid_geoms(body.obj(action.object_id))
    yield from body.hands.move(arm, body.spec.hand.press[2], 0.2)
    yield from body.arms.move(arm, [*reach.way, reach.before])
    yield from body.arms.touch(arm, reach.at, solid, speed=0.7)
    gap = body.probe.hand_gap_m(arm, solid)
    yield from body.arms.move(arm, [reach.before])
    yield from stow(body, arm, (action.object_id,))
    if gap > GRASP_GAP_M:
        raise SkillFailure(FailureCode.TOOL_MISSED, {"gap_m": gap})
''',
        ),
        Edit("sim/skills/registry.py", "from sim.skills import tap\n", "from sim.skills import articulate"),
        Edit("sim/skills/registry.py", '    "Tap": ArmSkill(tap.tap, tap.assess_tap),\n', '    "UseUp": ArmSkill('),
        Edit(
            "tests/sim/skills/test_tap.py",
            """from interface.actions import ACTIONS


def test_tap_is_an_action() -> None:
    assert ACTIONS["Tap"].takes_object
""",
        ),
    ),
    """
from interface.actions import ACTIONS
from interface.manual import action_manual
from interface.steps import PlanStep
from proprio_mllm.report.sft import plan_prompt
from sim.session.session import FreePlay, Session
from sim.tools.catalogue import inventory

assert "- Tap(arm, object): touch an object" in action_manual()
assert "Tap(arm, object)" in plan_prompt("t", "h1", (), (), (), 0, 5)[0].text
assert "Tap" in {row["name"] for row in inventory()["actions"]}
session = Session("h1", image_size=0)
session.reset(FreePlay("kitchen_1"), seed=0)
codes = []


def act(text):
    outcome = session.step(PlanStep.parse(text))[1].outcomes[0]
    return outcome.code or "ok"


act("GoTo(CounterTop_1)")
things = [name for name in session.observation().visible_objects if session.world.objects[name].movable]
for name in things[:4]:
    act(f"GoTo({name})")
    for arm in ("right", "left"):
        for _ in range(6):
            codes.append(act(f"Tap({arm}, {name})"))
            if codes[-1] not in ("BodyTooHigh", "BodyTooLow"):
                break
            act("MoveDown(0.05)" if codes[-1] == "BodyTooHigh" else "MoveUp(0.05)")
assert "ok" in codes, codes
assert set(codes) <= {"ok", *ACTIONS["Tap"].codes}, codes
print("works")
""",
    ("tests/interface", "tests/sim/collection/test_text_world.py", "tests/planners/chat/dag_plan/test_checks.py"),
)

QUANTIZER = Addition(
    "a quantiser",
    "lfq",
    (
        Edit("configs/schema/model.py", '"lfq", ', '"vq", "rvq", "fsq"] = "vq"'),
        Edit(
            "proprio_mllm/model/quantizer.py",
            """        elif cfg.quantizer == "lfq":
            from vector_quantize_pytorch import LFQ

            self.inner = LFQ(dim=cfg.code_dim, codebook_size=cfg.codes)
""",
            '        elif cfg.quantizer == "rvq":\n            self.inner',
        ),
        Edit(
            "proprio_mllm/model/quantizer.py",
            """        if self.cfg.quantizer == "lfq":
            return self.inner.indices_to_codes(indices)
""",
            "        inner = self.inner\n",
        ),
        Edit(
            "tests/model/test_lfq.py",
            """from configs.schema.model import MotionTokenizerConfig


def test_lfq_is_allowed() -> None:
    assert MotionTokenizerConfig(quantizer="lfq").quantizer == "lfq"
""",
        ),
    ),
    """
import torch
from configs.schema.model import MotionTokenizerConfig
from proprio_mllm.model.quantizer import MotionQuantizer

torch.manual_seed(0)
quantizer = MotionQuantizer(MotionTokenizerConfig(quantizer="lfq", codes=64, code_dim=8)).eval()
vectors = torch.randn(2, 5, 8)
tokens = quantizer.tokens(vectors)
assert tokens.shape == (2, 5, 1) and int(tokens.max()) < 64
assert quantizer.lookup(tokens).shape == vectors.shape
print("works")
""",
)

STAGE = Addition(
    "a training stage",
    "census",
    (
        Edit(
            "proprio_mllm/training/stages/census.py",
            '''"""Stage `census`: counts the parameters of the configured model."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from proprio_mllm.training.pipeline import Metrics, Pipeline


class CensusStage:
    """Counts parameters."""

    name = "census"
    needs = ()
    shards = ()
    recipe = 1

    def settings(self, pipeline: Pipeline) -> Mapping[str, Any]:
        """The sizes that it looks at."""
        return {"hidden": pipeline.cfg.model.text.hidden}

    def run(self, pipeline: Pipeline, folder: Path, key: str) -> Metrics:
        """Writes the figure."""
        return {"hidden": float(pipeline.cfg.model.text.hidden)}
''',
        ),
        Edit(
            "proprio_mllm/training/stages/__init__.py",
            "from proprio_mllm.training.stages.census import CensusStage\n",
            "from proprio_mllm.training.stages.pointmap",
        ),
        Edit("proprio_mllm/training/stages/__init__.py", '    "census": CensusStage(),\n', '    "pointmap": '),
        Edit("configs/schema/train.py", '"census", ', '"pointmap", "tokenizer"'),
        Edit(
            "tests/training/test_census.py",
            """from proprio_mllm.training.stages import STAGES


def test_census_is_a_stage() -> None:
    assert "census" in STAGES
""",
        ),
    ),
    """
import sys
import train

assert train.main(["stage=census", "model=tiny", "output=" + sys.argv[1]]) == 0
print("works")
""",
)
