"""The map of CONTRIBUTING.md is true: what it lists is enough, and nothing else has to be touched."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from configs.compose import compose
from tests.extension.additions import QUANTIZER, SKILL, STAGE, Addition
from tests.third_robot import write_third_robot

ROOT = Path(__file__).parents[2]
PACKAGES = ("configs", "interface", "robots", "data", "sim", "proprio_mllm", "tests")


def touched(row: str, name: str) -> set[str]:
    """The files that the map lists for a kind of addition."""
    lines = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8").splitlines()
    (line,) = [line for line in lines if line.startswith(f"| {row} |")]
    return {path.replace("NAME", name) for path in re.findall(r"`([^`]+)`", line.split("|")[2])}


def ran(code: str, root: Path, *arguments: str, **variables: str) -> subprocess.CompletedProcess[str]:
    """A program in a checkout."""
    environment = os.environ | {"PYTHONPATH": str(root), "WANDB_MODE": "disabled"} | variables
    return subprocess.run(
        [sys.executable, "-c", code, *arguments], cwd=root, env=environment, capture_output=True, text=True, timeout=280
    )


def test_the_keys_that_the_map_names_exist() -> None:
    page = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    commands = [(app, words.split()) for app, words in re.findall(r"`(train|eval)\.py ([^`]+)`", page)]
    commands += [("train", [word]) for word in re.findall(r"`(model\.[a-z_.]+=NAME)`", page)]
    assert len(commands) > 8
    for app, words in commands:
        settings = [word for word in words if "=" in word]
        values = compose(
            app, [word for word in settings if word.startswith("planner.source") or not re.search("[A-Z]{4}", word)]
        )
        for key in (word.split("=")[0] for word in settings):
            if (ROOT / "configs" / key).is_dir():  # a group, which may be empty until it is chosen
                continue
            found = values
            for name in key.split("."):
                assert name in found, f"{app}.py has no {key}"
                found = found[name]


@pytest.mark.slow
@pytest.mark.parametrize("addition", [SKILL, QUANTIZER, STAGE], ids=lambda addition: addition.name)
def test_what_the_map_lists_is_enough(addition: Addition, tmp_path: Path) -> None:
    assert {edit.path for edit in addition.edits} == touched(addition.row, addition.name)
    assert len({edit.path for edit in addition.edits}) <= 4
    root = tmp_path / "checkout"
    for package in PACKAGES:
        shutil.copytree(ROOT / package, root / package, ignore=shutil.ignore_patterns("__pycache__", "*.stl", "*.obj"))
    for mesh in (path for path in (ROOT / "robots").rglob("*") if path.suffix in (".stl", ".obj")):
        copy = root / mesh.relative_to(ROOT)
        copy.parent.mkdir(parents=True, exist_ok=True)
        copy.symlink_to(mesh)
    for name in ("train.py", "eval.py", "pyproject.toml"):
        shutil.copy(ROOT / name, root / name)
    (root / "weights").symlink_to(ROOT / "weights")
    for edit in addition.edits:
        (root / edit.path).parent.mkdir(parents=True, exist_ok=True)
        edit.apply(root)
    done = ran(addition.program, root, str(tmp_path / "outputs"))
    assert done.stdout.endswith("works\n"), done.stderr[-3000:]
    own = next(edit.path for edit in addition.edits if edit.path.startswith("tests/"))
    checked = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-p", "no:xdist", own, *addition.checks], cwd=root,
        env=os.environ | {"PYTHONPATH": str(root)}, capture_output=True, text=True,
    )  # fmt: skip
    assert checked.returncode == 0, checked.stdout[-2000:]


@pytest.fixture
def assets(tmp_path: Path) -> Path:
    """A folder with a third robot."""
    write_third_robot(tmp_path / "assets")
    return tmp_path / "assets"


@pytest.mark.slow
def test_a_third_robot_needs_no_code(assets: Path, tmp_path: Path) -> None:
    assert touched("a robot", "stubby") >= {"robots/stubby.yaml", "robots/stubby.xml"}
    code = (
        "import sys, eval, train\n"
        "out = 'output=' + sys.argv[1]\n"
        "assert eval.main(['robot=stubby', 'planner=scripted', 'limit=1', 'steps=task', 'workers=1', out]) == 0\n"
        "words = ['model=tiny', 'budget=debug', 'data.robots=[stubby]', 'data.clips=4', out]\n"
        "assert train.main(['stage=data', *words]) == 0\n"
        "assert train.main(['stage=collect', 'collect.views=8', 'collect.lessons=2', *words]) == 0\n"
        "print('works')\n"
    )
    done = ran(code, ROOT, str(tmp_path / "outputs"), DUALTHOR_ASSETS=str(assets))
    assert done.stdout.endswith("works\n"), done.stderr[-3000:]


@pytest.mark.slow
def test_a_planner_is_a_file(tmp_path: Path) -> None:
    planner = tmp_path / "mine.py"
    planner.write_text((ROOT / "examples" / "own_planner.py").read_text(encoding="utf-8"), encoding="utf-8")
    code = (
        "import sys, eval\n"
        "words = ['planner=file', 'planner.source=' + sys.argv[2] + ':Nearby', 'limit=1', 'steps=task']\n"
        "assert eval.main([*words, 'output=' + sys.argv[1]]) == 0\n"
        "print('works')\n"
    )
    done = ran(code, ROOT, str(tmp_path / "outputs"), str(planner))
    assert done.stdout.endswith("works\n"), done.stderr[-3000:]
