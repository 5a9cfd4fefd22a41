"""Pictures: geometry of depth, segmentation and intrinsics, lit states, errors."""

from __future__ import annotations

import gc
from concurrent.futures import ThreadPoolExecutor

import mujoco
import numpy as np
import pytest

from robots.gl import RenderingError, select_backend
from robots.spec import load_robot
from sim.scene.objects import ObjectPlacement
from sim.scene.rooms import room_names
from sim.world.canvas import Canvas
from sim.world.rendering import CAMERAS, Renderer
from sim.world.world import World


@pytest.fixture(scope="module")
def world() -> World:
    return World(
        load_robot("h1"),
        "kitchen_1",
        [ObjectPlacement("Mug_1", "CounterTop_1", (-0.6, 2.2)), ObjectPlacement("Apple_1", "DiningTable_1")],
    )


@pytest.mark.parametrize("camera", CAMERAS)
def test_every_camera_sees_something(world: World, camera: str) -> None:
    view = world.cameras.render(camera, depth=True, segmentation=True)
    assert view.rgb.shape == (112, 112, 3) and view.rgb.dtype == np.uint8
    assert view.depth is not None and view.depth.dtype == np.float32 and np.isfinite(view.depth).all()
    assert view.segmentation is not None and len(np.unique(view.segmentation)) > 2
    assert view.rgb.std() > 5.0


def test_depth_and_pose_reproject_to_the_object(world: World) -> None:
    view = world.cameras.render("head", 224, 224, depth=True, segmentation=True)
    assert view.depth is not None and view.segmentation is not None
    rows, columns = np.nonzero(view.segmentation == list(world.objects).index("Mug_1"))
    assert len(rows) > 20
    z = view.depth[rows, columns]
    rays = np.linalg.inv(view.intrinsics) @ np.stack([columns + 0.5, rows + 0.5, np.ones(len(rows))])
    points = (view.camera_in_world[:3, :3] @ (rays * z)).T + view.camera_in_world[:3, 3]
    low, high = world.poses.bounds("Mug_1")
    assert np.all(points > low - 0.02) and np.all(points < high + 0.02)


def test_depth_agrees_with_a_ray_cast(world: World) -> None:
    view = world.cameras.render("head", depth=True)
    assert view.depth is not None
    ray = np.linalg.inv(view.intrinsics) @ np.array([56.5, 40.5, 1.0])
    direction = view.camera_in_world[:3, :3] @ ray
    torso = int(world.model.cam_bodyid[world.model.camera("head").id])  # the camera sits inside the head's shell
    hit = np.zeros(1, dtype=np.int32)
    groups = np.array([1, 1, 1, 0, 0, 0], dtype=np.uint8)
    scale = mujoco.mj_ray(
        world.model, world.data, view.camera_in_world[:3, 3], direction / np.linalg.norm(direction), groups, 1, torso, hit
    )
    assert view.depth[40, 56] == pytest.approx(scale / np.linalg.norm(ray), abs=0.02)


def test_visible_objects(world: World) -> None:
    seen = world.cameras.visible_objects()
    assert "Mug_1" in seen and "CounterTop_1" in seen
    assert "Apple_1" not in seen  # the table is behind the robot
    assert "CounterTop_1" not in world.cameras.visible_objects(range_m=0.3)


def test_agrees_with_mujocos_own_renderer(world: World) -> None:
    view = world.cameras.render("left", 80, 100, depth=True, segmentation=True)
    option = mujoco.MjvOption()
    option.sitegroup[:] = 0
    option.geomgroup[3:] = 0
    with mujoco.Renderer(world.model, 80, 100) as renderer:
        renderer.scene.flags[int(mujoco.mjtRndFlag.mjRND_SHADOW)] = 0
        renderer.scene.flags[int(mujoco.mjtRndFlag.mjRND_REFLECTION)] = 0
        renderer.update_scene(world.data, camera="left", scene_option=option)
        assert np.array_equal(renderer.render(), view.rgb)
        renderer.enable_depth_rendering()
        assert view.depth == pytest.approx(renderer.render(), rel=1e-4)


def test_lamps_light_up() -> None:
    room = World(None, "living_room_1", [])
    before = room.cameras.render("overview", 224, 224).rgb.astype(int)
    room.states.set_state("Television_1", "isToggled", True)
    after = room.cameras.render("overview", 224, 224).rgb.astype(int)
    assert np.abs(after - before).max() > 80


def test_two_sizes_and_repeated_pictures_are_equal(world: World) -> None:
    assert np.array_equal(world.cameras.render().rgb, world.cameras.render().rgb)
    assert world.cameras.render("front", 60, 90).rgb.shape == (60, 90, 3)


def test_labels_alone_are_those_of_a_picture(world: World) -> None:
    for camera in ("head", "behind", "plan"):
        assert np.array_equal(
            world.cameras.labels(camera, 96, 128), world.cameras.render(camera, 96, 128, segmentation=True).segmentation
        )


def test_bad_requests_are_refused(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ValueError, match="unknown camera 'rear'"):
        world.cameras.render("rear")
    with pytest.raises(ValueError, match="image size 0"):
        world.cameras.render("head", 0, 10)
    monkeypatch.setenv("MUJOCO_GL", "vulkan")
    with pytest.raises(RenderingError, match="vulkan"):
        select_backend()
    monkeypatch.setattr(mujoco, "GLContext", _broken)
    with pytest.raises(RenderingError, match="libegl1"):
        Canvas(world.model, 20, 20)


def _broken(*_: object) -> None:
    raise RuntimeError("no display")


@pytest.mark.parametrize("room", ["kitchen_1", "bathroom_2"])
def test_leaving_out_what_is_not_in_view_changes_no_pixel(room: str) -> None:
    world = World(load_robot("x1"), room)
    renderer = Renderer(world.scene, 96, 128)
    for yaw in (0.0, 1.1, 2.5, -1.7):
        world.grasps.put_base(*world.servos.base_pose[:2], yaw)
        for camera in CAMERAS:
            culled = renderer.view(camera, depth=True, segmentation=True)
            renderer._out_of_view = lambda _: np.zeros(world.model.ngeom, dtype=bool)  # type: ignore[method-assign]
            whole = renderer.view(camera, depth=True, segmentation=True)
            del renderer._out_of_view
            for name in ("rgb", "depth", "segmentation"):
                assert np.array_equal(getattr(culled, name), getattr(whole, name)), (camera, name)
    assert renderer._out_of_view(int(world.model.camera(world.robot.head_camera).id)).mean() > 0.2  # type: ignore[union-attr]


@pytest.mark.parametrize("room", room_names())
def test_cameras_around_the_robot_see_it_and_the_head_sees_no_sky(room: str) -> None:
    world = World(load_robot("x1"), room, placements=[])
    for yaw in (0.0, 2.0, -2.0):
        world.grasps.put_base(*world.servos.base_pose[:2], yaw)
        views = {
            camera: world.cameras.render(camera, 112, 112, segmentation=True) for camera in ("front", "left", "right", "behind")
        }
        hidden = [camera for camera, view in views.items() if (view.segmentation == -2).sum() <= 250]
        assert len(hidden) <= 1, (hidden, yaw)  # furniture beside the robot may stand between
        head = world.cameras.render("head", 112, 112, depth=True).depth
        assert head is not None and head.max() < 12.0, "walls and ceiling close the room"


@pytest.mark.slow
def test_canvases_that_are_given_up_harm_no_other() -> None:
    world = World(None, "bathroom_1")
    view = world.cameras.render("overview", 40, 40, segmentation=True)
    for size in range(41, 75):  # more than the process keeps
        world.cameras.render("overview", size, size)
    world.cameras.close()
    again = world.cameras.render("overview", 40, 40, segmentation=True)
    assert np.array_equal(view.rgb, again.rgb) and np.array_equal(view.segmentation, again.segmentation)
    lamp = World(None, "living_room_1")
    assert len(np.unique(lamp.cameras.render("overview", 64, 64, segmentation=True).segmentation)) > 5


def test_pictures_for_people_have_shadows_and_leave_those_of_planners_alone(world: World) -> None:
    before = [world.cameras.render(camera, 120, 160).rgb for camera in ("head", "overview")]
    pretty = world.cameras.render("overview", 120, 160, pretty=True).rgb
    after = [world.cameras.render(camera, 120, 160).rgb for camera in ("head", "overview")]
    assert all(np.array_equal(one, other) for one, other in zip(before, after, strict=True))
    assert np.abs(pretty.astype(int) - after[1]).mean() > 5.0
    assert np.array_equal(pretty, world.cameras.render("overview", 120, 160, pretty=True).rgb)


@pytest.mark.parametrize("camera", ["left", "overview"])
def test_the_lamp_shines_through_the_ceiling(world: World, camera: str) -> None:
    """A ceiling that cast a shadow would leave all but the tops of the walls in the dark."""
    plain, pretty = (world.cameras.render(camera, 120, 160, pretty=one).rgb.astype(int) for one in (False, True))
    floor = slice(90, 120)
    assert pretty[floor].mean() > 0.85 * plain[floor].mean()


def test_canvases_of_other_threads_harm_no_other() -> None:
    def seen() -> tuple[np.ndarray, np.ndarray]:
        view = World(None, "bathroom_1").cameras.render("overview", 50, 50, segmentation=True)
        assert view.segmentation is not None
        return view.rgb, view.segmentation

    mine = seen()
    for _ in range(3):
        with ThreadPoolExecutor(1) as pool:
            assert all(np.array_equal(*pair) for pair in zip(pool.submit(seen).result(), mine, strict=True))
    gc.collect()
    assert all(np.array_equal(*pair) for pair in zip(seen(), mine, strict=True))
