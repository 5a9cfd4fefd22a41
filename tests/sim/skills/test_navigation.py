"""Navigation: paths are free and short, stances are free and face the target."""

import numpy as np
import pytest

from sim.skills.navigation import NavigationMap, Rectangle, wrap_angle

ROOM = (0.0, 0.0, 4.0, 3.0)


@pytest.fixture(scope="module")
def walled():
    """A room with a wall from the south that leaves a gap of 1 m in the north, and a turned table."""
    return NavigationMap(ROOM, (Rectangle((2.0, 1.0), (0.05, 1.0)), Rectangle((3.2, 0.8), (0.3, 0.2), 0.5)), 0.3)


def test_rectangle_distance_matches_a_dense_sampling():
    box = Rectangle((1.0, 2.0), (0.4, 0.2), 0.7)
    rng = np.random.default_rng(0)
    local = rng.uniform(-1.0, 1.0, (40000, 2)) * np.array(box.half)
    c, s = np.cos(0.7), np.sin(0.7)
    cloud = local @ np.array([[c, s], [-s, c]]) + box.center
    for point in rng.uniform(0.0, 3.0, (8, 2)):
        nearest = np.linalg.norm(cloud - point, axis=1).min()
        assert box.distance(point[None])[0] == pytest.approx(nearest, abs=0.02)


def test_path_goes_round_the_wall(walled):
    start, goal = np.array([1.0, 0.8]), np.array([2.6, 1.6])
    path = walled.path(start, goal)
    assert path is not None
    assert np.allclose(path[0], start) and np.allclose(path[-1], goal)
    for a, b in zip(path[:-1], path[1:], strict=True):
        assert walled.segment_free(a, b, slack_m=0.02)
    length = np.linalg.norm(np.diff(path, axis=0), axis=1).sum()
    taut = np.hypot(1.05, 1.5) + np.hypot(0.7, 0.7)  # no shorter way exists than over the wall's corner
    assert np.linalg.norm(goal - start) < length < taut + 0.6


def test_no_path_into_an_obstacle_or_a_closed_room(walled):
    assert walled.path(np.array([1.0, 0.8]), np.array([2.0, 1.0])) is None
    closed = NavigationMap(ROOM, (Rectangle((2.0, 1.5), (0.05, 1.5)),), 0.3)
    assert closed.path(np.array([1.0, 1.0]), np.array([3.0, 1.0])) is None


def test_free_travel_stops_before_the_wall(walled):
    travelled = walled.free_travel(np.array([1.0, 1.0]), np.array([3.0, 1.0]))
    assert travelled == pytest.approx(2.0 - 0.05 - 0.3 - 1.0, abs=0.04)


def test_leaving_a_margin_is_allowed(walled):
    start = np.array([1.7, 1.0])  # 5 cm inside the wall's margin
    assert walled.free_travel(start, np.array([1.0, 1.0])) == pytest.approx(0.7)
    assert walled.free_travel(start, np.array([1.9, 1.0])) < 0.05


def test_stances_are_free_and_face_the_target(walled):
    target = np.array([3.2, 0.8])
    for bearing in (0.0, 0.4):
        stances = walled.stances(target, (0.7, 0.9), bearing)
        assert stances
        for stance in stances:
            assert walled.is_free(stance.position)
            direction = target - stance.position
            seen = wrap_angle(float(np.arctan2(direction[1], direction[0])) - stance.yaw_rad)
            assert seen == pytest.approx(bearing, abs=1e-9)


def test_same_question_same_answer(walled):
    a, b = np.array([0.5, 0.5]), np.array([3.5, 2.5])
    first, second = walled.path(a, b), walled.path(a, b)
    assert first is not None and second is not None and np.array_equal(first, second)


def test_bad_maps_are_refused():
    with pytest.raises(ValueError, match="bounds must be"):
        NavigationMap((0.0, 0.0, 0.0, 1.0), (), 0.3)
    with pytest.raises(ValueError, match="radius_m must be positive, got -1"):
        NavigationMap(ROOM, (), -1)


def test_wrap_angle():
    assert wrap_angle(3 * np.pi) == pytest.approx(np.pi)
    assert wrap_angle(-0.5) == -0.5
