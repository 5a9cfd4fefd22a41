"""A planner in one file: the example works, and what is wrong with a file is said."""

from pathlib import Path

import numpy as np
import pytest

from data.code_files import CodeFileError, source_digest
from interface.observation import Camera, Observation, Proprioception
from proprio_mllm.planners.file_planner import load_planner
from proprio_mllm.planners.protocol import TaskInfo

EXAMPLE = Path(__file__).parents[2] / "examples" / "own_planner.py"
GOOD = """
class Good:
    privileged = False
    image_size = 56
    def reset(self, task, rng): ...
    def step(self, observation, feedback): ...
"""


def test_the_example_plans() -> None:
    planner = load_planner(f"{EXAMPLE}:Nearby")
    planner.reset(TaskInfo("put the mug on the table", "h1", 9), np.random.default_rng(0))
    body = Proprioception(np.zeros((64, 48), np.float32), 20.0, np.zeros(3), np.zeros((14, 3)))
    camera, image, names = Camera(np.eye(3), np.eye(4), 112, 112), np.zeros((112, 112, 3), np.uint8), ("Mug_1", "Fridge_1")
    seen = Observation("put the mug on the table", "h1", image, camera, names, names, body, (), 0, 9)
    for _ in range(5):
        reply = planner.step(seen, None)
        assert reply.step is not None
        assert "Mug_1" in reply.text


def test_a_file_may_import_its_neighbour(tmp_path: Path) -> None:
    (tmp_path / "sizes_of_mine.py").write_text("SIZE = 84\n")
    (tmp_path / "own.py").write_text("from sizes_of_mine import SIZE\n" + GOOD.replace("56", "SIZE"))
    assert load_planner(f"{tmp_path / 'own.py'}:Good").image_size == 84


def test_the_digest_sees_the_file_its_class_and_its_neighbours(tmp_path: Path) -> None:
    path, neighbour = tmp_path / "digested.py", tmp_path / "rules_of_mine.py"
    neighbour.write_text("SIZE = 84\n")
    (tmp_path / "unrelated.py").write_text("")
    path.write_text("from rules_of_mine import SIZE\n" + GOOD)

    def digest(name: str = "Good") -> str:
        load_planner(f"{path}:Good")
        return source_digest(f"{path}:{name}")

    first = digest()
    (tmp_path / "unrelated.py").write_text("# edited\n")
    assert digest() == first
    neighbour.write_text("SIZE = 85\n")
    second = digest()
    path.write_text(path.read_text() + "# edited\n")
    assert len({first, second, digest(), digest("Other")}) == 4


@pytest.mark.parametrize(
    ("text", "name", "message"),
    [
        (GOOD, "Better", r"own\.py has no class 'Better'; it has: Good"),
        ("import nothing_of_this_name\n", "Good", r"own\.py cannot be run: ModuleNotFoundError: .*nothing_of_this_name"),
        (GOOD.replace("privileged = False", "privileged = True"), "Good", "privileged must be False"),
        (GOOD.replace("def step", "def steps"), "Good", r"Good is no planner; it lacks step\(\)"),
        (GOOD.replace("image_size = 56", "image_size = 'big'"), "Good", r"it lacks image_size \(int\)"),
        (GOOD + "    def __init__(self, weights): ...\n", "Good", r"Good\(\) failed: TypeError"),
    ],
)
def test_what_is_wrong_is_said(tmp_path: Path, text: str, name: str, message: str) -> None:
    (tmp_path / "own.py").write_text(text)
    with pytest.raises(CodeFileError, match=message):
        load_planner(f"{tmp_path / 'own.py'}:{name}")


@pytest.mark.parametrize("source", ["own.py", "own:Good", "own.py:", "own.py:a b", ":"])
def test_a_source_of_another_form(source: str) -> None:
    with pytest.raises(CodeFileError, match=r"allowed: FILE\.py:CLASS"):
        load_planner(source)


def test_a_file_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(CodeFileError, match=r"there is no file .*gone\.py"):
        load_planner(f"{tmp_path / 'gone.py'}:Good")
