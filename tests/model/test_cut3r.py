"""The CUT3R adapter against a stand-in checkout: a tiny network with CUT3R's module layout, call and output, written here.

Neither CUT3R's code nor its weights are available to the tests (licence), so what is checked is the adapter: loading, refusals,
view dictionary, token order, rotary fix. That the real network behaves like the stand-in is not checked here.
"""

import argparse
import dataclasses
import hashlib
import math
import sys
from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file

from configs.schema.model import CseConfig, PointMapConfig
from proprio_mllm.model.batch import Collator
from proprio_mllm.model.building import build_model
from proprio_mllm.model.cut3r import Cut3rPointMap, FloatRope2d, read_checkpoint

STAND_IN = """
import torch
from torch import nn


class ARCroco3DStereoConfig:
    def __init__(self, enc_embed_dim, dec_embed_dim, **rest):
        self.enc, self.dec = enc_embed_dim, dec_embed_dim


class BrokenRope(nn.Module):
    def forward(self, tokens, positions):
        raise RuntimeError("index out of range")


class Attention(nn.Module):
    def __init__(self, dim, rope):
        super().__init__()
        self.qkv, self.rope = nn.Linear(dim, dim), rope

    def forward(self, x, pos):
        return x + self.rope(self.qkv(x)[:, None], pos)[:, 0]


class ARCroco3DStereo(nn.Module):
    def __init__(self, cfg):
        super().__init__()
        self.rope = BrokenRope()
        self.embed = nn.Conv2d(3, cfg.enc, 16, 16)
        self.pose_token = nn.Parameter(torch.zeros(1, 1, cfg.enc))
        self.attn = Attention(cfg.enc, self.rope)
        self.decoder_embed = nn.Linear(cfg.enc, cfg.dec)
        self.dec_norm = nn.LayerNorm(cfg.dec)
        self.head = nn.Linear(cfg.dec, 4)

    def load_state_dict(self, *args, **kwargs):
        raise RuntimeError("skips what does not fit")

    def forward_recurrent(self, views, device):
        (view,) = views
        assert view["img"].abs().max() <= 1 and view["img_mask"].all() and not view["ray_mask"].any()
        grid = self.embed(view["img"][view["img_mask"]])
        h, w = grid.shape[2:]
        assert view["true_shape"].tolist() == [[16 * h, 16 * w]] * len(grid)
        view["ray_map"].permute(0, 3, 1, 2)[view["ray_mask"]]
        rows, cols = torch.meshgrid(torch.arange(h), torch.arange(w), indexing="ij")
        pos = torch.stack([rows, cols], -1).reshape(1, -1, 2).expand(len(grid), -1, -1)
        pos = torch.cat([-torch.ones(len(grid), 1, 2, dtype=pos.dtype), pos], 1)
        x = torch.cat([self.pose_token.expand(len(grid), -1, -1), grid.flatten(2).transpose(1, 2)], 1)
        x = self.dec_norm(self.decoder_embed(self.attn(x, pos)))
        out = self.head(x[:, 1:]).transpose(1, 2).reshape(len(grid), 4, h, w)
        out = nn.functional.interpolate(out, scale_factor=16).permute(0, 2, 3, 1)
        return [{"pts3d_in_self_view": out[..., :3], "conf_self": 1 + out[..., 3].exp()}], views
"""
SIZES = {"enc_embed_dim": 8, "dec_embed_dim": 12}


@pytest.fixture
def checkout(tmp_path, monkeypatch):
    package = tmp_path / "cut3r" / "src" / "dust3r"
    package.mkdir(parents=True)
    (package / "__init__.py").write_text("")
    (package / "model.py").write_text(STAND_IN)
    monkeypatch.setattr(sys, "path", list(sys.path))
    for name in [name for name in sys.modules if name.split(".")[0] == "dust3r"]:
        monkeypatch.delitem(sys.modules, name)
    yield tmp_path / "cut3r"
    for name in [name for name in sys.modules if name.split(".")[0] == "dust3r"]:
        del sys.modules[name]


def _weights(checkout: Path) -> dict[str, torch.Tensor]:
    scope: dict = {}
    exec(compile(STAND_IN, "stand_in", "exec"), scope)
    torch.manual_seed(0)
    return scope["ARCroco3DStereo"](scope["ARCroco3DStereoConfig"](**SIZES)).state_dict()


def _sha(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


class Surprise:
    """An object that the restricted unpickler refuses."""


def test_points_and_tokens_from_a_safetensors_checkpoint(checkout, tmp_path):
    weights = _weights(checkout)
    save_file(weights, tmp_path / "w.safetensors")
    cfg = PointMapConfig(encoder="cut3r", checkout=str(checkout), checkpoint=str(tmp_path / "w.safetensors"), size=64)
    encoder = Cut3rPointMap.from_config(cfg, SIZES).train()
    assert not encoder.training
    assert not any(p.requires_grad for p in encoder.parameters())
    rgb = torch.randint(0, 256, (2, 3, 112, 112), dtype=torch.uint8)
    geo = encoder(rgb)
    assert geo.tokens.shape == (2, 12, 4, 4)
    assert geo.points_m.shape == (2, 64, 64, 3)
    assert geo.conf.min() >= 1
    # The head is linear in the tokens: a token grid in raster order gives the points back.
    points = torch.einsum("pc,ichw->ihwp", weights["head.weight"][:3], geo.tokens) + weights["head.bias"][:3]
    torch.testing.assert_close(geo.points_m[:, 8::16, 8::16], points)


def test_the_whole_model_runs_with_it(checkout, tmp_path, cfg, processor, examples):
    save_file(_weights(checkout), tmp_path / "w.safetensors")
    point_map = PointMapConfig(encoder="cut3r", checkout=str(checkout), checkpoint=str(tmp_path / "w.safetensors"), size=64)
    with_it = dataclasses.replace(cfg, point_map=point_map, cse=CseConfig())
    model = build_model(with_it, processor, point_map=Cut3rPointMap.from_config(point_map, SIZES))
    assert model(Collator(processor, with_it)(examples)).loss.isfinite()


def test_a_checkpoint_with_a_namespace_needs_a_checksum_but_no_trust(checkout, tmp_path):
    path = tmp_path / "w.pth"
    torch.save(
        {"model": {f"module.{k}": v for k, v in _weights(checkout).items()}, "args": argparse.Namespace(model="x")}, path
    )
    assert set(read_checkpoint(path, _sha(path))) == set(_weights(checkout))
    with pytest.raises(ValueError, match="sha256 is needed"):
        read_checkpoint(path, None)
    with pytest.raises(ValueError, match="expected 00"):
        read_checkpoint(path, "00")


def test_other_objects_need_trust(checkout, tmp_path):
    path = tmp_path / "w.pth"
    torch.save({"model": _weights(checkout), "args": Surprise()}, path)
    with pytest.raises(ValueError, match="trust_checkpoint=true"):
        read_checkpoint(path, _sha(path))
    assert read_checkpoint(path, _sha(path), trust=True)


def test_files_without_weights_are_refused(tmp_path):
    path = tmp_path / "w.pth"
    torch.save({"model": {"a": 1}}, path)
    with pytest.raises(ValueError, match="tensors under 'model'"):
        read_checkpoint(path, _sha(path))


def test_wrong_paths_sizes_and_weights_are_refused(checkout, tmp_path):
    with pytest.raises(ValueError, match=r"needs point_map\.checkout"):
        Cut3rPointMap.from_config(PointMapConfig(encoder="cut3r"))
    with pytest.raises(ValueError, match="no CUT3R checkout"):
        Cut3rPointMap.from_config(PointMapConfig(encoder="cut3r", checkout=str(tmp_path), checkpoint="x"))
    weights = _weights(checkout)
    weights.pop("head.bias")
    save_file(weights, tmp_path / "w.safetensors")
    cfg = PointMapConfig(encoder="cut3r", checkout=str(checkout), checkpoint=str(tmp_path / "w.safetensors"), size=64)
    with pytest.raises(ValueError, match=r"1 weights are missing, among them \['head\.bias'\]"):
        Cut3rPointMap.from_config(cfg, SIZES)
    save_file(_weights(checkout), tmp_path / "w.safetensors")
    with pytest.raises(ValueError, match="size 60 must be a multiple of 16"):
        Cut3rPointMap.from_config(dataclasses.replace(cfg, size=60), SIZES)


def test_rope_against_complex_rotation():
    torch.manual_seed(0)
    tokens, positions = torch.randn(1, 1, 3, 8), torch.tensor([[[-1, -1], [0, 2], [5, 1]]])
    out = FloatRope2d(100.0)(tokens, positions)
    for n in range(3):
        for half in range(2):
            for pair in range(2):
                angle = float(positions[0, n, half]) * 100.0 ** (-2 * pair / 4)
                base = 4 * half + pair
                value = complex(tokens[0, 0, n, base], tokens[0, 0, n, base + 2])
                turned = value * complex(math.cos(angle), math.sin(angle))
                assert out[0, 0, n, base] == pytest.approx(turned.real, abs=1e-5)
                assert out[0, 0, n, base + 2] == pytest.approx(turned.imag, abs=1e-5)
