"""The catalogue: complete, consistent with its own measurements, refused when wrong."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pytest
import yaml

from sim.scene.catalogue import CATALOGUE_PATH, ObjectType, Part, load_catalogue
from sim.scene.compiler import build_type_spec
from sim.scene.objects import index_object

TYPES = tuple(load_catalogue().types)


def test_there_are_68_types() -> None:
    assert len(TYPES) == 68
    assert load_catalogue().index("Cabinet") == 0


@pytest.mark.parametrize("name", TYPES)
def test_built_type_has_its_measured_size_and_mass(name: str) -> None:
    catalogue = load_catalogue()
    kind = catalogue.get(name)
    model = build_type_spec(name).compile()
    obj = index_object(model, f"{name}_1", catalogue)
    size = obj.local_max - obj.local_min
    if name == "CounterTop":  # measured without the cupboard below it
        assert obj.local_max[2] == pytest.approx(0.90)
        size[2] = kind.size[2]
    if name == "Shelf":  # measured as a storage volume above its board
        assert size[2] == pytest.approx(kind.size[2], abs=0.01)
    if name == "Laptop":  # measured open
        assert size[2] == pytest.approx(0.03, abs=0.002)
        size[2] = kind.size[2]
    size[:2] = np.sort(size[:2])[::-1]  # most types face along their short side, a toilet along its long one
    assert np.all(size <= np.asarray(kind.size) * 1.12 + 0.025), size
    assert np.all(size >= np.asarray(kind.size) * 0.6 - 0.02), size
    if kind.movable:
        assert obj.mass_kg == pytest.approx(kind.mass, rel=1e-6)
        assert obj.movable
    assert kind.receptacle == bool(obj.surfaces)
    assert kind.toggleable == (obj.toggle_site >= 0)
    for part in obj.moving:
        assert part.handle_site >= 0


@pytest.mark.parametrize("name", [n for n in TYPES if load_catalogue().get(n).movable])
def test_movable_types_stand_still(name: str) -> None:
    model = build_type_spec(name).compile()
    data = mujoco.MjData(model)
    data.qpos[2] = 0.002
    for _ in range(500):
        mujoco.mj_step(model, data)
    assert np.linalg.norm(data.qpos[:3] - (0, 0, 0.001)) < 0.02
    assert data.xmat[1].reshape(3, 3)[2, 2] > 0.99


def test_bad_parts_are_refused() -> None:
    with pytest.raises(ValueError, match="unknown shape 'sphere'"):
        Part.parse(["sphere", 0, 0, 0, 1, 1, 1, "red"], "x")
    with pytest.raises(ValueError, match="a part is"):
        Part.parse(["box", 0], "x")
    with pytest.raises(ValueError, match="six numbers"):
        Part.parse(["box", 0, 0, 0, 1, -1, 1, "red"], "x")
    with pytest.raises(ValueError, match="wall thickness"):
        Part.parse(["tray", 0, 0, 0, 1, 1, 1, "red"], "x")
    with pytest.raises(ValueError, match="unknown option 'shiny'"):
        Part.parse(["box", 0, 0, 0, 1, 1, 1, "red", "shiny"], "x")


def test_bad_types_are_refused() -> None:
    with pytest.raises(ValueError, match="unknown property 'edible'"):
        ObjectType("X", (), (1, 1, 1), None, frozenset({"edible"}), ())
    with pytest.raises(ValueError, match="unknown grip 'triple'"):
        ObjectType("X", (), (1, 1, 1), None, frozenset(), (), grips={"triple": ()})
    with pytest.raises(ValueError, match="unknown object type 'Unicorn'"):
        load_catalogue().get("Unicorn")
    with pytest.raises(ValueError, match="unknown property 'edible'"):
        load_catalogue().get("Mug").has("edible")


def test_bad_files_are_refused(tmp_path: Path) -> None:
    raw = yaml.safe_load(CATALOGUE_PATH.read_text())
    (tmp_path / "a.yaml").write_text(yaml.safe_dump(raw | {"version": 9}))
    with pytest.raises(ValueError, match="version 9"):
        load_catalogue(tmp_path / "a.yaml")
    raw["types"]["Mug"]["parts"][0][7] = "ultraviolet"
    (tmp_path / "b.yaml").write_text(yaml.safe_dump(raw))
    with pytest.raises(ValueError, match="ultraviolet"):
        load_catalogue(tmp_path / "b.yaml")
