"""The memory: what goes into it, that it comes back as it was, and what is refused."""

from __future__ import annotations

import dataclasses
import json
import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from data.shards import ShardReader, ShardWriter
from proprio_mllm.planners import memory_build
from proprio_mllm.planners.memory import IMAGES_FILE, MEMORY_FILE, MemoryFileError, check_memory, read_memory
from proprio_mllm.planners.memory_build import Candidate, MemoryConfig, build_memory, candidates, main, select
from sim.tasks.sample import TRAIN_SEEDS, sample_task
from sim.tasks.task import BENCHMARK_PATH, Task, load_benchmark
from tests.planners.demonstrations import DEMOS, PICK, STOW, Act, Demo, rows_of, write_demos

#: Files opened while this is a list; a hook for audits cannot be taken off again.
_OPENED: list[list[str]] = []


def _note(event: str, arguments: tuple) -> None:
    if event == "open" and _OPENED:
        _OPENED[-1].append(str(arguments[0]))


@pytest.fixture
def opened() -> Iterator[list[str]]:
    """Names of the files that a test opens."""
    sys.addaudithook(_note)
    _OPENED.append([])
    yield _OPENED[-1]
    _OPENED.clear()


def test_what_is_written_is_read(memory_folder: Path, demos_folder: Path) -> None:
    memory = read_memory(memory_folder)
    assert [one.task for one in memory.episodes] == [demo.task for demo in DEMOS]
    stow = memory.episodes[1]
    assert (stow.robot, stow.room, stow.category, stow.family) == ("x1", "kitchen_1", "single", "stow")
    assert [step.feedback for step in stow.steps[:2]] == ["GoTo(CellPhone_1) ok", "Pick(right, CellPhone_1) TooFar"]
    assert stow.steps[-1].feedback == "Place(right, Drawer_1) ok"
    assert len(stow.steps) == 6
    assert stow.plan == tuple(act.target for act in STOW.acts if act.code == "ok")
    assert stow.steps[4].visible == ("Drawer_1",)
    assert "CellPhone_1" in stow.steps[4].known
    header = memory.header
    assert (header.source, header.count, header.seed, header.command) == (str(demos_folder), 4, 0, "a test")
    assert memory.images is not None
    assert [step.image for one in memory.episodes for step in one.steps] == list(range(len(memory.images)))
    np.testing.assert_allclose(np.linalg.norm(memory.images, axis=1), 1.0, atol=1e-5)
    assert "secret" not in (memory_folder / MEMORY_FILE).read_text()


def test_a_memory_without_pictures(blind_memory_folder: Path) -> None:
    memory = read_memory(blind_memory_folder)
    assert memory.images is None
    assert memory.header.features is None
    assert not (blind_memory_folder / IMAGES_FILE).exists()
    assert {step.image for one in memory.episodes for step in one.steps} == {None}


def test_the_same_command_writes_the_same_bytes(memory_folder: Path, demos_folder: Path, tmp_path: Path) -> None:
    build_memory(MemoryConfig(str(demos_folder), str(tmp_path / "m")), "a test")
    for name in (MEMORY_FILE, IMAGES_FILE):
        assert (tmp_path / "m" / name).read_bytes() == (memory_folder / name).read_bytes()


def _many(count: int) -> list[Candidate]:
    """Candidates of three kinds on two robots, of which the first kind is the most frequent."""
    base = memory_build._candidate(rows_of(PICK), 0, "rows")
    found = []
    for row in range(count):
        family = ("pick", "pick", "pick", "open", "slice")[row % 5]
        episode = dataclasses.replace(
            base.episode, family=family, robot=("h1", "x1")[row % 2], instruction=f"task {row}", task=f"t{row}"
        )
        found.append(Candidate(episode, row, row % 3))
    return found


def test_the_selection_is_balanced_and_seeded() -> None:
    found = _many(60)
    chosen = select(found, 12, np.random.default_rng(0))
    assert Counter((one.episode.family, one.episode.robot) for one in chosen) == {
        (family, robot): 2 for family in ("pick", "open", "slice") for robot in ("h1", "x1")
    }
    assert [one.row for one in chosen] == sorted(one.row for one in chosen)
    assert {one.detours for one in chosen} == {0}
    assert chosen == select(found, 12, np.random.default_rng(0))
    assert chosen != select(found, 12, np.random.default_rng(1))


@pytest.mark.parametrize(("limit", "count"), [(1, 1), (7, 7), (60, 60), (1000, 60), (None, 60)])
def test_the_selection_takes_what_there_is(limit: int | None, count: int) -> None:
    assert len(select(_many(60), limit, np.random.default_rng(0))) == count


def test_no_instruction_is_taken_twice() -> None:
    found = _many(10)
    same = [dataclasses.replace(one, episode=dataclasses.replace(one.episode, instruction="Open it.")) for one in found]
    assert len(select(same, None, np.random.default_rng(0))) == 1


def test_detours_are_counted_and_a_task_without_a_family_goes_by_its_last_action(tmp_path: Path) -> None:
    acts = (Act("GoTo(Mug_1)", done="MoveBack(0.3)"), Act("Pick(left, Mug_1)", code="TooFar"), Act("Pick(left, Mug_1)"))
    write_demos(tmp_path / "d", [Demo("mine", "h1", "", "Get the mug.", acts), PICK])
    own, pick = candidates(ShardReader(tmp_path / "d", "demos"))
    assert (own.detours, own.row, own.label, own.episode.family) == (2, 0, "Pick", "")
    assert own.episode.plan == ("MoveBack(0.3)", "Pick(left, Mug_1)")
    assert (pick.detours, pick.row, pick.label) == (0, 3, "pick")


def _lines(folder: Path) -> list[dict]:
    return [json.loads(line) for line in (folder / MEMORY_FILE).read_text().splitlines()]


def _write(folder: Path, lines: list[dict | str]) -> Path:
    folder.mkdir(exist_ok=True)
    texts = [line if isinstance(line, str) else json.dumps(line) for line in lines]
    (folder / MEMORY_FILE).write_text("\n".join(texts) + "\n")
    return folder


@pytest.mark.parametrize(
    ("line", "change", "message"),
    [
        (2, "{", r"memory\.jsonl:3: not JSON"),
        (2, "[1]", r"memory\.jsonl:3: schema version '\[1\]' is unknown"),
        (0, {"schema_version": 2}, r"memory\.jsonl:1: schema version 2 is unknown; this code reads 1"),
        (1, {"schema_version": None}, r"memory\.jsonl:2: schema version None"),
        (1, {"colour": "red"}, r"memory\.jsonl:2: colour: unknown key"),
        (1, {"instruction": " "}, r"memory\.jsonl:2: .*empty instruction ' '"),
        (1, {"plan": ["Done()"]}, r"memory\.jsonl:2: .*plan \['Done\(\)'\] is not the steps that succeeded"),
        (1, {"robot": 3}, r"memory\.jsonl:2: robot: expected str, got 3"),
        (3, {"steps": [{"step": "Fly()", "feedback": "ok", "visible": [], "known": []}]}, r"memory\.jsonl:4: .*'Fly'"),
        (0, {"count": 5}, r"memory\.jsonl: 4 episodes, its header says 5"),
    ],
)
def test_a_broken_line_is_named(blind_memory_folder: Path, tmp_path: Path, line: int, change: str | dict, message: str) -> None:
    lines: list[dict | str] = list(_lines(blind_memory_folder))
    found = lines[line]
    assert isinstance(found, dict)
    lines[line] = change if isinstance(change, str) else found | change
    with pytest.raises(MemoryFileError, match=message):
        read_memory(_write(tmp_path, lines))


def test_an_empty_and_a_binary_file(tmp_path: Path) -> None:
    (tmp_path / MEMORY_FILE).write_bytes(b"")
    with pytest.raises(MemoryFileError, match=r"memory\.jsonl:1: not JSON"):
        read_memory(tmp_path)
    (tmp_path / MEMORY_FILE).write_bytes(b"\xff\xfe\x00")
    with pytest.raises(MemoryFileError, match=r"memory\.jsonl: not a text file"):
        read_memory(tmp_path)


def test_pictures_have_to_be_those_of_the_memory(memory_folder: Path, tmp_path: Path) -> None:
    lines = _lines(memory_folder)
    with pytest.raises(MemoryFileError, match=rf"{IMAGES_FILE}: missing, or not the file"):
        read_memory(_write(tmp_path, list(lines)))
    (tmp_path / IMAGES_FILE).write_bytes((memory_folder / IMAGES_FILE).read_bytes())
    assert read_memory(tmp_path).images is not None
    lines[2]["steps"][0]["image"] = 99
    with pytest.raises(MemoryFileError, match=r"memory\.jsonl:3: image 99 is not one of the 14"):
        read_memory(_write(tmp_path, list(lines)))


def test_no_memory_names_the_command(tmp_path: Path) -> None:
    with pytest.raises(MemoryFileError, match=r"no memory at .*nothing: make it with `python -m proprio_mllm memory`"):
        check_memory(tmp_path / "nothing")


def test_only_training_tasks_are_taken(tmp_path: Path) -> None:
    write_demos(tmp_path / "d", split="seen")
    with pytest.raises(MemoryFileError, match="task train_pick_100001 is of the split 'seen'; a memory takes train only"):
        build_memory(MemoryConfig(str(tmp_path / "d"), str(tmp_path / "m")), "")
    assert not (tmp_path / "m").exists()


def test_an_episode_with_gaps_is_refused(tmp_path: Path) -> None:
    writer = ShardWriter(tmp_path / "d", "demos", "test")
    writer.write(0, rows_of(PICK)[1:])
    writer.finish()
    with pytest.raises(MemoryFileError, match="train_pick_100001_h1_0 has 1 rows and a log of 1"):
        build_memory(MemoryConfig(str(tmp_path / "d"), str(tmp_path / "m")), "")


def test_a_folder_of_other_things_is_left_alone(demos_folder: Path, tmp_path: Path) -> None:
    (tmp_path / "thesis.txt").write_text("dear reader")
    with pytest.raises(MemoryFileError, match=r"holds something else than a memory \(thesis.txt\)"):
        build_memory(MemoryConfig(str(demos_folder), str(tmp_path)), "")
    assert (tmp_path / "thesis.txt").read_text() == "dear reader"


def test_a_stopped_build_leaves_the_old_memory(
    memory_folder: Path, demos_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = MemoryConfig(str(demos_folder), str(tmp_path / "m"))
    build_memory(config, "first")

    def stop(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(memory_build, "write_text", stop)
    with pytest.raises(KeyboardInterrupt):
        build_memory(config, "second")
    assert read_memory(tmp_path / "m").header.command == "first"
    assert [path.name for path in tmp_path.iterdir()] == ["m"]


def test_the_command_line(demos_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([f"demos={demos_folder}", f"out={tmp_path / 'm'}", "limit=3", "vision=null"]) == 0
    assert "3 episodes" in capsys.readouterr().out
    assert read_memory(tmp_path / "m").header.command.startswith("python -m proprio_mllm memory demos=")
    for wrong, message in [
        ("limit=0", "limit 0 must be positive or null"),
        ("seed=-1", "seed -1 must not be negative"),
        ("demos=/nowhere", "no such file"),
        ("vision=/nowhere", "no image encoder at /nowhere"),
        ("size=3", "size: unknown key"),
    ]:
        arguments = [f"out={tmp_path / 'n'}", *([] if wrong.startswith("demos") else [f"demos={demos_folder}"]), wrong]
        assert main(arguments) == 2
        assert message in capsys.readouterr().err
        assert not (tmp_path / "n").exists()


def _demo_of(task: Task) -> Demo:
    obj = task.goals[0].object_id or task.placements[0].object_id
    return Demo(task.id, "h1", task.category, task.instruction, (Act(f"GoTo({obj})"),), room=task.room)


def _what(task: Task) -> tuple[object, ...]:
    return task.room, task.instruction, frozenset((one.object_id, one.receptacle, one.xy) for one in task.placements)


def test_no_task_of_the_memory_is_one_of_the_benchmark(tmp_path: Path, opened: list[str]) -> None:
    """Demonstrations draw their tasks as here; the memory keeps their ids, from which the tasks are drawn again."""
    drawn = [sample_task(TRAIN_SEEDS.start + number, ("kitchen_1", "living_room_1")[number % 2]) for number in range(8)]
    write_demos(tmp_path / "d", [_demo_of(task) for task in drawn])
    opened.clear()  # drawing tasks reads rooms and types
    memory = build_memory(MemoryConfig(str(tmp_path / "d"), str(tmp_path / "m"), vision=None), "")
    names = {Path(name).name for name in opened}
    assert "manifest.json" in names
    assert BENCHMARK_PATH.name not in names
    benchmark = load_benchmark()
    assert not {task.id for task in benchmark} & {one.task for one in memory.episodes}
    again = [sample_task(int(one.task.rsplit("_", 1)[1]), one.room) for one in memory.episodes]
    assert [task.instruction for task in again] == [one.instruction for one in memory.episodes]
    assert not {_what(task) for task in benchmark} & {_what(task) for task in again}
