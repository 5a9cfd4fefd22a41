"""Surfaces for people: on the right geoms of their pictures, and on none of the planners'."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from robots.spec import load_robot
from sim.scene.objects import ObjectPlacement
from sim.scene.rooms import room_names
from sim.world.decor import ring_walls, wall_decor
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
    other = pretty.segmentation != plain.segmentation  # but at the edge of what is round for people
    rings = ring_walls(world.scene)
    round_ones = {index for index, obj in enumerate(world.objects.values()) if set(obj.geom_ids.tolist()) & set(rings)}
    assert set(plain.segmentation[other]) | set(pretty.segmentation[other]) <= {-1, *range(len(world.objects))}
    assert all({a, b} & round_ones for a, b in zip(plain.segmentation[other], pretty.segmentation[other], strict=True))
    assert other.mean() < 0.01


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


def test_bowls_are_round_for_people_and_have_eight_walls_otherwise() -> None:
    world = World(None, "kitchen_1", [ObjectPlacement("Bowl_1", "DiningTable_1"), ObjectPlacement("Mug_1", "DiningTable_1")])
    rings = ring_walls(world.scene)
    bowl = world.objects["Bowl_1"]
    assert set(rings) <= set(bowl.geom_ids.tolist()) and len(rings) == 8
    assert list(rings.values()) == pytest.approx([min(bowl.type.size[:2]) / 2.0 - 0.005] * 8, abs=1e-3)
    middle, near = world.poses.center("Bowl_1"), np.eye(4)
    near[:3, :3] = np.diag([1.0, -1.0, -1.0])  # straight down
    near[:3, 3] = middle + (0.0, 0.0, 0.4)
    outlines = []
    for pretty in (False, True):
        picture = world.cameras.render_from(near, 40.0, 200, 200, pretty=pretty).astype(int)
        yellow = (picture[..., 1] > 0.82 * picture[..., 0]) & (picture[..., 2] < 0.5 * picture[..., 0])
        rows, columns = np.nonzero(yellow)
        around = np.arctan2(rows - 100, columns - 100)
        reach = np.hypot(rows - 100, columns - 100)
        sectors = ((around + np.pi) / (2.0 * np.pi) * 36).astype(int) % 36
        edge = np.array([reach[sectors == sector].max() for sector in range(36)])
        outlines.append(edge.std() / edge.mean())
    assert outlines[1] < 0.6 * outlines[0]


def test_thin_walls_are_not_specked_with_their_own_shadows() -> None:
    """Neighbouring pixels of a bin differ by 8 levels of 255, by 23 where its walls cast shadows on themselves."""
    world = World(None, "living_room_1")
    view = world.cameras.render("overview", 360, 480, pretty=True, segmentation=True)
    assert view.segmentation is not None
    bin_ = view.segmentation == list(world.objects).index("GarbageCan_1")
    steps = np.abs(np.diff(view.rgb[..., 1].astype(float), axis=1))
    assert bin_.sum() > 300 and steps[bin_[:, 1:] & bin_[:, :-1]].mean() < 14.0
