"""What an extra brings: a module that is not there is named with its extra, and the simulator needs none."""

from __future__ import annotations

import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from configs.arguments import EXTRAS, needed_extra

ROOT = Path(__file__).parents[2]


def test_a_missing_module_is_named_with_its_extra() -> None:
    assert "pip install 'proprio-mllm[train]'" in needed_extra(ModuleNotFoundError("no", name="torch.nn"))
    with pytest.raises(ModuleNotFoundError):
        needed_extra(ModuleNotFoundError("no", name="sim.nothing"))


def test_every_package_of_an_extra_has_its_module_listed() -> None:
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    for extra, modules in EXTRAS.items():
        packages = {re.split("[<>=]", one)[0].replace("-", "_") for one in extras[extra]} - {"torch"}
        assert packages <= set(modules) | {"torch"}


def ran_without(modules: list[str], code: str, folder: Path) -> subprocess.CompletedProcess[str]:
    """Runs code, in which `out` is an option for the output, where some modules cannot be imported."""
    start = f"""
import sys
class Finder:
    def find_spec(self, name, *_):
        if name.split(".")[0] in {modules!r}:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)
sys.meta_path.insert(0, Finder())
out = "output={folder}"
"""
    return subprocess.run([sys.executable, "-c", start + code], cwd=ROOT, capture_output=True, text=True, check=False)


@pytest.mark.parametrize(
    "code",
    [
        "from sim.interfaces.controller import Controller; Controller().step('RotateRight')",
        "import eval; sys.exit(eval.main(['planner=scripted', 'limit=1', 'category=single', 'workers=0', out]))",
    ],
)
def test_simulator_and_rules_do_without_extras(code: str, tmp_path: Path) -> None:
    done = ran_without(sorted({module for modules in EXTRAS.values() for module in modules}), code, tmp_path)
    assert done.returncode == 0, done.stderr[-2000:]


def test_a_command_that_needs_an_extra_says_so(tmp_path: Path) -> None:
    done = ran_without(["torch"], "import eval; sys.exit(eval.main(['planner=words', 'limit=1', 'workers=0', out]))", tmp_path)
    assert done.returncode == 1
    assert done.stderr.strip().splitlines()[-1] == (
        "eval.py: needs torch, which is not installed: pip install 'proprio-mllm[train]', or `make setup` for everything"
    )
