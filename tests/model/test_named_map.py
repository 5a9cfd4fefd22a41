"""The point map that knows what is where."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from torch.nn import functional

from interface.observation import Camera
from proprio_mllm.model.batch import Collator, Example
from proprio_mllm.model.building import build_model, build_processor, load_model, save_model
from proprio_mllm.model.chat import IMAGE, Message
from proprio_mllm.model.geometry import stance
from proprio_mllm.model.modeling import ProprioMLLM
from proprio_mllm.model.named_map import NamedPointMap, NamedTruth, _rays, centres_of, named_map_loss, named_truth
from proprio_mllm.model.point_map import Named
from proprio_mllm.model.word_tokens import add_word_tokens, tokens_of
from tests.model.conftest import TEXTS, TYPES, make_view, small


def test_a_cell_stands_for_the_smallest_thing_in_it() -> None:
    segmentation = np.full((16, 24), -1)
    segmentation[:, 8:] = 0  # a table over two columns of cells
    segmentation[3:5, 10:14] = 1  # a mug on it
    segmentation[8:, 20:] = 1  # another mug
    points = np.zeros((16, 24, 3))
    points[..., 2] = np.where(segmentation == 1, 1.0, 2.0)
    table, first, second = np.array([[0.0, 0, 2], [0, 0, 1], [9, 9, 9]])
    things = [(0, (8, 0, 23, 15), table), (1, (10, 3, 13, 4), first), (1, (20, 8, 23, 15), second)]
    surface, centres, types, weights = named_truth(points, segmentation, things)
    assert types.tolist() == [[-1, 1, 0], [-1, 0, 1]]
    assert surface[..., 2].tolist() == [[2, 1, 2], [2, 2, 1]]
    assert np.isnan(centres[:, 0]).all()
    np.testing.assert_array_equal(centres[0, 1:], [first, table])
    np.testing.assert_array_equal(centres[1, 1:], [table, second])
    mugs, tables = (segmentation == 1).sum(), (segmentation == 0).sum()
    np.testing.assert_allclose(weights[0], [0.0, (64 / mugs) ** 0.75, (64 / tables) ** 0.75], rtol=1e-6)
    segmentation[8:, 20:] = 0  # the first mug alone is very small
    weights = named_truth(points, segmentation, things)[3]
    np.testing.assert_allclose(weights[0, 1], 2**0.75, rtol=1e-6)


def encoder(hidden: int = 16) -> NamedPointMap:
    torch.manual_seed(0)
    return NamedPointMap(32, 1, hidden, 32)


def test_it_refuses_pictures_that_it_cannot_place() -> None:
    rgb = torch.zeros(1, 3, 32, 32, dtype=torch.uint8)
    with pytest.raises(ValueError, match="camera pose and key bodies"):
        encoder()(rgb)
    with pytest.raises(ValueError, match="multiple of 32"):
        NamedPointMap(40, 1, 16, 32)
    with pytest.raises(ValueError, match="image_size 40"):
        NamedPointMap(32, 1, 16, 40)


def test_pictures_of_other_sizes_have_places_between_those_learnt() -> None:
    module = encoder()
    with torch.no_grad():
        module.places.copy_(torch.arange(4.0)[None, :, None].expand(1, 4, 32))
    assert module._at((2, 2))[0, 0].tolist() == [[0.0, 1.0], [2.0, 3.0]]
    finer = module._at((4, 4))[0, 0]
    assert bool((finer.diff(dim=0) >= 0).all()) and bool((finer.diff(dim=1) >= 0).all())
    geo = module(torch.zeros(1, 3, 64, 48, dtype=torch.uint8), None, torch.eye(3, 4)[None])
    assert geo.named is not None
    assert geo.named.keys.shape == (1, 8, 6, 16)


def test_it_is_told_where_rays_go_and_how_far_the_floor_is() -> None:
    camera = Camera(np.array([[100.0, 0, 16], [0, 100, 24], [0, 0, 1]]), np.eye(4), 48, 32)
    camera.camera_in_pelvis[:3, :3] = [[0, 0, 1], [-1, 0, 0], [0, -1, 0]]  # looks ahead
    camera.camera_in_pelvis[:3, 3] = [0.2, 0.0, 0.5]
    bodies = np.zeros((14, 3))
    bodies[3, 2] = -0.9
    told = torch.from_numpy(stance(camera, bodies)).float()[None]
    planes = _rays(told, (12, 8))[0]
    assert planes.shape == (4, 12, 8)
    torch.testing.assert_close(planes[3], torch.full((12, 8), 2.0 * (1.4 - 1.0)))
    at = torch.tensor([1.0, -(4 * 5 + 2.0 - 16) / 100, -(4 * 9 + 2.0 - 24) / 100])  # row 9, column 5
    torch.testing.assert_close(planes[:3, 9, 5], functional.normalize(at, dim=0))


def test_names_find_the_centres_of_what_they_name() -> None:
    """Two squares of two colours change places, and how far they are follows from the camera's height alone."""
    torch.manual_seed(0)
    names, module = functional.normalize(torch.randn(2, 16), dim=-1), encoder()
    rgb = torch.full((4, 3, 32, 32), 90, dtype=torch.uint8)
    types, centres = torch.full((4, 4, 4), -1), torch.full((4, 4, 4, 3), torch.nan)
    stance = torch.eye(3, 4).repeat(4, 1, 1)
    stance[:, 2, 3] = torch.tensor([1.0, 1.0, 1.2, 1.2])
    for image in range(4):
        for kind, column in enumerate((0, 2) if image % 2 else (2, 0)):
            rgb[image, kind, 8:24, 8 * column : 8 * column + 16] = 255
            types[image, 1:3, column : column + 2] = kind
            centres[image, 1:3, column : column + 2] = torch.tensor([column - 1.0, 0.0, 1.0 + image // 2])
    truth = NamedTruth(torch.ones(4, 4, 4, 3), centres, types, torch.ones(4, 4, 4))
    optimiser = torch.optim.AdamW(module.parameters(), 5e-3)
    for _ in range(250):
        loss, right = named_map_loss(module, module(rgb, None, stance), truth, names)
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    geo = module(rgb, None, stance)
    assert right == 1.0
    assert geo.points_m.shape == (4, 4, 4, 3)
    assert geo.tokens.shape == (4, NamedPointMap.token_dim, 4, 4)
    for kind, columns in enumerate(((2, 0, 2, 0), (0, 2, 0, 2))):
        true = torch.tensor([[column - 1.0, 0.0, 1.0 + image // 2] for image, column in enumerate(columns)])
        found, _ = centres_of(geo.named, names[kind].expand(4, -1), module.scale.exp())
        torch.testing.assert_close(found, true, atol=0.3, rtol=0.0)


@pytest.fixture
def model() -> ProprioMLLM:
    cfg = small()
    cse = dataclasses.replace(cfg.cse, named=True, frame="pelvis")
    cfg = dataclasses.replace(cfg, cse=cse, point_map=dataclasses.replace(cfg.point_map, encoder="named", width=32, depth=1))
    processor = build_processor(cfg, TEXTS, TYPES)
    add_word_tokens(processor.tokenizer, ("pick", "mug", "_1"))
    return build_model(cfg, processor, 0).eval()


def test_words_look_into_the_point_map(model: ProprioMLLM) -> None:
    rng = np.random.default_rng(0)
    said = (Message("user", f"{IMAGE} pick  mug  _1"), Message("assistant", "left"))
    batch = model.look(Collator(model.processor, model.cfg)([Example(said, (make_view(rng),))]))
    images, named = batch.images, model.cse.named
    geo = model.point_map(images.rgb, None, images.stance)
    mug = tokens_of(model.processor.tokenizer).tokens(["mug"])[0]
    at = batch.input_ids[0].tolist().index(mug)
    with torch.no_grad():
        model.table[mug] = 5.0 * geo.named.keys[0, 1, 2]  # a cell looks just like it
        named.scale.fill_(8.0)
        given = model.named(batch)[0, at]
        pose = images.camera_in_pelvis[0]
        centre, point = (pose[:3, :3] @ one[0, 1, 2] + pose[:3, 3] for one in (geo.named.centres_m, geo.points_m))
        conf = [one[0, 1, 2].log()[None] for one in (geo.named.conf, geo.conf)]
        held = torch.cat([centre / 2, conf[0], point / 2, conf[1]])
        torch.testing.assert_close(given, named.put(held), atol=1e-4, rtol=1e-4)


def test_words_score_as_the_keys_were_trained(model: ProprioMLLM) -> None:
    point_map = model.point_map
    with torch.no_grad():
        point_map.scale.fill_(2.5)
        point_map.bias.fill_(-3.0)
    again = ProprioMLLM(model.vlm, model.cfg, model.processor, model.motion_ids, point_map)
    assert (float(again.cse.named.scale), float(again.cse.named.bias)) == (2.5, -3.0)
    again.keep_spatial()
    assert again.seen is None  # what words look into is more than is kept


def test_many_cells_unlike_a_name_do_not_outweigh_the_few_that_are_like_it() -> None:
    keys, centres = torch.zeros(1, 20, 20, 4), torch.full((1, 20, 20, 3), 9.0)
    keys[..., 0] = 1.0
    keys[0, 3, 4], centres[0, 3, 4] = torch.tensor([0.0, 1.0, 0.0, 0.0]), torch.tensor([1.0, 2.0, 3.0])
    place, cosine = centres_of(Named(keys, centres, torch.ones(1, 20, 20)), keys[:, 3, 4], torch.tensor(6.0))
    assert int(cosine.argmax()) == 64
    torch.testing.assert_close(place[0], centres[0, 3, 4], atol=0.05, rtol=0.05)


def test_it_is_stored_with_the_heads(model: ProprioMLLM, tmp_path) -> None:
    save_model(model, tmp_path / "model")
    again = load_model(tmp_path / "model")
    assert all(torch.equal(a, b) for a, b in zip(model.point_map.parameters(), again.point_map.parameters(), strict=True))
    images = Collator(model.processor, model.cfg).images([make_view(np.random.default_rng(0))])
    for a, b in zip(model.spatial(images), again.spatial(images), strict=True):
        torch.testing.assert_close(getattr(a, "points_m", a), getattr(b, "points_m", b))
