"""A room, a type, a robot and a contingency of one's own: one file each in the folder of `DUALTHOR_ASSETS`, no code."""

from __future__ import annotations

from pathlib import Path

import pytest

from configs.assets import ASSETS_VARIABLE
from configs.compose import compose
from configs.schema.eval import EvalConfig
from configs.validate import ConfigError, build
from interface.steps import PlanStep
from robots.spec import available_robots, load_robot
from sim.scene.catalogue import load_catalogue
from sim.scene.rooms import load_room, room_names
from sim.session.contingency import load_contingency
from sim.session.session import FreePlay, Session
from tests.third_robot import write_third_robot

TEAPOT = """
version: 1
colors: {mint: [0.6, 0.9, 0.75]}
types:
  Teapot:
    rooms: [kitchen]
    size: [0.1, 0.1, 0.16]
    mass: 0.5
    properties: [pickupable, fillable]
    parts:
      - [cylinder, 0, 0, 0.07, 0.09, 0.09, 0.14, mint]
      - [cylinder, 0, 0, 0.15, 0.02, 0.02, 0.02, white, ghost]
"""
PANTRY = """
category: kitchen
bounds: [-1.6, -1.6, 1.6, 1.6]
wall_height: 2.4
wall_colors: [[0.9, 0.9, 0.9], [0.8, 0.9, 0.9], [0.9, 0.8, 0.9], [0.9, 0.9, 0.8]]
floor_colors: [[0.5, 0.5, 0.5], [0.4, 0.4, 0.4]]
start: [0.0, -0.4, 90.0]
furniture:
  - {id: Shelf_1, xy: [0.0, 1.46], z: 0.62}
objects:
  - {id: Teapot_1, receptacle: Shelf_1}
"""
UNLUCKY = """
difficulties: {easy: 1.0, medium: 0.5, hard: 0.2, natural: null}
rules:
  - {actions: [Pick], types: [Teapot], state: {}, outcomes: {success: 0.0, slipped: 1.0}}
"""


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    for kind in ("rooms", "types", "contingency"):
        (tmp_path / kind).mkdir()
    (tmp_path / "types" / "crockery.yaml").write_text(TEAPOT)
    (tmp_path / "rooms" / "pantry.yaml").write_text(PANTRY)
    (tmp_path / "contingency" / "unlucky.yaml").write_text(UNLUCKY)
    write_third_robot(tmp_path)
    monkeypatch.setenv(ASSETS_VARIABLE, str(tmp_path))
    return tmp_path


def test_ones_own_robot_picks_ones_own_type_in_ones_own_room(folder: Path) -> None:
    session = Session("stubby", image_size=0)
    session.reset(FreePlay("pantry"), seed=0)
    for text in ("GoTo(Shelf_1)", "GoTo(Teapot_1)", "Pick(left, Teapot_1)"):
        if text.startswith("GoTo(Teapot"):
            assert "Teapot_1" in session.observation().visible_objects
        _, feedback = session.step(PlanStep.parse(text))
        assert feedback.success, feedback.to_text()
    assert session.world.grasps.held("left") == "Teapot_1"


def test_ones_own_luck(folder: Path) -> None:
    session = Session("stubby", "natural", image_size=0, contingency="unlucky")
    session.reset(FreePlay("pantry"), seed=0)
    for text in ("GoTo(Shelf_1)", "GoTo(Teapot_1)"):
        session.step(PlanStep.parse(text))
    _, feedback = session.step(PlanStep.parse("Pick(left, Teapot_1)"))
    assert feedback.outcomes[0].code == "Slipped" and session.world.grasps.held("left") is None


def test_they_are_listed_beside_the_projects(folder: Path) -> None:
    assert "pantry" in room_names() and "kitchen_1" in room_names()
    assert available_robots() == ("h1", "stubby", "x1")
    assert list(load_catalogue().types)[-1] == "Teapot"
    assert load_contingency("unlucky").rules[0].types == ("Teapot",)
    config = build(EvalConfig, compose("eval", ["robot=stubby"]))
    assert config.robot.name == "stubby" and config.robot.spec == str(folder / "robots" / "stubby.yaml")
    with pytest.raises(ConfigError, match="robot='atlas' is not allowed; allowed: h1, x1, stubby"):
        compose("eval", ["robot=atlas"])


def test_they_are_gone_without_the_variable(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert load_room("pantry").furniture[0].id == "Shelf_1"
    monkeypatch.delenv(ASSETS_VARIABLE)
    with pytest.raises(ValueError, match="unknown room 'pantry'"):
        load_room("pantry")
    with pytest.raises(ValueError, match="unknown object type 'Teapot'"):
        load_catalogue().get("Teapot")
    with pytest.raises(ConfigError, match="'stubby': no such robot"):
        load_robot("stubby")


def test_a_file_cannot_replace_one_of_the_projects(folder: Path) -> None:
    (folder / "rooms" / "kitchen_1.yaml").write_text(PANTRY)
    with pytest.raises(ConfigError, match="has a file 'kitchen_1' in rooms already"):
        load_room("kitchen_1")
    (folder / "types" / "mug.yaml").write_text(TEAPOT.replace("Teapot", "Mug").replace("mint", "minty"))
    with pytest.raises(ConfigError, match="type 'Mug' exists already"):
        load_catalogue()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("pickupable", "edible"), "Teapot: unknown property 'edible'"),
        (("mint, ", "ultraviolet, "), "colour"),
        (("    mass: 0.5\n", ""), "mass: missing"),
        (("    mass: 0.5\n", "    mass: heavy\n"), "mass: expected"),
        (("parts:", "bits:"), "parts: expected a list"),
        (("version: 1", "version: 2"), "version 2 is not supported"),
        (("[0.6, 0.9, 0.75]", "[0.6, 0.9]"), "colour 'mint' must be"),
    ],
)
def test_bad_types_are_refused_by_name(folder: Path, change: tuple[str, str], message: str) -> None:
    text = TEAPOT.replace("mint]", "mint, flat]")
    assert change[0] in text
    (folder / "types" / "crockery.yaml").unlink()
    (folder / "types" / "bad.yaml").write_text(text.replace(*change))
    with pytest.raises(ConfigError, match=message):
        load_catalogue()


def test_a_wrong_folder_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(ASSETS_VARIABLE, str(tmp_path / "nowhere"))
    with pytest.raises(ConfigError, match="nowhere' is not a folder"):
        room_names()
    (tmp_path / "room").mkdir()
    monkeypatch.setenv(ASSETS_VARIABLE, str(tmp_path))
    with pytest.raises(ConfigError, match="folder 'room' is no kind of asset; allowed: rooms, types, robots, contingency"):
        room_names()
