import numpy as np
import pytest
import torch

from interface.bodies import KEY_BODIES
from interface.observation import Camera
from proprio_mllm.model.geometry import arm_length_m, body_point_in_pelvis, centroid, project, unproject
from proprio_mllm.model.mpe import MPE_MODES, SignEmbedding, position_ids, relative_cells, visual_positions

PAD = 9


def _camera(height_m: float = 0.6) -> Camera:
    """Looks straight ahead from `height_m` above the pelvis; 90 degrees of view over 100 pixels."""
    pose = np.eye(4)
    pose[:3, :3] = [[0, 0, 1], [-1, 0, 0], [0, -1, 0]]
    pose[:3, 3] = [0.0, 0.0, height_m]
    return Camera(np.array([[50.0, 0, 50], [0, 50, 50], [0, 0, 1]]), pose, 100, 100)


def test_key_bodies_are_the_robots():
    spec = pytest.importorskip("robots.spec")
    assert tuple(spec.KEY_BODIES) == KEY_BODIES


def test_project_by_hand():
    # 2 m ahead, 0.4 m left, 0.2 m above the camera: x = 50 - 50 * 0.4 / 2, y = 50 - 50 * 0.2 / 2.
    assert project(_camera(), np.array([2.0, 0.4, 0.8])) == pytest.approx((40.0, 45.0))


def test_points_behind_the_camera_fall_outside_on_their_side():
    x, y = project(_camera(), np.array([-0.1, 0.0, 0.2]))
    assert x == pytest.approx(50.0)
    assert y == pytest.approx(50 + 50 * 0.4 / 0.05)


def _bodies() -> np.ndarray:
    bodies = np.zeros((14, 3))
    for side, y in (("left", 0.2), ("right", -0.2)):
        bodies[KEY_BODIES.index(f"{side}_shoulder")] = [0, y, 0.4]
        bodies[KEY_BODIES.index(f"{side}_elbow")] = [0, y, 0.1]
        bodies[KEY_BODIES.index(f"{side}_hand")] = [0.2, y, 0.1]
    return bodies


def test_body_points_by_hand():
    bodies = _bodies()
    assert arm_length_m(bodies) == pytest.approx(0.5)
    np.testing.assert_allclose(body_point_in_pelvis(bodies, "body"), [0.4 / 14, 0, 1.2 / 14], atol=1e-12)
    np.testing.assert_allclose(body_point_in_pelvis(bodies, "arms"), [0.1, 0, 0.1], atol=1e-12)
    np.testing.assert_allclose(body_point_in_pelvis(bodies, "reach"), [0.5, 0, 1.2 / 14], atol=1e-12)
    with pytest.raises(ValueError, match="'nose' is not allowed"):
        body_point_in_pelvis(bodies, "nose")
    with pytest.raises(ValueError, match=r"\(3, 3\)"):
        body_point_in_pelvis(np.zeros((3, 3)), "body")


def test_signs_through_the_projection_by_hand():
    # Reach point: 0.5 m ahead at height 1.2 / 14 = 0.0857 m; the camera is at 0.1857 m, so y = 50 + 50 * 0.1 / 0.5 = 60.
    place = centroid(_camera(1.2 / 14 + 0.1), _bodies(), "reach")
    assert place == pytest.approx((0.5, 0.6))
    # 4 x 4 cells of 25 pixels: the robot at row 2.4 (centres 0.5 1.5 2.5 3.5), column 2.0, on a border: no token is level.
    ids, after = visual_positions("rope_sign", 7, 4, 4, place)
    rows = [7, 7, 8, 9]
    assert ids[0].tolist() == [7] * 16
    assert ids[1].reshape(4, 4).tolist() == [[r] * 4 for r in rows]
    assert ids[2].reshape(4, 4).tolist() == [[7, 7, 9, 9]] * 4
    assert after == 10


@pytest.mark.parametrize(
    ("mode", "height", "width", "after"),
    [
        ("mrope", [[5, 5], [6, 6]], [[5, 6], [5, 6]], 7),
        ("rope_sign", [[5, 5], [6, 6]], [[6, 7], [6, 7]], 8),
        ("rope_sign_raw", [[-1, -1], [0, 0]], [[0, 1], [0, 1]], 6),
        ("rope_radial", [[4, 4], [5, 5]], [[5, 6], [5, 6]], 7),
        ("embed_sign", [[5, 5], [6, 6]], [[5, 6], [5, 6]], 7),
        ("rope_sign+embed", [[5, 5], [6, 6]], [[6, 7], [6, 7]], 8),
    ],
)
def test_golden_ids_of_every_mode(mode, height, width, after):
    ids, following = visual_positions(mode, 5, 2, 2, (0.25, 0.75))  # robot in row 1, column 0
    assert ids[0].tolist() == [5] * 4
    assert ids[1].reshape(2, 2).tolist() == height
    assert ids[2].reshape(2, 2).tolist() == width
    assert following == after


def test_sequence_ids_with_two_images_and_text():
    tokens = [1, 2, PAD, PAD, PAD, PAD, 3, PAD, PAD, PAD, PAD, 4]
    ids = position_ids(tokens, PAD, [(2, 2), (2, 2)], [(0.25, 0.75), None], "rope_sign")
    assert ids[1].tolist() == [0, 1, 2, 2, 3, 3, 5, 6, 6, 7, 7, 8]  # the second image has no robot: as M-RoPE
    assert ids[0].tolist() == [0, 1, 2, 2, 2, 2, 5, 6, 6, 6, 6, 8]


def test_adjacent_images_stay_apart():
    ids = position_ids([PAD, PAD], PAD, [(1, 1), (1, 1)], [(0.5, 0.5)] * 2, "rope_sign")
    assert ids.tolist() == [[0, 3], [1, 4], [1, 4]]


@pytest.mark.parametrize(
    ("tokens", "grids", "message"),
    [
        ([PAD, 1], [], "more image tokens"),
        ([PAD, 1], [(2, 1)], "expected 2 image tokens at position 0"),
        ([1, 2], [(1, 1)], "1 images but image tokens of 0"),
    ],
)
def test_mismatched_images_are_refused(tokens, grids, message):
    with pytest.raises(ValueError, match=message):
        position_ids(tokens, PAD, grids, [None] * len(grids), "mrope")


def test_signs_are_steady_when_the_robot_looks_straight_ahead():
    exact = relative_cells(4, 4, (0.5, 0.64))
    for noise in (-1e-12, 1e-12):
        assert torch.equal(relative_cells(4, 4, (0.5 + noise, 0.64)), exact)
    assert exact[1].reshape(4, 4)[0].tolist() == [-2, -1, 1, 2]


def test_far_and_infinite_centroids():
    cells = relative_cells(4, 4, (0.5, 500.0))
    assert cells[0].tolist() == [r - 8 for r in range(4) for _ in range(4)]
    with pytest.raises(ValueError, match="finite"):
        relative_cells(2, 2, (float("nan"), 0.0))


def test_unknown_mode_is_refused():
    with pytest.raises(ValueError, match="mpe.mode 'x' is not allowed; allowed: " + ", ".join(MPE_MODES).replace("+", r"\+")):
        visual_positions("x", 0, 1, 1, None)


def test_embedding_picks_the_sign_pair():
    embedding = SignEmbedding(3)
    assert not embedding(2, 2, (0.25, 0.75)).any()
    with torch.no_grad():
        embedding.table.copy_(torch.arange(9.0)[:, None].expand(9, 3))
    # robot in row 1, column 0: signs (row, column) are (-, 0), (-, +), (0, 0), (0, +).
    assert embedding(2, 2, (0.25, 0.75))[:, 0].tolist() == [1.0, 2.0, 4.0, 5.0]
    assert not embedding(2, 2, None).any()


def test_unproject_inverts_project():
    camera = _camera()
    depth = np.full((100, 100), 2.0)
    points = unproject(depth, camera.intrinsics)
    in_pelvis = camera.camera_in_pelvis[:3, :3] @ points[30, 80] + camera.camera_in_pelvis[:3, 3]
    assert project(camera, in_pelvis) == pytest.approx((80.5, 30.5), abs=1e-4)
    with pytest.raises(ValueError, match=r"depth \(H, W\)"):
        unproject(np.zeros(4), camera.intrinsics)
