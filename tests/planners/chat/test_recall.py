"""What a memory brings to mind, on four tasks; likeness against sums done by hand."""

from __future__ import annotations

import dataclasses
import shutil
from pathlib import Path

import numpy as np
import pytest

from proprio_mllm.planners.chat import recall
from proprio_mllm.planners.chat.embedding import SentenceEmbedder
from proprio_mllm.planners.chat.recall import AROUND, Key, MomentRecall, TaskRecall, load_moments, load_tasks, seen_words
from proprio_mllm.planners.chat.spoken import plan_words, step_words
from proprio_mllm.planners.memory import MemoryFileError, read_memory
from tests.planners.demonstrations import LAMP, PICK, SLICE, STOW


@pytest.fixture(scope="module")
def tasks(blind_memory_folder: Path) -> TaskRecall:
    return load_tasks(str(blind_memory_folder))


@pytest.mark.parametrize(
    ("instruction", "task", "family"),
    [
        ("Get the cup from the table.", PICK.task, "pick"),
        ("Stow the remote control inside the drawer.", STOW.task, "stow"),
        ("Slice the lettuce.", SLICE.task, "slice"),
        ("Turn on the lamp.", LAMP.task, "toggle_on"),
    ],
)
def test_the_related_task_comes_first(tasks: TaskRecall, instruction: str, task: str, family: str) -> None:
    assert tasks.nearest(instruction, 2)[0].task == task
    assert tasks.family(instruction) == family
    assert tasks.similar(instruction, family, 1)[0].task == task


def test_the_category_counts(tasks: TaskRecall) -> None:
    assert tasks.similar("Do it.", "slice", 1)[0].task == SLICE.task
    assert tasks.similar("Do it.", "toggle_on", 1)[0].task == LAMP.task
    assert len(tasks.nearest("Do it.", 9)) == 4


def test_moments_are_scored_by_the_sum_of_likenesses(tasks: TaskRecall, embedder: SentenceEmbedder) -> None:
    instruction, plan = "Put the remote control in the drawer.", ["find the remote control", "put it in the drawer"]

    def alike(one: str, other: str) -> float:
        first, second = embedder.embed([one, other])
        return float(first @ second)

    for key in (Key("object", "Drawer_1"), Key("action", "open the drawer")):
        found = MomentRecall(tasks).moments(instruction, "stow", plan, key, None, 4)
        assert [one.score for one in found] == sorted((one.score for one in found), reverse=True)
        assert found[0].episode.task == STOW.task
        for moment in found:
            episode = moment.episode
            fits = [
                alike("drawer", seen_words(s.visible)) if key.kind == "object" else alike(key.text, step_words(s.step))
                for s in episode.steps
            ]
            whole = alike(instruction, episode.instruction) + alike("stow", episode.family.replace("_", " "))
            whole += alike(plan_words(plan), plan_words(episode.plan))
            assert moment.score == pytest.approx(whole + max(fits), abs=1e-5)
            assert moment.best == int(np.argmax(fits))


def test_a_key_finds_its_step_and_what_stands_around(tasks: TaskRecall) -> None:
    opened = MomentRecall(tasks).moments(STOW.instruction, "stow", ["x"], Key("action", "open the drawer"), None, 1)[0]
    assert opened.episode.steps[opened.best].step == "Open(left, Drawer_1)"
    assert opened.steps == opened.episode.steps[opened.best - AROUND :]
    sought = MomentRecall(tasks).moments(SLICE.instruction, "slice", ["x"], Key("object", "knife"), None, 1)[0]
    assert "Knife_1" in sought.episode.steps[sought.best].visible
    assert sought.steps == sought.episode.steps[: sought.best + AROUND + 1]


def test_pictures_count_where_there_are_any(memory_folder: Path, embedder: SentenceEmbedder) -> None:
    moments = load_moments(str(memory_folder))
    stored = moments.tasks.memory.images
    assert moments.eyes is not None
    assert stored is not None
    image = np.full((28, 28, 3), SLICE.grey, np.uint8)
    image[:4, :, 0] = 255  # the view of its third step
    likeness = stored @ moments.eyes.encode([image])[0]
    found = [
        {one.episode.task: one for one in moments.moments(SLICE.instruction, "slice", ["x"], key, view, 4)}
        for key in [Key("object", "counter top")]
        for view in (image, None)
    ]
    words = embedder.embed(["counter top"])[0]
    for task, seeing in found[0].items():
        steps = seeing.episode.steps
        fits = embedder.embed([seen_words(step.visible) for step in steps]) @ words
        both = fits + likeness[[step.image for step in steps]]
        assert seeing.score - found[1][task].score == pytest.approx(both.max() - fits.max(), abs=1e-5)
        assert seeing.best == int(both.argmax())
    third = found[0][SLICE.task].episode.steps[2]
    assert likeness[third.image] == pytest.approx(1.0, abs=1e-4)


def test_eyes_need_pictures(tasks: TaskRecall, memory_folder: Path) -> None:
    eyes = load_moments(str(memory_folder)).eyes
    with pytest.raises(ValueError, match="the memory made by `a test` has no pictures"):
        MomentRecall(tasks, eyes)


def test_a_memory_is_read_once_and_again_when_it_was_made_again(
    blind_memory_folder: Path, memory_folder: Path, tmp_path: Path
) -> None:
    folder = tmp_path / "m"
    shutil.copytree(blind_memory_folder, folder)
    first = load_moments(str(folder))
    assert first is load_moments(str(folder))
    assert first.tasks is load_tasks(str(folder))
    assert first.eyes is None
    shutil.rmtree(folder)
    shutil.copytree(memory_folder, folder)
    assert load_moments(str(folder)).eyes is not None


def test_pictures_by_other_weights_are_refused(memory_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shutil.copytree(memory_folder, tmp_path / "m")
    monkeypatch.setattr(recall, "weights_digest", lambda folder: "other")
    with pytest.raises(MemoryFileError, match="weights/tiny/base is not the encoder that its pictures were encoded by"):
        load_moments(str(tmp_path / "m"))


def test_a_family_that_is_not_known_is_no_obstacle(blind_memory_folder: Path, embedder: SentenceEmbedder) -> None:
    memory = read_memory(blind_memory_folder)
    nameless = tuple(dataclasses.replace(one, family="") for one in memory.episodes)
    tasks = TaskRecall(dataclasses.replace(memory, episodes=nameless), embedder)
    assert tasks.family(PICK.instruction) == ""
    assert tasks.similar(PICK.instruction, "", 1)[0].task == PICK.task


def test_what_is_seen_in_words() -> None:
    assert seen_words(("CounterTop_1", "CounterTop_2", "Mug_1")) == "counter top, mug"
    assert seen_words(()) == "nothing"
