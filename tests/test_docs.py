"""What the documentation shows is so: Python blocks print what stands beside them, commands are understood, codes listed."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from configs.compose import compose
from configs.schema.eval import EvalConfig
from configs.schema.train import TrainConfig
from configs.validate import build
from interface.actions import ACTIONS
from interface.bodies import PAPER_ROBOTS
from interface.failures import FAILURES
from proprio_mllm.planners.file_planner import load_planner
from proprio_mllm.planners.protocol import TaskInfo
from sim.session.session import Session
from sim.tasks.task import load_benchmark
from train import main as train

ROOT = Path(__file__).parents[1]
ROOTS = {"eval.py": EvalConfig, "train.py": TrainConfig}
#: A shell's variables, several runs at once, and words that stand for a choice.
PLACEHOLDER = re.compile(r"\$| -m |=[A-Z] |=brief|=…")
PAGE = (ROOT / "docs" / "simulator.md").read_text(encoding="utf-8")


def blocks() -> Iterator[tuple[str, str]]:
    for path in (ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))):
        text = path.read_text(encoding="utf-8")
        for found in re.finditer(r"^```python\n(.*?)^```", text, re.DOTALL | re.MULTILINE):
            yield f"{path.name}:{text.count(chr(10), 0, found.start()) + 1}", found[1]


@pytest.mark.parametrize("name", [*ACTIONS, *FAILURES])
def test_it_is_listed(name: str) -> None:
    rows = [line for line in PAGE.splitlines() if line.startswith("|")]
    assert any(f"`{name}`" in row or f"`{name}(" in row for row in rows), name


@pytest.mark.slow
@pytest.mark.parametrize(("where", "code"), blocks())
def test_what_is_shown_runs(
    where: str, code: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    if "outputs/tiny/data" in code:
        assert train(["stage=data", "data.clips=2"]) == 0
    if "RemoteController" in code:
        pytest.skip("tests/sim/interfaces runs it against a server")
    capsys.readouterr()
    exec(compile(code, where, "exec"), {"__name__": "documentation"})
    printed = capsys.readouterr().out.splitlines()
    expected = [line.partition("  # ")[2] for line in code.splitlines() if line.startswith("print(")]
    assert printed == expected


@pytest.mark.slow
@pytest.mark.parametrize("robot", PAPER_ROBOTS)
def test_the_example_planner_solves_a_task(robot: str) -> None:
    task = load_benchmark()[0]
    session, planner = Session(robot), load_planner(f"{ROOT / 'examples' / 'own_planner.py'}:Nearby")
    observation, feedback = session.reset(task, seed=0), None
    planner.reset(TaskInfo(observation.instruction, robot, task.time_limit), np.random.default_rng(0))
    while not session.finished:
        reply = planner.step(observation, feedback)
        assert reply.step is not None, reply.text
        observation, feedback = session.step(reply.step)
    session.close()
    assert session.succeeded


def commands() -> Iterator[tuple[str, str]]:
    for path in (ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))):
        text = path.read_text(encoding="utf-8").replace("\\\n", " ")
        for found in re.finditer(r"python ((?:eval|train)\.py [^`\n#]*)", text):
            if not PLACEHOLDER.search(found[1]):
                yield f"{path.name}: {found[1].strip()}", found[1]


@pytest.mark.parametrize(("where", "command"), [pytest.param(*one, id=one[0]) for one in dict(commands()).items()])
def test_commands_that_are_shown_are_understood(where: str, command: str) -> None:
    root, *words = shlex.split(command)
    build(ROOTS[root], compose(root.removesuffix(".py"), words))
