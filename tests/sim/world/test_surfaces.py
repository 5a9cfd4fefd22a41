"""Surfaces for people: on the right geoms of their pictures, and on none of the planners'."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from robots.spec import load_robot
from sim.scene.rooms import room_names
from sim.world.decor import wall_decor
from sim.world.rendering import surfaces
from sim.world.world import World


@pytest.mark.parametrize("room", room_names())
def test_no_geom_of_a_scene_has_a_surface(room: str) -> None:
    model = World(None, room).model
    names = [model.material(index).name for index in range(model.nmat)]
    assert not any(names[material].startswith("surface/") for material in model.geom_matid if material >= 0)


def test_wood_is_on_wood_and_pictures_for_planners_stay_plain() -> None:
    world = World(load_robot("x1"), "living_room_1")
    model, plain = world.model, world.cameras.render("overview", 120, 160).rgb
    found = {model.geom(geom).name: model.material(material).name for geom, material in surfaces(model).items()}
    assert found["floor"] == "surface/floor" and found["wall_north"] == "surface/plaster"
    assert {name.split("/")[0] for name, of in found.items() if of == "surface/wood"} >= {"CoffeeTable_1", "Dresser_1"}
    assert {name.split("/")[0] for name, of in found.items() if of == "surface/fabric"} >= {"Sofa_1"}
    assert not any(name.startswith("Television") for name in found)
    before = model.geom_matid.copy()
    world.cameras.render("overview", 120, 160, pretty=True)
    assert np.array_equal(model.geom_matid, before)
    assert np.array_equal(world.cameras.render("overview", 120, 160).rgb, plain)


def test_floors_are_of_the_rooms_colours() -> None:
    def floor(room: str) -> np.ndarray:
        model = World(None, room).model
        texture = model.texture("surface/floor")
        count = int(texture.width[0]) * int(texture.height[0]) * 3
        return model.tex_data[int(texture.adr[0]) :][:count].reshape(-1, 3).astype(float) / 255.0

    assert floor("kitchen_2").mean(0) == pytest.approx([0.72, 0.70, 0.67], abs=0.06)
    planks = floor("living_room_1")
    assert planks.mean(0) == pytest.approx([0.60, 0.44, 0.30], abs=0.08) and planks.std() > 0.1


def test_what_hangs_on_walls_is_no_object() -> None:
    world = World(None, "bathroom_1")
    pretty = world.cameras.render("overview", 240, 320, segmentation=True, pretty=True)
    plain = world.cameras.render("overview", 240, 320, segmentation=True)
    assert pretty.segmentation is not None and plain.segmentation is not None
    assert np.array_equal(pretty.segmentation, plain.segmentation)


@pytest.mark.parametrize("room", room_names())
def test_windows_are_where_no_furniture_is(room: str) -> None:
    world = World(None, room)
    model, data = world.model, world.data
    boards = wall_decor(world.scene)
    skirting = [one for one in boards if one.centre[1] < -model.geom_size[one.wall, 1] + 0.1]
    glass = [one for one in boards if one.rgba[2] > one.rgba[0] + 0.1]
    assert len({one.wall for one in skirting}) == len(skirting) == 4
    assert 1 <= len(glass) <= 2 and len(boards) == 4 + 8 * len(glass)
    for one in glass:
        axes = data.geom_xmat[one.wall].reshape(3, 3)
        middle = data.geom_xpos[one.wall] + axes @ one.centre
        for corner in np.array([(x, y) for x in (-1, 0, 1) for y in (-1, 0, 1)]) * one.size[:2]:
            hit = np.zeros(1, dtype=np.int32)
            start = middle + axes @ (*corner, 0.65)
            mujoco.mj_ray(model, data, start, -axes[:, 2], np.array([1, 1, 1, 0, 0, 0], dtype=np.uint8), 1, -1, hit)
            fixed = int(model.body_weldid[model.geom_bodyid[hit[0]]]) == 0
            assert hit[0] == one.wall or not fixed, model.geom(int(hit[0])).name
