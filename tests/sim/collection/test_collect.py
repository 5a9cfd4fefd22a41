"""Collection: the same bytes for the same configuration, complete rows, resumption, refused arguments."""

import json

import numpy as np
import pytest

from configs.arguments import read_arguments
from configs.schema.collect import TRAIN_ROOMS, CollectConfig
from configs.validate import ConfigError
from data.motion import N_FEATURES
from data.shards import ShardReader, decode_depth, decode_png, decode_segmentation
from interface.bodies import Arm
from interface.observation import HistoryItem, Observation
from interface.steps import Action, PlanStep
from sim.collection.collect import collect, main, parts_of, rows_of_part
from sim.collection.demonstrations import foreseen, perturbed, run_episode, run_lesson
from sim.collection.view_sampling import type_names
from sim.session.session import Session
from sim.tasks.task import load_benchmark

VIEWS = CollectConfig("views", "unused", 6, part_size=3, views_per_world=3, image_size=56)


@pytest.fixture(scope="module")
def views(tmp_path_factory):
    folder = tmp_path_factory.mktemp("views")
    config = CollectConfig("views", str(folder), 6, part_size=3, views_per_world=3, image_size=56)
    collect(config)
    return ShardReader(folder, "views")


def test_views_are_complete(views):
    assert len(views) == 6
    names = views.manifest.metadata["type_names"]
    assert names == list(type_names())
    for row in views:
        image = decode_png(row["image"])
        depth = decode_depth(row["depth"], row["height"], row["width"])
        labels = decode_segmentation(row["segmentation"], row["height"], row["width"])
        assert image.shape == (56, 56, 3)
        assert np.isfinite(depth).all()
        assert (depth > 0.0).all()
        assert len(row["motion"]) == 64 * N_FEATURES
        assert np.isfinite(row["motion"]).all()
        shown = {names[index] for index in np.unique(labels[labels >= 0])}
        assert {item["type"] for item in json.loads(row["objects"])} == shown


def test_half_of_the_views_are_where_an_arm_could_reach_something() -> None:
    config = CollectConfig("views", "unused", 48, part_size=48, views_per_world=24, image_size=28)
    nearest = [
        min((np.hypot(*item["center_in_pelvis"][:2]) for item in json.loads(row["objects"])), default=9.0)
        for row in rows_of_part(config, 0)
    ]
    assert 0.2 < np.mean(np.array(nearest) < 0.8) < 0.9, sorted(nearest)


def test_depth_agrees_with_what_is_seen(views):
    """A visible object's centre, projected into the view, is at a depth near the pixels that show it."""
    checked = 0
    for row in views:
        depth = decode_depth(row["depth"], row["height"], row["width"])
        pelvis_in_camera = np.linalg.inv(np.reshape(row["camera_in_pelvis"], (4, 4)))
        for item in json.loads(row["objects"]):
            x0, y0, x1, y1 = item["bbox"]
            in_camera = pelvis_in_camera @ np.array([*item["center_in_pelvis"], 1.0])
            if item["pixels"] < 30 or in_camera[2] < 0.4:
                continue
            nearest = float(depth[y0:y1, x0:x1].min())
            assert nearest < in_camera[2] + 1.5
            checked += 1
    assert checked > 3


def test_parts_depend_on_the_configuration_only():
    first, again = rows_of_part(VIEWS, 1), rows_of_part(VIEWS, 1)
    assert [row["image"] for row in first] == [row["image"] for row in again]
    assert [row["objects"] for row in first] == [row["objects"] for row in again]
    assert parts_of(VIEWS) == 2


def test_an_interrupted_run_is_continued(views, tmp_path):
    config = CollectConfig("views", str(tmp_path), 6, part_size=3, views_per_world=3, image_size=56)
    collect(config)
    manifest = json.loads((tmp_path / "manifest.json").read_text())
    manifest["parts"].pop("1")
    manifest["complete"] = False
    (tmp_path / "manifest.json").write_text(json.dumps(manifest))
    seen = []
    collect(config, lambda done, total: seen.append((done, total)))
    assert seen == [(1, 2), (2, 2)]
    assert [row["image"] for row in ShardReader(tmp_path, "views")] == [row["image"] for row in views]


def test_an_episode_has_one_row_per_step_with_the_experts_choice():
    config = CollectConfig("demos", "unused", 4, image_size=56, noise=0.5, chance_share=0.0, rooms=("kitchen_1",))
    episode = run_episode(config, 1)
    again = run_episode(config, 1)
    assert [row["target"] for row in episode.rows] == [row["target"] for row in again.rows]
    assert episode.rows
    for number, row in enumerate(episode.rows):
        assert row["step"] == number == len(row["history"])
        PlanStep.parse(row["target"])
        executed = json.loads(row["privileged"])
        if number + 1 < len(episode.rows):
            assert episode.rows[number + 1]["history"][-1]["step"] == executed["executed"]


class _Turning:
    """A teacher that always says the same; it keeps what it was shown."""

    def __init__(self, step: str = "RotateLeft(10)") -> None:
        self.step, self.shown = PlanStep.parse(step), list[Observation]()

    def __call__(self, observation: Observation) -> tuple[PlanStep, Action | None] | None:
        self.shown.append(observation)
        return self.step, None

    def after(self, observation: Observation, refused: HistoryItem) -> PlanStep | None:
        assert refused.feedback.endswith(" TooFar") and refused.step == self.step.to_text()
        return PlanStep((Action("MoveAhead", amount=0.3),))


class _Silent(_Turning):
    def __call__(self, observation: Observation) -> None:
        return None


def test_a_lesson_keeps_the_teachers_answer_to_every_step_and_ends_with_done():
    config = CollectConfig("demos", "unused", 20, image_size=56, noise=0.0, chance_share=0.0)
    teacher = _Turning()

    def student(observation):
        return PlanStep((Action("Place", arm=Arm.RIGHT, object_id=observation.known_objects[0]),))

    alone, taught = run_lesson(config, 3, None, teacher), run_lesson(config, 3, None, teacher, student)
    assert len(alone.rows) == len(taught.rows) == 32
    assert {row["target"] for row in (*alone.rows, *taught.rows)} == {"RotateLeft(10)"}
    assert [row["image"] for row in alone.rows] == [row["image"] for row in run_lesson(config, 3, None, teacher).rows]
    assert [len(observation.history) for observation in teacher.shown[:32]] == list(range(32))
    origins = [json.loads(row["privileged"])["origin"] for row in taught.rows]
    assert origins[:2] == ["student", "teacher"]  # what has just failed is not tried again
    assert run_lesson(config, 3, None, _Silent()).rows == []


@pytest.mark.parametrize("robot", ["h1", "x1"])
def test_what_an_arm_cannot_reach_is_foreseen(robot: str) -> None:
    session = Session(robot, image_size=0)
    task = next(task for task in load_benchmark() if task.family == "carry" and task.room == "living_room_1")
    name = task.placements[0].object_id
    observation = session.reset(task, seed=0)
    for height in (None, *session.body.spec.pelvis_height_range_m):
        teacher = _Turning(f"Lift({name})")
        if height is not None:
            session.step(PlanStep((Action("GoTo", object_id=name),)))
            stance = session.body.posture.stance()
            session.teleport(stance.x, stance.y, stance.yaw_rad, height)
            observation = session.observation()
        step = foreseen(session, observation, teacher.step, teacher)
        refusal = session.assess(teacher.step.actions[0])
        if refusal is None:
            assert step is None
        elif refusal.code == "TooFar":
            assert step == PlanStep((Action("MoveAhead", amount=0.3),))
        elif step is not None:
            assert step.actions[0].name == ("MoveUp" if refusal.code == "BodyTooLow" else "MoveDown")
            _, feedback = session.step(step)
            assert feedback.success and session.assess(teacher.step.actions[0]) is None
    assert foreseen(session, observation, PlanStep((Action("RotateLeft", amount=10.0),)), teacher) is None


def test_another_stance_is_foreseen_once_between_two_tries(monkeypatch: pytest.MonkeyPatch) -> None:
    config = CollectConfig("demos", "unused", 20, image_size=56, noise=0.0, chance_share=0.0, foreseen=True)
    teacher = _Turning("Open(left, Microwave_9)")
    walk, crouch = PlanStep((Action("MoveAhead", amount=0.1),)), PlanStep((Action("MoveDown", amount=0.05),))
    answers = iter([walk, walk, walk, crouch, crouch, None, *[walk] * 40])
    monkeypatch.setattr("sim.collection.demonstrations.foreseen", lambda *_: next(answers))
    monkeypatch.setattr("sim.collection.demonstrations.MISTAKES", (0.0,))
    targets = [row["target"].partition("(")[0] for row in run_lesson(config, 3, None, teacher).rows]
    assert targets[:8] == ["MoveAhead", "Open", "MoveAhead", "MoveDown", "MoveDown", "Open", "MoveAhead", "Open"]


class _Seen:
    known_objects = ("Mug_1", "SideTable_1")


@pytest.mark.parametrize(
    "step",
    [
        PlanStep((Action("GoTo", object_id="Mug_1", amount=0.5),)),
        PlanStep((Action("MoveDown", amount=0.2),)),
        PlanStep((Action("Pick", arm=Arm.LEFT, object_id="Mug_1"), Action("Pick", arm=Arm.RIGHT, object_id="Bowl_1"))),
    ],
)
def test_perturbed_steps_are_legal_and_differ(step):
    rng = np.random.default_rng(0)
    texts = {perturbed(step, _Seen(), rng)[0].to_text() for _ in range(40)}  # type: ignore[arg-type]
    assert all(PlanStep.parse(text).to_text() == text for text in texts)
    assert len(texts) > 5


def test_arguments_are_read_and_wrong_ones_refused(capsys):
    assert read_arguments(CollectConfig, ["kind=views", "out=x", "count=3", "robots=[x1]"]).robots == ("x1",)
    with pytest.raises(ConfigError, match="views, demos"):
        read_arguments(CollectConfig, ["kind=pictures", "out=x", "count=3"])
    with pytest.raises(ConfigError, match="'count' is not key=value"):
        read_arguments(CollectConfig, ["count"])
    with pytest.raises(ConfigError, match="count must be at least 1, got 0"):
        read_arguments(CollectConfig, ["kind=views", "out=x", "count=0"])
    with pytest.raises(ConfigError, match=r"noise must be within \[0, 1\], got 2"):
        read_arguments(CollectConfig, ["kind=demos", "out=x", "count=1", "noise=2"])
    with pytest.raises(ConfigError, match="robots and rooms must not be empty"):
        read_arguments(CollectConfig, ["kind=demos", "out=x", "count=1", "robots=[]"])
    assert main(["colour=red"]) == 2
    assert "colour" in capsys.readouterr().err


def test_views_show_every_training_room() -> None:
    rows = rows_of_part(CollectConfig("views", "unused", 12, image_size=16, views_per_world=1), 0)
    assert {row["room"] for row in rows} == set(TRAIN_ROOMS)
