"""Point maps, CSE, dense head."""

import dataclasses

import numpy as np
import pytest
import torch

from configs.schema.model import CseConfig, PointMapConfig
from proprio_mllm.model.batch import Collator, Example
from proprio_mllm.model.building import build_model, build_point_map, build_processor
from proprio_mllm.model.cse import CrossSpatialEncoder
from proprio_mllm.model.dense import DenseHead, shown_shares
from proprio_mllm.model.point_map import GeoFeatures, OraclePointMap, SimPointMap, point_map_loss
from proprio_mllm.model.prompts import looking
from tests.model.conftest import TEXTS, TYPES, make_view, small


def _geo(points: torch.Tensor, channels: int = 0) -> GeoFeatures:
    tokens = torch.randn(len(points), channels, 4, 4) if channels else None
    return GeoFeatures(tokens, points, torch.ones(points.shape[:3]))


def test_points_reach_their_cells_in_the_pelvis_frame():
    encoder = CrossSpatialEncoder(CseConfig(source="points", frame="pelvis"), hidden=8, token_dim=0)
    points = torch.zeros(1, 8, 8, 3)
    points[0, :, :, 2] = 2.0  # 2 m in front of the camera
    points[0, 2, 5] = torch.tensor([0.4, 0.0, 2.0])
    pose = torch.eye(4)[None].clone()
    pose[0, :3, :3] = torch.tensor([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
    pose[0, :3, 3] = torch.tensor([0.1, 0.0, 0.6])
    out = encoder.spatial(_geo(points), 2, 2, pose).reshape(1, 2, 2, 4, 2, 2)  # cell row, column; x y z conf; sub-cell
    assert torch.allclose(out[0, 1, 0, 0], torch.tensor(2.1 / 2))  # x forward, half scale
    assert torch.allclose(out[0, 1, 0, 2], torch.tensor(0.6 / 2))
    # Pixel (2, 5) is in cell (0, 1), sub-cell (1, 0) of four pixels: mean y is -0.4 / 4.
    assert out[0, 0, 1, 1, 1, 0] == pytest.approx(-0.1 / 2)
    with pytest.raises(ValueError, match="camera pose"):
        encoder.spatial(_geo(points), 2, 2, None)


def test_missing_points_do_not_pull_the_mean():
    encoder = CrossSpatialEncoder(CseConfig(source="points", frame="camera"), hidden=8, token_dim=0)
    truth = torch.full((1, 4, 4, 3), 3.0)
    truth[0, 0, 0] = torch.nan
    geo = OraclePointMap()(torch.zeros(1, 3, 4, 4), truth)
    assert geo.conf[0, 0, 0] == 0
    out = encoder.spatial(geo, 1, 1, None).reshape(4, 2, 2)
    torch.testing.assert_close(out[:3], torch.full((3, 2, 2), 1.5))
    with pytest.raises(ValueError, match="needs true points"):
        OraclePointMap()(torch.zeros(1, 3, 4, 4))


@pytest.mark.parametrize("source", ["tokens", "points", "both"])
def test_residual_starts_as_identity_and_literal_is_the_equation(source):
    geo, features = _geo(torch.randn(2, 8, 8, 3), channels=5), torch.randn(2, 16, 8)
    residual = CrossSpatialEncoder(CseConfig(source=source, frame="camera"), 8, 5)
    assert torch.equal(residual(features, residual.spatial(geo, 4, 4, None)), features)
    literal = CrossSpatialEncoder(CseConfig(source=source, frame="camera", literal=True), 8, 5)
    spatial = literal.spatial(geo, 4, 4, None)
    assert torch.equal(literal(features, spatial), literal.mlp(features + literal.phi(spatial)))
    residual.load_state_dict(literal.state_dict())
    torch.testing.assert_close(residual(features, spatial), features + literal(features, spatial))


def test_far_points_are_held_to_ten_metres_and_trust_is_a_logarithm():
    encoder = CrossSpatialEncoder(CseConfig(source="points", frame="camera"), hidden=8, token_dim=0)
    points = torch.tensor([-30.0, 4.0, 30.0]).expand(1, 4, 4, 3)
    for conf, trust in ((1.0, 0.0), (float(np.e), 1.0), (0.5, 0.0)):
        out = encoder.spatial(GeoFeatures(None, points, torch.full((1, 4, 4), conf)), 1, 1, None).reshape(4, 4)
        torch.testing.assert_close(out, torch.tensor([[-5.0], [2.0], [5.0], [trust]]).expand(4, 4))


@pytest.mark.parametrize("grid", [(2, 2), (3, 1), (8, 8), (16, 16)])
def test_every_token_reaches_the_merged_grid(grid):
    encoder = CrossSpatialEncoder(CseConfig(source="tokens"), hidden=8, token_dim=1)
    tokens = torch.ones(1, 1, 8, 8, requires_grad=True)
    rows, columns = grid
    out = encoder.spatial(GeoFeatures(tokens, torch.zeros(1, 8, 8, 3), torch.ones(1, 8, 8)), rows, columns, None)
    torch.testing.assert_close(out, torch.ones(1, rows * columns, 1))
    (share,) = torch.autograd.grad(out.sum(), tokens)
    assert float(share.min()) > 0.0


def test_what_the_point_map_makes_of_an_image_is_computed_once(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    cfg = small()
    model = build_model(cfg, build_processor(cfg, TEXTS, TYPES)).eval()
    rng = np.random.default_rng(0)
    views = [make_view(rng) for _ in range(3)]
    images = Collator(model.processor, cfg)([Example(tuple(looking([("a", "b")], None, "terse")), (v,)) for v in views]).images
    plain, seen = model.spatial(images)[0], list[int]()
    model.point_map.register_forward_pre_hook(lambda module, inputs: seen.append(len(inputs[0])))
    model.keep_spatial()
    first = model.spatial(part(images, [0, 2]))[0]
    torch.testing.assert_close(first.float(), plain[[0, 2]], atol=2e-3, rtol=2e-3)
    again = model.spatial(images)[0]  # one of them is new
    assert torch.equal(again[[0, 2]], first) and seen == [2, 1]
    model.keep_spatial()  # another process
    assert torch.equal(model.spatial(images)[0], again) and seen == [2, 1]
    turned = dataclasses.replace(images, camera_in_pelvis=images.camera_in_pelvis + 0.1)
    assert not torch.equal(model.spatial(turned)[0], again) and seen == [2, 1, 3]
    with torch.no_grad():
        next(model.point_map.parameters()).add_(0.1)
    model.keep_spatial()
    assert not torch.equal(model.spatial(images)[0], again) and seen == [2, 1, 3, 3]


def part(images, rows):
    pick = torch.tensor(rows)
    return dataclasses.replace(images, rgb=images.rgb[pick], camera_in_pelvis=images.camera_in_pelvis[pick])


def test_tokens_need_an_encoder_with_tokens():
    with pytest.raises(ValueError, match=r"cse\.source 'both'"):
        CrossSpatialEncoder(CseConfig(source="both"), 8, 0)


def test_point_map_loss_against_a_loop():
    torch.manual_seed(0)
    points, truth, conf = torch.randn(2, 3, 3, 3), torch.randn(2, 6, 6, 3), 1 + torch.rand(2, 3, 3)
    truth[0, 1, 1] = torch.nan
    truth[1, 3, 3] = 30.0
    total, count = 0.0, 0
    for i in range(2):
        for r in range(3):
            for c in range(3):
                target = truth[i, 2 * r + 1, 2 * c + 1]
                if torch.isfinite(target).all() and target.norm() < 20:
                    total += float(conf[i, r, c] * (points[i, r, c] - target).norm() - 0.2 * conf[i, r, c].log())
                    count += 1
    assert count == 16
    assert float(point_map_loss(GeoFeatures(None, points, conf), truth)) == pytest.approx(total / count, rel=1e-5)


def test_sim_point_map_learns_a_plane():
    torch.manual_seed(0)
    encoder = SimPointMap(32, 1)
    rgb = torch.randint(0, 256, (2, 3, 56, 56), dtype=torch.uint8)
    truth = torch.zeros(2, 56, 56, 3)
    truth[..., 2] = 3.0
    optimiser = torch.optim.AdamW(encoder.parameters(), 3e-3)
    losses = []
    for _ in range(30):
        loss = point_map_loss(encoder(rgb), truth)
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        losses.append(float(loss.detach()))
    geo = encoder(rgb)
    assert geo.tokens.shape == (2, 32, 7, 7)
    assert geo.points_m.shape == (2, 14, 14, 3)
    assert geo.conf.min() >= 1
    assert losses[-1] < losses[0] / 2
    with pytest.raises(ValueError, match="rgb"):
        encoder(rgb[0])
    with pytest.raises(ValueError, match="multiple of 32"):
        SimPointMap(40)


def test_build_point_map(cfg):
    assert isinstance(build_point_map(cfg), SimPointMap)
    oracle = dataclasses.replace(cfg, cse=CseConfig(source="points"), point_map=PointMapConfig(encoder="oracle"))
    assert isinstance(build_point_map(oracle), OraclePointMap)
    none = dataclasses.replace(cfg, cse=CseConfig(enabled=False), point_map=PointMapConfig(encoder="none"))
    assert build_point_map(none) is None


def test_oracle_reads_the_views_points(cfg, processor, examples, shake):
    oracle = dataclasses.replace(cfg, cse=CseConfig(source="points"), point_map=PointMapConfig(encoder="oracle"))
    model = build_model(oracle, processor)
    shake(model)
    collate = Collator(processor, oracle)

    def loss(scale: float) -> float:
        points = np.full((112, 112, 3), scale, dtype=np.float32)
        shown = [dataclasses.replace(e, views=(dataclasses.replace(e.views[0], points_m=points),)) for e in examples]
        return float(model(collate(shown)).loss.detach())

    assert loss(1.0) != loss(2.0)


def test_shown_shares_against_a_loop():
    torch.manual_seed(0)
    segmentation = torch.randint(-1, 3, (2, 8, 8))
    shares = shown_shares(segmentation, (2, 2), 3)
    for i in range(2):
        for cell in range(4):
            r, c = 4 * (cell // 2), 4 * (cell % 2)
            labels = segmentation[i, r : r + 4, c : c + 4].flatten()
            for kind in range(3):
                assert shares[i, cell, kind] == pytest.approx(float((labels == kind).float().mean()))
    with pytest.raises(ValueError, match="not a multiple of the grid"):
        shown_shares(segmentation, (3, 2), 3)
    with pytest.raises(ValueError, match="type index 2"):
        shown_shares(segmentation, (2, 2), 2)


def test_dense_head_is_tied_to_names_and_learns(cfg, build, examples):
    model, collate = build(cfg)
    rows = [[5], [6], [7, 8, 9]]
    head = DenseHead(rows)
    names = head.names(model.table)
    torch.testing.assert_close(names[0], model.table[5])
    torch.testing.assert_close(names[2], model.table[rows[2]].mean(0))
    images = collate.images([view for example in examples for view in example.views])
    segmentation = torch.full((3, 112, 112), -1)
    segmentation[:, :56] = 0
    shares = shown_shares(segmentation, images.grid, 3)
    model.train()
    optimiser = torch.optim.AdamW([*model.parameters(), *head.parameters()], 3e-3)
    for _ in range(25):
        loss, recall = head(model.visual_tokens(images), model.table, shares)
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    assert recall > 0.9
    with pytest.raises(ValueError, match="names is empty"):
        DenseHead([])
